"""What MQTT, metrics and the page cost the estimator: latencies with and without, by turns.

python benchmarks/outputs.py [--rounds N] [--seconds S] [--sensors N] [--rate HZ] [--shared]

A round is a run of the service without outputs, one with MQTT and metrics (a mosquitto on 127.0.0.1
that this starts, and a scrape a second), and one with these and the page, which somebody looks at.
Which comes first changes from round to round. Times are wire to wire, as `risaf-link bench --only
live` has them.

The page belongs to another machine: here its processes take a core only when the service and who
measures do not want it, unless `--shared` lets them compete. On a machine with other work, `chrt -f
5 python ...` as root keeps that away: everything but the page has a real-time priority then.
"""

import argparse
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import product
from pathlib import Path
from statistics import median, quantiles

from risaf_link.bench.live import SEED, Course, Meter, drive, service
from risaf_link.bench.reading import COMMAND
from risaf_link.sim.scenario import Scenario, scenario

SCRAPER = """
import sys, time, urllib.request
while True:
    try:
        urllib.request.urlopen(sys.argv[1], timeout=5).read()
    except OSError:
        pass
    time.sleep(1.0)
"""
VIEWER = """
import sys, time, urllib.request
while True:
    try:
        for line in urllib.request.urlopen(sys.argv[1], timeout=5):
            pass
    except OSError:
        pass
    time.sleep(0.1)
"""
NAMES = {"none": "without", "some": "with MQTT and metrics", "all": "with the page as well"}


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--sensors", type=int, default=150)
    parser.add_argument("--rate", type=float, default=100.0)
    parser.add_argument("--shared", action="store_true", help="the page competes for the cores")
    told = parser.parse_args()
    # A short scenario starts again, and is then quick to make.
    length = min(told.seconds, 30.0 if told.rate <= 100.0 else 1.0)
    chosen = scenario("circle", SEED, sensors=told.sensors, rate=told.rate, duration=length)
    courses: dict[str, list[Course]] = {which: [] for which in NAMES}
    print("round        p50 us  p99 us  core %  MB    lost")
    with tempfile.TemporaryDirectory() as directory, mosquitto(Path(directory)) as broker:
        for k in range(told.rounds):
            for which in [*NAMES, *reversed(NAMES)][3 * (k % 2) :][:3]:
                course = run(chosen, told.seconds, broker, which, told.shared)
                courses[which].append(course)
                print(f"{k} {which:5} {figures(course)}", flush=True)
    for which, percent in product(list(NAMES)[1:], (50, 99)):
        pairs = [
            (percentile(a.latencies_us, percent), percentile(b.latencies_us, percent))
            for a, b in zip(courses["none"], courses[which], strict=True)
        ]
        ratios = sorted(after / before for before, after in pairs)
        before, after = (
            percentile([us for course in courses[name] for us in course.latencies_us], percent)
            for name in ("none", which)
        )
        print(
            f"p{percent}: {before:.0f} us {NAMES['none']}, {after:.0f} us {NAMES[which]}, of all "
            f"{after / before:.3f}; by round {median(ratios):.3f} ({ratios[0]:.3f} to "
            f"{ratios[-1]:.3f})"
        )


def run(chosen: Scenario, seconds: float, broker: int, which: str, shared: bool) -> Course:
    """Drive one service, with some outputs or all of them."""
    settings: list[str] = []
    links: list[str] = []
    meter = Meter()
    with ExitStack() as stack:
        stack.callback(meter.close)
        if which != "none":
            port = free_port()
            settings = [
                f"mqtt={{url: 'mqtt://127.0.0.1:{broker}', vehicle: bench}}",
                f"metrics={{listen: '127.0.0.1:{port}'}}",
            ]
            url = f"http://127.0.0.1:{port}/metrics"
            stack.enter_context(process([sys.executable, "-c", SCRAPER, url]))
        if which == "all":
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.bind(("127.0.0.1", 0))
                at = f"127.0.0.1:{probe.getsockname()[1]}"
            links = [f"{{name: page, url: 'udpin://{at}'}}"]
            page = f"127.0.0.1:{free_port()}"
            for command in (
                [*COMMAND, "monitor", f"udpout://{at}", "--listen", page],
                [sys.executable, "-c", VIEWER, f"http://{page}/updates"],
            ):
                started = stack.enter_context(process(command))
                if not shared:
                    give_way(started)
        number = stack.enter_context(service(meter, COMMAND, chosen.rate, settings, links))
        return drive(meter, number, chosen, seconds)


def give_way(number: int) -> None:
    """Let a process have a core only when we, and who has our priority, do not want it."""
    is_usual = os.sched_getscheduler(0) == os.SCHED_OTHER
    policy = os.SCHED_IDLE if is_usual else os.SCHED_OTHER
    os.sched_setscheduler(number, policy, os.sched_param(0))


def figures(course: Course) -> str:
    """A line of the table."""
    times = [percentile(course.latencies_us, percent) for percent in (50, 99)]
    memory = course.memory_mb[-1]
    return (
        f"{times[0]:7.0f} {times[1]:7.0f} {course.core_percent:7.1f} {memory:5.1f} "
        f"{course.unanswered:5d}"
    )


def percentile(values: list[float], percent: int) -> float:
    """Of the values."""
    return quantiles(values, n=100, method="inclusive")[percent - 1]


def free_port() -> int:
    """A port that nobody has now."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port: int = probe.getsockname()[1]
        return port


@contextmanager
def mosquitto(directory: Path) -> Iterator[int]:
    """Run a broker; its port."""
    program = shutil.which("mosquitto") or "/usr/sbin/mosquitto"
    port = free_port()
    file = directory / "mosquitto.conf"
    file.write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\nlog_type none\n")
    with process([program, "-c", str(file)]):
        until = time.monotonic() + 10.0
        while True:
            try:
                socket.create_connection(("127.0.0.1", port)).close()
                break
            except OSError:
                if time.monotonic() > until:
                    raise
                time.sleep(0.05)
        yield port


@contextmanager
def process(command: list[str]) -> Iterator[int]:
    """Run a program as long as it is needed; its process id."""
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as running:  # noqa: S603
        try:
            yield running.pid
        finally:
            running.terminate()


if __name__ == "__main__":
    main()
