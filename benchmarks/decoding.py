"""How fast telemetry logs are read.

    risaf-link simulate drive1 --seed 1 --out drive1.tlog
    python benchmarks/decoding.py drive1.tlog
    python benchmarks/decoding.py --rivals sitl_fixtures/rover_mavproxy.tlog

For every log, how many frames or epochs are found, how long that takes, MB/s and time for each, of

- `tables`: every frame found, its checksum verified, its time believed or replaced;
- `epochs`: moreover, the samples of an array put together to epochs, as the estimator takes them,
  and every other message that the estimator reads, read;
- `frame_by_frame`: the same without blocks;

and, with `--rivals`, `recv_match` of pymavlink and `fasttlogparser` where it is installed. Those
read every field; the latter complains of each message that is not in its own dialect.
"""

import argparse
import time
from importlib.util import find_spec
from pathlib import Path

from risaf_link.bench.reading import recv_match, tables
from risaf_link.core.fusion import EpochBlock
from risaf_link.links.file import read
from risaf_link.mavlink.block import BlockReader
from risaf_link.mavlink.epoch import ArrayParameters, EpochAssembler, GyroChunk
from risaf_link.mavlink.frame import Frame
from risaf_link.mavlink.ingest import GpsParameters, Ingest
from risaf_link.mavlink.tlog import TlogReader


class Decoder:
    """What comes before the estimator."""

    def __init__(self) -> None:
        parameters = ArrayParameters()
        self.ingest = Ingest(parameters, GpsParameters(), (1, 191))
        self.assembler = EpochAssembler(parameters)

    def step(self, frame: Frame, received_us: int) -> None:
        """Take one frame."""
        datum = self.ingest.decode(frame, received_us)
        if isinstance(datum, GyroChunk):
            self.assembler.add(datum)


def epochs(path: Path) -> int:
    """Count the epochs in blocks, and those between."""
    decoder = Decoder()
    blocks = BlockReader(decoder.ingest, decoder.assembler)
    for table, times_us in TlogReader(read(path)).tables():
        for item in blocks.read(table, times_us):
            if not isinstance(item, EpochBlock):
                decoder.step(*item)
    return decoder.assembler.counts["epochs"]


def frame_by_frame(path: Path) -> int:
    """Count the epochs, one by one."""
    decoder = Decoder()
    for time_us, frame in TlogReader(read(path)):
        decoder.step(frame, time_us)
    return decoder.assembler.counts["epochs"]


def fasttlogparser(path: Path) -> int:
    """Count the messages that fasttlogparser finds."""
    import fasttlogparser as parser

    messages, _ = parser.parseTLog(str(path))
    return sum(len(next(iter(fields.values()))) for fields in messages.values())


def main() -> None:
    """Measure, and print a table of the best runs."""
    options = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    options.add_argument("logs", nargs="+", type=Path)
    options.add_argument("--runs", type=int, default=5)
    options.add_argument("--rivals", action="store_true")
    asked = options.parse_args()
    readers = [(tables, asked.runs), (epochs, asked.runs), (frame_by_frame, 1)]
    if asked.rivals:
        readers.append((recv_match, 1))
    if asked.rivals and find_spec("fasttlogparser"):
        readers.append((fasttlogparser, asked.runs))
    print(f"{'log':32} {'reader':16} {'found':>8} {'ms':>9} {'MB/s':>8} {'us each':>8}")
    for path in asked.logs:
        size = path.stat().st_size
        for reader, runs in readers:
            seconds = []
            for _ in range(runs):
                began = time.perf_counter()
                found = reader(path)
                seconds.append(time.perf_counter() - began)
            best = min(seconds)
            speed, each = size / best / 1e6, best / max(found, 1) * 1e6
            row = f"{found:8} {best * 1e3:9.1f} {speed:8.1f} {each:8.2f}"
            print(f"{path.name:32} {reader.__name__:16} {row}")


if __name__ == "__main__":
    main()
