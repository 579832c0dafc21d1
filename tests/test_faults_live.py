"""The daemon on real sockets, and what lines, strangers, clocks, memory and disks do to it."""

import asyncio
import gc
import os
import resource
import socket
import sys
import tracemalloc
import tty
from contextlib import ExitStack
from pathlib import Path

import pytest
from daemon import (
    EPOCHS,
    SAFETY_S,
    Ground,
    Running,
    address_of,
    bursts,
    config_for,
    feed,
    is_epoch,
    outputs,
    replayed,
    until,
)
from msgspec import structs
from network import texts
from pymavlink.dialects.v20 import all as public

from risaf_link import gibberish
from risaf_link.config import StateParameters
from risaf_link.links import udp
from risaf_link.loop import unix_us
from risaf_link.mavlink.dialect import IDS
from risaf_link.service import MOST_PEERS, Service

SENT_BAUD, HEARD_BAUD = 921_600, 460_800


class Line:
    """A serial array: a device that may be written to as if it were plugged in."""

    def __init__(self, path: Path) -> None:
        self._fd, slave = os.openpty()
        tty.setraw(slave)
        path.symlink_to(os.ttyname(slave))
        os.close(slave)

    async def send(self, data: bytes, service: Service) -> None:
        """Write, and wait until it was taken."""
        serial = service.links[0]
        for start in range(0, len(data), 1024):
            part = data[start : start + 1024]
            before = serial.counts.bytes_in
            os.write(self._fd, part)
            await until(lambda b=before, p=part: serial.counts.bytes_in == b + len(p))


def heard_at(data: bytes, sent_baud: int, heard_baud: int) -> bytes:
    """What a UART reads of a line on which another speaks at another rate: 8 bits, no parity."""
    bits = [bit for byte in data for bit in (0, *((byte >> i) & 1 for i in range(8)), 1)]

    def level(time: float) -> int:
        return bits[int(time)] if time < len(bits) else 1

    step, time, heard = sent_baud / heard_baud, 0.0, bytearray()
    while time < len(bits):
        if level(time):
            time += 0.1
            continue
        heard.append(sum(level(time + (1.5 + i) * step) << i for i in range(8)))
        time += 9.5 * step
        while time < len(bits) and not level(time):  # a framing error lasts to the next rest
            time += 0.1
    return bytes(heard)


async def told(ground: Ground, part: str) -> str:
    """Wait for a notice."""

    def found() -> list[str]:
        decoder = public.MAVLink(None)
        status = [f.raw for f in ground.heard if f.message_id == IDS["STATUSTEXT"]]
        said = texts([decoder.parse_buffer(raw)[0] for raw in status])
        return [text for text in said if part in text]

    await until(found)
    return found()[0]


async def test_a_wrong_baud_rate_is_said_and_the_right_one_heard(ground, tmp_path, monkeypatch):
    monkeypatch.setattr(gibberish, "PERIOD_S", 0.2)
    device = tmp_path / "ttyARRAY"
    line = Line(device)
    sent = [b"".join([*bursts()[0][:1], *burst]) for burst in bursts() if is_epoch(burst)]
    async with Running(config_for(ground, first=f"serial://{device}:{HEARD_BAUD}"), 2) as service:
        garbage = heard_at(b"".join(sent), SENT_BAUD, HEARD_BAUD)
        assert len(garbage) > 1000
        await line.send(garbage, service)
        notice = await told(ground, "no MAVLink")
        assert notice == "array: what comes is no MAVLink: wrong baud rate?"
        assert service.account().assembly["epochs"] == 0
        for burst in sent:
            await line.send(burst, service)
            await ground.next("ATTITUDE_QUATERNION")
        await told(ground, "MAVLink comes")
    assert service.account().assembly["epochs"] == EPOCHS


async def test_half_a_frame_for_ever_costs_no_memory_and_not_the_frame_behind_it(
    ground, tmp_path, monkeypatch
):
    monkeypatch.setattr(gibberish, "PERIOD_S", 0.2)
    device = tmp_path / "ttyARRAY"
    line = Line(device)
    epochs = [b"".join(burst) for burst in bursts() if is_epoch(burst)]
    half = max(bursts()[0], key=len)[:140]
    async with Running(config_for(ground, first=f"serial://{device}:3000000"), 2) as service:
        tracemalloc.start()
        await line.send(half * 2000, service)
        memory = traced()
        await line.send(half * 5000, service)
        assert traced() - memory < 100_000  # of 700 000 bytes
        tracemalloc.stop()
        await told(ground, "no MAVLink")
        await ground.next("HEARTBEAT")
        await line.send(bursts()[0][0], service)
        for epoch in epochs:
            await line.send(epoch, service)
            await ground.next("ATTITUDE_QUATERNION")
    assert service.account().assembly["samples_lost"] == 0
    assert service.dropped


def traced() -> int:
    """Bytes that are in use."""
    gc.collect()
    return tracemalloc.get_traced_memory()[0]


async def test_a_flood_from_strangers_costs_no_memory_and_the_array_no_epoch(ground):
    """They speak from more addresses than are remembered: garbage, halves, and whole frames."""
    heartbeat = public.MAVLink(None, 77, 1)
    kinds = [b"\xfd" * 300, bursts()[0][0][:30], os.urandom(200), b"\0"]
    config, memory = config_for(ground), []
    tracemalloc.start()
    async with Running(config, up=2) as service:
        with ExitStack() as stack:
            strangers = [
                stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                for _ in range(2 * MOST_PEERS)
            ]
            first, *sent = bursts()  # the array is known before they come
            await feed(ground, service, [first])
            for k, burst in enumerate(sent):
                for i in range(64):
                    whole = heartbeat.heartbeat_encode(i, 8, 0, 0, 0).pack(heartbeat)
                    stranger = strangers[(64 * k + i) % len(strangers)]
                    stranger.sendto([whole, *kinds][(k + i) % 5], address_of(service))
                await feed(ground, service, [burst])
                if k in {len(sent) // 2, len(sent) - 1}:
                    memory.append(traced())
        assert len(service.links[0].peers) <= udp.MOST_PEERS // 2  # of one host
        assert len(service._parsers) <= MOST_PEERS
    tracemalloc.stop()
    assert memory[1] - memory[0] < 100_000
    counts = service.account().assembly
    assert (counts["epochs"], counts["samples_lost"]) == (EPOCHS, 0)
    assert service.links[0].counts.dropped_in > 0


@pytest.mark.parametrize("jump", [-3600.0, 3600.0, 1e8])
async def test_the_hosts_clock_may_jump_while_it_runs(ground, tmp_path, jump):
    recording = tmp_path / "drive.tlog"
    config = config_for(ground, f"{{name: recording, url: 'tlog://{recording}'}}")
    step_us = [0]
    running = Running(config, up=3)
    running._service = Service(config, clock_us=lambda: unix_us() + step_us[0])
    sent = bursts()
    async with running as service:
        await feed(ground, service, sent[: len(sent) // 2])
        step_us[0] = round(jump * 1e6)
        await feed(ground, service, sent[len(sent) // 2 :])
    decoder = public.MAVLink(None)
    told = [decoder.parse_buffer(f.raw)[0] for f in ground.heard]
    stamps = [m.time_boot_ms for m in told if m.get_type() == "ATTITUDE_QUATERNION"]
    assert stamps == [1000 + 10 * k for k in range(EPOCHS)]
    assert replayed(config, recording) == outputs(ground.heard)


async def test_what_came_while_the_loop_stood_still_is_used_afterwards(ground, caplog):
    sent = [burst for burst in bursts() if is_epoch(burst)]
    info = bursts()[0][0]
    async with Running(config_for(ground), up=2) as service:
        monotonic, stood_s = asyncio.get_running_loop().time, 0.0
        asyncio.get_running_loop().time = lambda: monotonic() + stood_s
        await ground.next("HEARTBEAT")
        ground.transport.sendto(info, address_of(service))
        for raw in (raw for burst in sent for raw in burst):  # nothing awaits meanwhile
            ground.transport.sendto(raw, address_of(service))
        stood_s = 5.0
        heard = [await ground.next("ATTITUDE_QUATERNION") for _ in sent]
        await until(lambda: "stood still for " in caplog.text)
    decoder = public.MAVLink(None)
    stamps = [decoder.parse_buffer(frame.raw)[0].time_boot_ms for frame in heard]
    assert stamps == [1000 + 10 * k for k in range(EPOCHS)]
    assert service.account().assembly["samples_lost"] == 0


async def test_a_disk_that_is_read_only_costs_recordings_and_memory_and_nothing_else(
    ground, caplog
):
    folder = Path("/sys/kernel")  # nobody can make a file there, not even root
    limits = "recording: {least_free_bytes: 0}"
    config = config_for(ground, f"{{name: rec, url: 'tlog://{folder}/drive.tlog', {limits}}}")
    config = structs.replace(config, state=StateParameters(f"{folder}/state.json", period=0.1))
    async with Running(config, up=2) as service:
        assert len(await feed(ground, service, bursts())) == EPOCHS
        await until(lambda: "state.json" in caplog.text)
    assert service.links[2].counts.dropped_out > 0
    assert "rec: down: " in caplog.text
    assert "records lost" in caplog.text


def leave_no_memory(pid: int) -> None:
    """Let a process have no more memory than it has."""
    pages, *_ = Path(f"/proc/{pid}/statm").read_text().split()
    used = int(pages) * os.sysconf("SC_PAGE_SIZE")
    resource.prlimit(pid, resource.RLIMIT_AS, (used, used))


async def test_a_daemon_that_may_have_no_more_memory_goes_on_with_what_it_has(ground):
    """Nothing grows while it runs: a limit that is set at what it uses is never reached."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    links = (
        f"links=[{{name: vehicle, url: 'udpin://127.0.0.1:{port}', emit: {{}}}},"
        f"{{name: ground, url: 'udpout://127.0.0.1:{ground.port}',"
        "emit: {ATTITUDE_QUATERNION: 10000}}]"
    )
    command = [sys.executable, "-m", "risaf_link.cli", "run", "--set", links]
    daemon = await asyncio.create_subprocess_exec(*command)
    sent = bursts(600)
    try:
        await ground.next("HEARTBEAT")
        for k, burst in enumerate(sent):
            if k == 300:
                leave_no_memory(daemon.pid)
            for raw in burst:
                ground.transport.sendto(raw, ("127.0.0.1", port))
            if is_epoch(burst):
                await ground.next("ATTITUDE_QUATERNION")
        assert daemon.returncode is None
    finally:
        daemon.terminate()
        assert await asyncio.wait_for(daemon.wait(), SAFETY_S) == 0


async def test_a_daemon_that_cannot_get_the_memory_to_start_ends_with_a_status(tmp_path):
    def limit():
        resource.setrlimit(resource.RLIMIT_AS, (60 << 20, 60 << 20))

    command = [sys.executable, "-m", "risaf_link.cli", "run"]
    daemon = await asyncio.create_subprocess_exec(
        *command, preexec_fn=limit, stderr=asyncio.subprocess.PIPE, cwd=tmp_path
    )
    _, complaint = await asyncio.wait_for(daemon.communicate(), SAFETY_S)
    assert daemon.returncode != 0
    assert complaint
