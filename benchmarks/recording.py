"""What a recording costs the service: latency and processor time, with and without, in turn.

python benchmarks/recording.py --rounds 5
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median, quantiles

from killed import child

from risaf_link.bench.live import Course, Meter, drive, memory_mb, worked_s
from risaf_link.links import recorder
from risaf_link.links.tlog import Pipes
from risaf_link.sim.scenario import scenario

SEED = 1
RECORD_BYTES = 274  # of 40 sensors
SHARE = {True: "with", False: "without"}
COMMAND = (sys.executable, "-m", "risaf_link.cli")


@contextmanager
def service(meter: Meter, folder: Path, rate: float, recorded: bool) -> Iterator[int]:
    """Run the service; its process id."""
    rates = f"emit: {{ATTITUDE_QUATERNION: {2 * rate}, ARRAY_STATUS: 5}}"
    links = f"{{name: meter, url: 'udpout://127.0.0.1:{meter.port}', {rates}}}"
    if recorded:
        links += f", {{name: recording, url: 'tlog://{folder}/drive.tlog'}}"
    command = [*COMMAND, "run", "--set", f"links=[{links}]"]
    with subprocess.Popen(command) as process:  # noqa: S603
        try:
            meter.meet()
            yield process.pid
        finally:
            process.terminate()


def course(
    sensors: int, rate: float, seconds: float, recorded: bool
) -> tuple[Course, float, float]:
    """One run; also the recorder's share of a core, %, and its memory, MB."""
    chosen = scenario("circle", SEED, sensors=sensors, rate=rate, duration=min(1.0, seconds / 2))
    meter = Meter()
    with tempfile.TemporaryDirectory(prefix="recording") as folder:
        try:
            with service(meter, Path(folder), rate, recorded) as process:
                writer = child(process) if recorded else None
                began, before_s = time.perf_counter(), worked_s(writer) if writer else 0.0
                one = drive(meter, process, chosen, seconds)
                passed_s = time.perf_counter() - began
                after_s = worked_s(writer) if writer else 0.0
                share = 100.0 * (after_s - before_s) / passed_s
                return one, share, memory_mb(writer) if writer else 0.0
        finally:
            meter.close()


def compare(sensors: int, rate: float, seconds: float, rounds: int) -> None:
    """Measure with and without in turn, and print."""
    courses: dict[bool, list[tuple[Course, float, float]]] = {True: [], False: []}
    for _ in range(rounds):
        for recorded, done in courses.items():
            done.append(course(sensors, rate, seconds, recorded))
    print(f"{sensors} gyros at {rate:.0f} Hz, {rounds} runs of {seconds:.0f} s each")
    for recorded, done in courses.items():
        latencies = [one for run, _, _ in done for one in run.latencies_us]
        percentiles = quantiles(latencies, n=100)
        print(
            f"  {SHARE[recorded]:8s} p50 {percentiles[49]:6.0f} us  p99 {percentiles[98]:6.0f} us"
            f"  service {median(run.core_percent for run, _, _ in done):5.2f} % of a core"
            f"  recorder {median(share for _, share, _ in done):5.2f} %,"
            f" {median(memory for _, _, memory in done):4.1f} MB"
            f"  unanswered {sum(run.unanswered for run, _, _ in done)}"
        )


def handing_over(records: int, repeats: int = 20_000) -> float:
    """Handing over an epoch's frames, us: a system call, while the recorder writes."""
    data = bytes(RECORD_BYTES) * records
    with tempfile.TemporaryDirectory(prefix="recording") as folder:
        pipes = Pipes()
        options = {
            "path": f"{folder}/drive.tlog",
            "segment_bytes": 256_000_000,
            "segment_s": 3600.0,
            "retry_s": 1.0,
            "pipes": pipes.outs,
        }
        command = [sys.executable, "-I", "-S", recorder.__file__, json.dumps(options)]
        with subprocess.Popen(  # noqa: S603
            command, stdout=subprocess.DEVNULL, pass_fds=pipes.outs
        ):
            times = []
            for number in range(repeats):
                began = time.perf_counter()
                pipes.put(data, records)
                times.append(time.perf_counter() - began)
                if number % 20 == 0:
                    time.sleep(0.005)
            pipes.close()
    return 1e6 * median(times)


def main() -> None:
    """Compare at both rates."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args()
    for count in (1, 4, 8):
        text = f"{count} records of {RECORD_BYTES} bytes handed over together"
        print(f"{text}: {handing_over(count):.2f} us, median")
    compare(150, 100.0, options.seconds, options.rounds)
    compare(300, 1000.0, options.seconds, options.rounds)


if __name__ == "__main__":
    main()
