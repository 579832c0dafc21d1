"""The daemon on real sockets and a real pty, against pymavlink as ground station."""

import asyncio
import os
import signal
import socket
import subprocess
import sys
import tty

import pytest
from daemon import (
    EPOCHS,
    SAFETY_S,
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
from pymavlink.dialects.v20 import all as public

from risaf_link.loop import unix_us
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.tlog import TlogReader, record


async def test_every_epoch_gives_an_attitude_that_pymavlink_reads(ground):
    async with Running(config_for(ground), up=2) as service:
        heard = await feed(ground, service, bursts())
    decoder = public.MAVLink(None)
    messages = [decoder.parse_buffer(frame.raw)[0] for frame in heard]
    assert [m.time_boot_ms for m in messages] == [1000 + 10 * k for k in range(EPOCHS)]
    for message in messages:
        norm = (message.q1**2 + message.q2**2 + message.q3**2 + message.q4**2) ** 0.5
        assert norm == pytest.approx(1.0, abs=1e-6)
        assert list(message.repr_offset_q) == [0, 0, 0, 0]
        assert (message.get_srcSystem(), message.get_srcComponent()) == (1, 191)


async def test_a_recording_replays_to_the_same_outputs_bit_for_bit(ground, tmp_path):
    recording = tmp_path / "drive.tlog"
    config = config_for(ground, f"{{name: recording, url: 'tlog://{recording}'}}")
    async with Running(config, up=3) as service:
        await feed(ground, service, bursts())
        (half,) = bursts(EPOCHS + 1)[-1][:1]  # of an epoch that never becomes whole
        whole = service.links[0].counts.bytes_in
        ground.transport.sendto(half, address_of(service))
        await until(lambda: service.links[0].counts.bytes_in == whole + len(half))
    await ground.next("ATTITUDE_QUATERNION")
    assert service.account().assembly["epochs"] == EPOCHS + 1
    live = outputs(ground.heard)
    assert len(live) > EPOCHS
    assert replayed(config, recording) == live


async def test_the_operator_is_told_of_a_recording_for_which_there_is_no_room(ground, tmp_path):
    limits = "recording: {least_free_bytes: 1000000000000000000}"
    recording = f"{{name: log, url: 'tlog://{tmp_path}/drive.tlog', {limits}}}"
    async with Running(config_for(ground, recording), up=2):
        text = ""
        while "recording" not in text:
            chunk = (await ground.next("STATUSTEXT")).payload
            text = text + chunk[1:51].rstrip(b"\0").decode()
    assert text == f"recording log: {tmp_path}: less than 10"[: len(text)]


async def test_what_a_ground_station_sets_is_in_the_recording_and_replays_bit_for_bit(
    ground, tmp_path
):
    recording = tmp_path / "drive.tlog"
    config = config_for(ground, f"{{name: recording, url: 'tlog://{recording}'}}")
    codec = public.MAVLink(None, 255, 190)
    orders = {
        20: codec.param_set_encode(1, 191, b"FUS_METHOD", 3, 9),
        35: codec.command_long_encode(1, 191, 246, 0, 1, 0, 0, 0, 0, 0, 0),
    }
    async with Running(config, up=3) as service:
        for k, burst in enumerate(bursts()):
            if k in orders:
                ground.transport.sendto(orders[k].pack(codec), address_of(service))
            await feed(ground, service, [burst])
    live = outputs(ground.heard)
    assert replayed(config, recording) == live
    recording.write_bytes(without(recording.read_bytes(), {IDS["PARAM_SET"]}))
    assert replayed(config, recording) != live


async def test_stamps_on_the_autopilots_clock_replay_bit_for_bit(ground, tmp_path):
    recording = tmp_path / "drive.tlog"
    config = config_for(ground, f"{{name: recording, url: 'tlog://{recording}'}}")
    codec = public.MAVLink(None, 1, 1)
    async with Running(config, up=3) as service:
        for k, burst in enumerate(bursts()):
            if k == 10:
                beat = codec.heartbeat_encode(10, 3, 0, 0, 4)
                ground.transport.sendto(beat.pack(codec), address_of(service))
            if k >= 20 and k % 5 == 0:
                told = codec.timesync_encode(
                    (5_000_000 + 10_000 * k) * 1000, unix_us() * 1000 + 191
                )
                ground.transport.sendto(told.pack(codec), address_of(service))
            await feed(ground, service, [burst])
    live = outputs(ground.heard)
    assert replayed(config, recording) == live
    recording.write_bytes(without(recording.read_bytes(), {IDS["TIMESYNC"]}))
    assert replayed(config, recording) != live


def without(log: bytes, message_ids: set[int]) -> bytes:
    kept = (one for one in TlogReader([log]) if one.frame.message_id not in message_ids)
    return b"".join(record(one.time_us, one.frame.raw) for one in kept)


async def test_a_client_that_does_not_read_costs_only_itself(ground):
    port = "tcpin://127.0.0.1:0"
    config = config_for(ground, f"{{name: clients, url: '{port}'}}")
    async with Running(config, up=3) as service:
        host, _, number = service.links[2].address.partition(":")
        slow = socket.create_connection((host, int(number)))
        await until(lambda: service.links[2].peers)
        (client,) = service.links[2]._clients.values()
        client.pause_writing()  # its buffer is full, as after some seconds of silence
        before = service.links[1].counts.dropped_out
        assert len(await feed(ground, service, bursts())) == EPOCHS
        slow.close()
    assert service.links[2].counts.dropped_out >= EPOCHS
    assert service.links[1].counts.dropped_out == before


async def test_who_sets_a_parameter_with_its_first_datagram_is_answered(ground):
    config = config_for(ground, "{name: stations, url: 'udpin://127.0.0.1:0'}")
    codec = public.MAVLink(None, 255, 190)
    order = codec.param_set_encode(1, 191, b"FUS_GATE", 6.0, 9).pack(codec)
    async with Running(config, up=3) as service:
        host, _, port = service.links[2].address.partition(":")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
            station.setblocking(False)
            station.sendto(order, (host, int(port)))
            raw = await asyncio.get_running_loop().sock_recv(station, 300)
    answer = public.MAVLink(None).parse_buffer(raw)[0]
    assert (answer.get_type(), answer.param_value) == ("PARAM_VALUE", 6.0)


async def test_heartbeat_tells_whether_epochs_come(ground):
    async with Running(config_for(ground), up=2):
        heartbeat = public.MAVLink(None).parse_buffer((await ground.next("HEARTBEAT")).raw)[0]
    assert heartbeat.type == public.MAV_TYPE_ONBOARD_CONTROLLER
    assert heartbeat.autopilot == public.MAV_AUTOPILOT_INVALID
    assert heartbeat.system_status == public.MAV_STATE_BOOT


async def test_garbage_from_one_peer_costs_another_nothing(ground):
    sent = bursts()
    async with Running(config_for(ground), up=2) as service:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            for k, burst in enumerate(sent):
                stranger.sendto(bytes([0xFD, 200, k % 256]) * 20, address_of(service))
                await feed(ground, service, [burst])
        counts = service.account().assembly
        assert (counts["epochs"], counts["incomplete"]) == (EPOCHS, 0)
        assert service.dropped


async def test_a_serial_array_that_is_unplugged_comes_back_while_other_links_go_on(
    ground, tmp_path
):
    device = tmp_path / "ttyARRAY"  # not there yet
    udp = "{name: gps, url: 'udpin://127.0.0.1:0', emit: {}}"
    config = config_for(ground, udp, first=f"serial://{device}:3000000")
    epochs = [burst for burst in bursts() if is_epoch(burst)]
    info = bursts()[0][:1]

    def plug() -> int:
        master, slave = os.openpty()
        tty.setraw(slave)
        device.unlink(missing_ok=True)
        device.symlink_to(os.ttyname(slave))
        os.close(slave)
        return master

    async with Running(config, up=0) as service:
        serial, _, other = service.links
        await until(lambda: other.counts.connections == 1)
        for plugged in (1, 2):
            master = plug()
            await until(lambda n=plugged: serial.counts.connections == n)
            half = epochs[: EPOCHS // 2] if plugged == 1 else epochs[EPOCHS // 2 :]
            for burst in half:
                os.write(master, b"".join([*info, *burst]))
                await ground.next("ATTITUDE_QUATERNION")
            os.close(master)
        assert service.account().assembly["epochs"] == EPOCHS
        assert other.counts.connections == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
async def test_a_signal_ends_the_daemon_cleanly(ground, number):
    links = f"links=[{{name: ground, url: 'udpout://127.0.0.1:{ground.port}'}}]"
    command = [sys.executable, "-m", "risaf_link.cli", "run", "--set", links]
    daemon = await asyncio.create_subprocess_exec(*command, stderr=subprocess.PIPE)
    await ground.next("HEARTBEAT")
    daemon.send_signal(number)
    _, complaint = await asyncio.wait_for(daemon.communicate(), SAFETY_S)
    assert (daemon.returncode, complaint) == (0, b"")
