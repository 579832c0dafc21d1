"""What MQTT and metrics cost the estimator: latencies with and without them, by turns in one run.

python benchmarks/outputs.py [--rounds N] [--seconds S] [--sensors N] [--rate HZ]

A round is a run of the service without outputs and one with both: a mosquitto on 127.0.0.1 that
this starts, and a scrape a second. Which comes first changes from round to round. Times are wire to
wire, as `risaf-link bench --only live` has them.
"""

import argparse
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
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


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--sensors", type=int, default=150)
    parser.add_argument("--rate", type=float, default=100.0)
    told = parser.parse_args()
    # A short scenario starts again, and is then quick to make.
    length = min(told.seconds, 30.0 if told.rate <= 100.0 else 1.0)
    chosen = scenario("circle", SEED, sensors=told.sensors, rate=told.rate, duration=length)
    courses: dict[str, list[Course]] = {"without": [], "with": []}
    print("round        p50 us  p99 us  core %  MB    lost")
    with tempfile.TemporaryDirectory() as directory, mosquitto(Path(directory)) as broker:
        for k in range(told.rounds):
            for which in sorted(courses, reverse=bool(k % 2)):
                course = run(chosen, told.seconds, broker if which == "with" else None)
                courses[which].append(course)
                print(f"{k} {which:8} {figures(course)}", flush=True)
    for percent in (50, 99):
        pairs = [
            (percentile(a.latencies_us, percent), percentile(b.latencies_us, percent))
            for a, b in zip(courses["without"], courses["with"], strict=True)
        ]
        ratios = sorted(after / before for before, after in pairs)
        pooled = [
            percentile([us for course in courses[which] for us in course.latencies_us], percent)
            for which in ("without", "with")
        ]
        print(
            f"p{percent}: {pooled[0]:.0f} us without, {pooled[1]:.0f} us with, of all; "
            f"ratio by round {median(ratios):.3f} ({ratios[0]:.3f} to {ratios[-1]:.3f})"
        )


def run(chosen: Scenario, seconds: float, broker: int | None) -> Course:
    """Drive one service, with both outputs where there is a broker."""
    settings: list[str] = []
    meter = Meter()
    with ExitStack() as stack:
        stack.callback(meter.close)
        if broker is not None:
            port = free_port()
            settings = [
                f"mqtt={{url: 'mqtt://127.0.0.1:{broker}', vehicle: bench}}",
                f"metrics={{listen: '127.0.0.1:{port}'}}",
            ]
            url = f"http://127.0.0.1:{port}/metrics"
            stack.enter_context(process([sys.executable, "-c", SCRAPER, url]))
        number = stack.enter_context(service(meter, COMMAND, chosen.rate, settings))
        return drive(meter, number, chosen, seconds)


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
def process(command: list[str]) -> Iterator[None]:
    """Run a program as long as it is needed."""
    with subprocess.Popen(command) as running:  # noqa: S603
        try:
            yield
        finally:
            running.terminate()


if __name__ == "__main__":
    main()
