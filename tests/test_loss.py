"""A drive on a bad link: its heading degrades and does not lie. `benchmarks/loss.py` has curves."""

from functools import cache

import pytest
from spoiled import BURST, HEADER, SOURCES, Errors, Receiver, Spoil, resealed

from risaf_link.mavlink.dialect import IDS
from risaf_link.sim.scenario import scenario
from risaf_link.sim.stream import EPOCH_START_US, frames

DRIVE = scenario("drive2", 1, sensors=20, duration=60.0)  # on a rough road, shocks and all
EPOCHS = 6000
SCALE = 8  # of gyros, in the payload of IMU_ARRAY_INFO: a float
INFO = IDS["IMU_ARRAY_INFO"].to_bytes(3, "little")


@cache
def datagrams():
    return tuple(frames(DRIVE, SOURCES))


def driven(arriving):
    receiver, errors = Receiver(), Errors()
    for time_us, data in arriving:
        errors.note(receiver.take(data, EPOCH_START_US + time_us), time_us)
    return errors.judge(DRIVE, EPOCHS), receiver


@pytest.mark.parametrize(
    ("way", "answered"),
    [
        (Spoil(), 0.75),
        (Spoil(lost=0.5), 0.35),
        (Spoil(lost=0.1, burst=BURST), 0.6),
        (Spoil(lost=0.5, burst=BURST), 0.3),
        (Spoil(flipped=1e-3), 0.05),
        (Spoil(forged=1e-2), 0.75),
    ],
    ids=["whole", "half lost", "bursts", "half lost in bursts", "garbled", "wrong frames"],
)
def test_heading_lies_within_three_deviations_whatever_is_lost_or_wrong(way, answered):
    verdict, _ = driven(way.apply(datagrams(), seed=1))
    assert verdict.answered > answered
    assert verdict.lies < 0.003
    assert verdict.astray <= EPOCHS * way.forged / 10  # a stamp that is wrong by little


def test_bursts_make_heading_worse_and_so_its_stated_deviation():
    whole, _ = driven(datagrams())
    lossy, _ = driven(Spoil(lost=0.5, burst=BURST).apply(datagrams(), seed=1))
    assert lossy.std.mean() > 1.2 * whole.std.mean()


def test_garbled_datagrams_are_dropped_and_counted():
    _, receiver = driven(Spoil(flipped=1e-3).apply(datagrams(), seed=2))
    arrived = len(datagrams())
    assert receiver.frames < 0.3 * arrived  # nine in ten have a bit that is wrong
    assert receiver.dropped()["checksum"] > 0.1 * arrived  # the others are not even frames


def test_a_single_wrong_scale_turns_nothing():
    """IMU_ARRAY_INFO with one bit of the scale's exponent wrong, and a checksum that holds."""

    def with_a_lie():
        done = False
        for time_us, raw in datagrams():
            is_it = not done and time_us > 40e6 and raw[7:HEADER] == INFO
            yield time_us, resealed(raw, HEADER + SCALE + 2, 0x80) if is_it else raw
            done |= is_it

    verdict, receiver = driven(with_a_lie())
    assert receiver.pipeline.ingest.counts["contested"] == 1
    assert verdict.lies == 0.0
