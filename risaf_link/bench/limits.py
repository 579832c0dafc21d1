"""What bounds all of it on this machine: bytes copied, bytes summed, numbers brought in order."""

from collections.abc import Iterator

import numpy as np
from fastcrc import crc16

from risaf_link.bench.epoch import SEED
from risaf_link.bench.extent import Extent
from risaf_link.bench.figure import Figure, Spread, seconds_of, spread_of

COPIED = 64 << 20  # bytes, more than the caches of most machines hold
SUMMED = 4 << 20  # bytes
CALLS = 1000


def limits(extent: Extent) -> Iterator[Figure]:
    """Memory, the checksum of MAVLink, and selection among 150 and 300 values of three axes."""
    source = np.random.default_rng(SEED).integers(0, 256, COPIED, np.uint8)
    target = np.empty_like(source)
    taken = seconds_of(lambda: np.copyto(target, source), extent.repeats)
    yield _speed("limit_copy", "memory copied", COPIED, taken)
    summed = source[:SUMMED].tobytes()
    taken = seconds_of(lambda: crc16.mcrf4xx(summed), extent.repeats)
    yield _speed("limit_checksum", "checksum of bytes in one piece, fastcrc", SUMMED, taken)
    for sensors in (150, 300):
        values = np.random.default_rng(SEED).normal(size=(3, sensors))
        low, high = sensors // 5, sensors - sensors // 5
        for key, name, work in (
            ("read", "summed", lambda v: v.sum(axis=1)),
            ("select", "parted at two quantiles", lambda v: np.partition(v, (low, high))),
            ("sort", "sorted", np.sort),
        ):

            def repeated(work: object = work, values: object = values) -> None:
                for _ in range(CALLS):
                    work(values)  # type: ignore[operator]

            text = f"3 x {sensors} numbers {name}, NumPy"
            spread = spread_of(repeated, extent.repeats, 1e6 / CALLS)
            yield Figure(f"limit_{key}_{sensors}", text, "us", spread)


def _speed(key: str, text: str, size: int, taken: list[float]) -> Figure:
    rates = Spread.of([size / 1e6 / seconds for seconds in taken])
    return Figure(key, text, "MB/s", rates, more_is_better=True)
