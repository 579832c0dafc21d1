"""Flood the service's UDP port from many source ports while an array streams to it.

The array sends in real time, the strangers as fast as they are told. What is counted: the epochs
that were answered, of those that were sent; the strangers' datagrams; the most memory that the
service took; its time on a processor; the lines that it logged. Three processes want two cores.

    python benchmarks/flood.py --rate 50000 --seconds 10
"""

import argparse
import math
import os
import random
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from pymavlink.dialects.v20 import common

from risaf_link.bench.feed import bursts
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.frame import encode
from risaf_link.sim.scenario import scenario

HOST = "127.0.0.1"
SENSORS = 150
SETTLE_S = 2.0  # of the array alone
TURN_S = 0.002  # from one burst of the strangers to the next
MOST_A_TURN = 500  # of them
KINDS = ("garbage", "frames", "readings", "orders")
TICKS = os.sysconf("SC_CLK_TCK")


def datagrams(kind: str, count: int) -> list[bytes]:
    """What strangers send, one after another."""
    chance = random.Random(1)  # noqa: S311
    return [_datagram(kind, chance) for _ in range(count)]


def _datagram(kind: str, chance: random.Random) -> bytes:
    if kind == "garbage":
        return chance.randbytes(chance.randint(1, 300))
    system, sequence = chance.randint(2, 254), chance.randint(0, 255)
    if kind == "readings":
        return encode(IDS["GYRO_ARRAY"], chance.randbytes(254), sequence, system, 1)
    sender = common.MAVLink(None, system, 190)
    message = common.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    if kind == "orders":
        message = chance.choice(
            [
                common.MAVLink_param_request_list_message(0, 0),
                common.MAVLink_param_set_message(0, 0, b"HDG_GATE", chance.uniform(2.0, 5.0), 9),
                common.MAVLink_command_long_message(0, 0, 511, 0, 31, 100, 0, 0, 0, 0, 0),
                common.MAVLink_command_long_message(0, 0, 512, 0, 59616, 0, 0, 0, 0, 0, 0),
            ]
        )
    return bytes(message.pack(sender))


def strangers(kind: str, port: int, rate: float, sources: int) -> None:
    """Send to a port, from when a line comes until killed."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(sources)]
    what = datagrams(kind, 997)
    print(0, flush=True)
    sys.stdin.readline()
    began, sent = time.monotonic(), 0
    while True:
        due = min(int((time.monotonic() - began) * rate), sent + MOST_A_TURN)
        for number in range(sent, due):
            sockets[number % sources].sendto(what[number % len(what)], (HOST, port))
        sent = due
        print(sent, flush=True)
        time.sleep(TURN_S)


class Watched:
    """What a process takes of the machine."""

    def __init__(self, pid: int) -> None:
        self._pid = Path(f"/proc/{pid}")

    @property
    def memory_mb(self) -> float:
        """The most so far."""
        lines = (self._pid / "status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1000

    @property
    def busy_s(self) -> float:
        """Time on a processor."""
        fields = (self._pid / "stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / TICKS


@contextmanager
def service(folder: Path, port: int, ground: int, array: int | None) -> Iterator[int]:
    """Run the service; its process id."""
    links = [
        f"{{name: strangers, url: 'udpin://{HOST}:{port}'}}",
        f"{{name: ground, url: 'udpout://{HOST}:{ground}', emit: {{ATTITUDE_QUATERNION: 1000}}}}",
        *([f"{{name: array, url: 'udpin://{HOST}:{array}', emit: {{}}}}"] if array else []),
    ]
    setting = f"links=[{', '.join(links)}]"
    command = [sys.executable, "-m", "risaf_link.cli", "run", "-v", "--set", setting]
    if os.geteuid() == 0:  # as its unit does
        command = ["nice", "-n", "-10", *command]
    with (
        (folder / "log").open("wb") as log,
        subprocess.Popen(command, stderr=log) as process,  # noqa: S603
    ):
        try:
            yield process.pid
        finally:
            process.send_signal(signal.SIGTERM)


def flood(kind: str, options: argparse.Namespace) -> None:
    """Do it with one kind of datagrams, and tell what came of it."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        ground, array = (
            stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in "12"
        )
        ground.bind((HOST, 0))
        ground.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        port, apart = _free_port(), _free_port() if options.apart else None
        pid = stack.enter_context(service(folder, port, ground.getsockname()[1], apart))
        time.sleep(SETTLE_S)
        watched, sent_file = Watched(pid), folder / "sent"
        command = [sys.executable, __file__, "--strangers", kind, "--port", str(port)]
        command += ["--rate", str(options.rate), "--sources", str(options.sources)]

        output = stack.enter_context(sent_file.open("wb"))
        flooding = stack.enter_context(
            subprocess.Popen(command, stdin=subprocess.PIPE, stdout=output)  # noqa: S603
        )
        stack.callback(flooding.kill)
        while not sent_file.stat().st_size:
            time.sleep(TURN_S)
        before_s = math.inf  # the flood

        def let_them_come() -> float:
            assert flooding.stdin  # noqa: S101 it is a pipe
            flooding.stdin.write(b"\n")
            flooding.stdin.flush()
            return time.monotonic()

        if options.first:
            before_s = let_them_come()
            time.sleep(SETTLE_S)
        began, sent, answered, busy_s = time.monotonic(), 0, 0, watched.busy_s
        size = {"seed": 1, "sensors": SENSORS, "duration": 30.0}
        for burst in bursts(scenario("circle", **size), SETTLE_S + options.seconds):
            passed_s = time.monotonic() - began
            if before_s == math.inf and passed_s > SETTLE_S:
                before_s = let_them_come()
            answered += _answers(ground, burst.due_s - passed_s, sent > answered)
            for raw in burst.frames:
                array.sendto(raw, (HOST, apart or port))
            sent += burst.stamp_ms is not None
        answered += _answers(ground, 0.5, True)
        lasted_s = time.monotonic() - began
        busy = (watched.busy_s - busy_s) / lasted_s
        numbers = sent_file.read_bytes().split()[:-1]  # the last one may be half written
        came = int(numbers[-1]) / (time.monotonic() - before_s)
        lines = (folder / "log").read_bytes().count(b"\n")
        print(
            f"{kind:9} {came:7.0f} datagrams/s  {answered}/{sent} epochs answered  "
            f"{watched.memory_mb:.0f} MB  {100 * busy:.0f} % busy  {lines} lines"
        )


def _answers(ground: socket.socket, wait_s: float, any_open: bool) -> int:
    """Attitudes that come until it is time."""
    count, until_s = 0, time.monotonic() + max(0.0, wait_s)
    while True:
        left_s = max(0.0, until_s - time.monotonic())
        if not select.select([ground], [], [], left_s)[0]:
            return count
        raw = ground.recv(4096)
        count += raw[7:10] == b"\x1f\0\0"
        if not any_open:
            return count


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kinds", nargs="*", default=KINDS, choices=KINDS)
    parser.add_argument("--rate", type=float, default=50_000, help="datagrams a second")
    parser.add_argument("--sources", type=int, default=500, help="ports that they come from")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--first", action="store_true", help="strangers come before the array")
    parser.add_argument("--apart", action="store_true", help="the array has a port of its own")
    parser.add_argument("--strangers", choices=KINDS, help=argparse.SUPPRESS)
    parser.add_argument("--port", type=int, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.strangers:
        strangers(chosen.strangers, chosen.port, chosen.rate, chosen.sources)
    for one in chosen.kinds:
        flood(one, chosen)
