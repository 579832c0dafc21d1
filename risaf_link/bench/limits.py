"""What bounds all of it on this machine: bytes copied, bytes summed, numbers brought in order."""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from fastcrc import crc16

from risaf_link.bench.epoch import SEED
from risaf_link.bench.extent import Extent
from risaf_link.bench.figure import Figure, Spread, seconds_of

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
        quantiles = sensors // 5, sensors - sensors // 5
        for key, name, work in (
            ("sum", "summed", partial(np.sum, values, axis=1)),
            ("select", "parted at two quantiles", partial(np.partition, values, quantiles)),
            ("sort", "sorted", partial(np.sort, values)),
        ):
            text = f"3 x {sensors} numbers {name}, NumPy"
            taken = seconds_of(partial(_many, work), extent.repeats)
            spread = Spread.of([seconds * 1e6 / CALLS for seconds in taken])
            yield Figure(f"limit_{key}_{sensors}", text, "us", spread)


def _many(work: Callable[[], object]) -> None:
    for _ in range(CALLS):
        work()


def _speed(key: str, text: str, size: int, taken: list[float]) -> Figure:
    rates = Spread.of([size / 1e6 / seconds for seconds in taken])
    return Figure(key, text, "MB/s", rates, more_is_better=True)
