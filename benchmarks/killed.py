"""Kill the service at random moments, and see what its recording holds.

The service gets a simulated array over UDP, some epochs ahead of what it has answered, and records
in segments of a megabyte. After a random number of answers, and a random moment more, it gets
SIGKILL. Then the recording must be whole records from the first byte to the last, and hold

- all frames that were sent before the last answered epoch was whole, in order, none twice, and of
  what was sent after it what the service had taken by then;
- everything that the service had answered: the recording stands first among its links.

    python benchmarks/killed.py --kills 200
"""

import argparse
import os
import random
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from statistics import median

from risaf_link.bench.feed import Burst, bursts
from risaf_link.bench.live import Meter
from risaf_link.mavlink.dialect import IDS
from risaf_link.sim.scenario import scenario

SENSORS = 150
AHEAD = 12  # epochs on their way: 48 datagrams, which the service's socket holds
MOST_ANSWERS = 3000  # three segments
SAFETY_S = 30.0
LONGEST_PAUSE_S = 0.002  # from the last answer that counts to the kill: some epochs' work
SEGMENT_BYTES = 1_000_000
STAMP, RECEIVED, SENT = 8, 0, 3
MARK_V2, HEAD, CHECKSUM = 0xFD, 10, 2


@dataclass(frozen=True, slots=True)
class Outcome:
    """What was found after one kill."""

    sent: int  # frames
    recorded: int  # of them
    answered: int  # epochs
    segments: int
    lasted_s: float  # from the kill to the end of the recorder


class NotWholeError(AssertionError):
    """The recording does not hold what it should."""


def kill_once(folder: Path, seed: int, most_answers: int = MOST_ANSWERS) -> Outcome:
    """Run the service, kill it, and judge its recording.

    Parameters
    ----------
    folder : Path
        An empty one.
    seed : int
        Of the moment.
    most_answers : int
        Epochs that are answered at most before it.

    Raises
    ------
    NotWholeError
        If anything is missing.
    """
    moment = random.Random(seed)  # noqa: S311
    answers, pause_s = moment.randint(1, most_answers), moment.uniform(0.0, LONGEST_PAUSE_S)
    meter = Meter()
    try:
        command = _command(folder / "drive.tlog", meter.port)
        with subprocess.Popen(command) as service:  # noqa: S603
            try:
                meter.meet()
                _wait_for(folder / "drive.tlog")
                recorder = os.pidfd_open(child(service.pid))
                sent = _drive(meter, answers)
                until = time.perf_counter() + pause_s
                while time.perf_counter() < until:
                    pass
            finally:
                service.send_signal(signal.SIGKILL)
        began = time.perf_counter()
        if not select.select([recorder], [], [], SAFETY_S)[0]:
            raise NotWholeError(f"the recorder has not ended in {SAFETY_S:.0f} s")
        lasted_s = time.perf_counter() - began
        os.close(recorder)
        meter.hear(0.0)  # what was answered before the kill
    finally:
        meter.close()
    return _judge(folder, sent, set(meter.answered), lasted_s)


def _command(path: Path, port: int) -> list[str]:
    emit = "emit: {ATTITUDE_QUATERNION: 10000}"
    limits = f"recording: {{segment_bytes: {SEGMENT_BYTES}, least_free_bytes: 0}}"
    links = (
        f"{{name: recording, url: 'tlog://{path}', {emit}, {limits}}}, "
        f"{{name: meter, url: 'udpout://127.0.0.1:{port}', {emit}}}"
    )
    return [sys.executable, "-m", "risaf_link.cli", "run", "--set", f"links=[{links}]"]


def _wait_for(path: Path) -> None:
    """Wait for the recorder: before it reads, only as much as a pipe holds outlives the service."""
    until = time.perf_counter() + SAFETY_S
    while not path.exists():
        if time.perf_counter() > until:
            raise NotWholeError(f"{path} has not come in {SAFETY_S:.0f} s")
        time.sleep(0.001)


def _drive(meter: Meter, answers: int) -> list[Burst]:
    """Send epochs until so many are answered; what was sent."""
    chosen = scenario("circle", seed=1, sensors=SENSORS, duration=1.0)
    source = bursts(chosen, seconds=1e6)
    sent: list[Burst] = []
    epochs = 0
    until = time.perf_counter() + SAFETY_S + 0.01 * answers
    while len(meter.answered) < answers:
        if time.perf_counter() > until:
            raise NotWholeError(f"{len(meter.answered)} of {epochs} epochs were answered")
        if epochs - len(meter.answered) < AHEAD:
            (burst,) = islice(source, 1)
            meter.send(burst)
            sent.append(burst)
            epochs += burst.stamp_ms is not None
            meter.hear(0.0)
        else:
            meter.hear(0.1)
    return sent


def _judge(folder: Path, sent: list[Burst], answered: set[int], lasted_s: float) -> Outcome:
    files = in_order(folder)
    held = [record for path in files for record in records(path)]
    received = [raw for link, raw in held if link == RECEIVED]
    frames = [raw for burst in sent for raw in burst.frames]
    if received != frames[: len(received)]:
        raise NotWholeError("what was received is not what was sent, in its order")
    needed = 0
    for number, burst in enumerate(sent):
        if burst.stamp_ms in answered:
            needed = sum(len(each.frames) for each in sent[: number + 1])
    if len(received) < needed:
        raise NotWholeError(f"{needed - len(received)} frames of answered epochs are missing")
    told = Counter(raw for link, raw in held if link == SENT)
    stamps = {_stamp_ms(raw) for raw in told if _is_attitude(raw)}
    if not answered <= stamps:
        raise NotWholeError(f"{len(answered - stamps)} answers are missing")
    if max(path.stat().st_size for path in files) > SEGMENT_BYTES:
        raise NotWholeError("a segment is too long")
    return Outcome(len(frames), len(received), len(answered), len(files), lasted_s)


def in_order(folder: Path) -> list[Path]:
    """The segments of a recording, the oldest first."""
    return sorted(folder.glob("drive*.tlog"), key=lambda path: int("0" + path.name[6:-5]))


def records(path: Path) -> Iterator[tuple[int, bytes]]:
    """Number of the link and frame of each record; there must be nothing else.

    Raises
    ------
    NotWholeError
        If there is.
    """
    data, at = path.read_bytes(), 0
    while at < len(data):
        start = at + STAMP
        if len(data) < start + HEAD or data[start] != MARK_V2 or data[start + 2]:
            raise NotWholeError(f"{path}: no record at byte {at} of {len(data)}")
        end = start + HEAD + data[start + 1] + CHECKSUM
        if end > len(data):
            raise NotWholeError(f"{path}: half a record at byte {at}")
        yield data[start - 1] & 3, data[start:end]
        at = end


def _is_attitude(raw: bytes) -> bool:
    return int.from_bytes(raw[7:HEAD], "little") == IDS["ATTITUDE_QUATERNION"]


def _stamp_ms(raw: bytes) -> int:
    return int.from_bytes(raw[HEAD : HEAD + 4], "little")


def child(parent: int) -> int:
    """The one process that a process has started."""
    for process in Path("/proc").iterdir():
        if process.name.isdecimal():
            try:
                fields = (process / "stat").read_text().rpartition(")")[2].split()
            except OSError:  # it has ended
                continue
            if int(fields[1]) == parent:
                return int(process.name)
    raise NotWholeError("there is no recorder")


def main() -> None:
    """Kill many times, and sum up."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1, help="of the first; the others follow")
    options = parser.parse_args()
    outcomes, failures = [], 0
    for seed in range(options.seed, options.seed + options.kills):
        with tempfile.TemporaryDirectory(prefix="killed") as folder:
            try:
                outcomes.append(kill_once(Path(folder), seed))
            except NotWholeError as error:
                failures += 1
                print(f"seed {seed}: {error}", flush=True)
    lasted = [one.lasted_s for one in outcomes]
    print(
        f"{options.kills} kills, {failures} recordings that are not whole; "
        f"{sum(one.answered for one in outcomes)} epochs answered, "
        f"{sum(one.sent for one in outcomes)} frames sent, "
        f"{sum(one.recorded for one in outcomes)} recorded in "
        f"{sum(one.segments for one in outcomes)} files; the recorder ended "
        f"{1e3 * median(lasted):.0f} ms after the kill, {1e3 * max(lasted):.0f} ms at most"
    )
    sys.exit(failures > 0)


if __name__ == "__main__":
    main()
