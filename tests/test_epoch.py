"""Chunks become whole epochs, in order, whatever the order and the losses of their frames."""

import os
import pickle
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.epoch import (
    MAX_SENSORS,
    REVIEW,
    SHRINK_AFTER,
    ArrayParameters,
    EpochAssembler,
    GyroChunk,
    Source,
)
from risaf_link.mavlink.ingest import GpsParameters, Ingest
from risaf_link.mavlink.tlog import TlogReader

ARRAY = Source(1, 158, "GYRO_ARRAY", 0)
AUTOPILOT = Source(1, 1, "IMU", 0)
PERIOD_US = 10_000
START_US = 5_000_000
NOTHING = np.zeros((0, 3))
SECOND = 1_000_000


def reading(time_us, sensors):
    """What sensors read at a time: each of its own."""
    return np.asarray(sensors)[:, None] * 1e-3 + time_us * 1e-6 * np.array([1.0, 10.0, 100.0])


def chunk(k, first=0, count=2, source=ARRAY, *, time_us=None, received_us=None, **told):
    """Rates of some sensors in epoch k."""
    time_us = START_US + k * PERIOD_US if time_us is None else time_us
    received_us = time_us if received_us is None else received_us
    rates = reading(time_us, range(first, first + count))
    return GyroChunk(source, time_us, received_us, first, rates, NOTHING, **told)


def forces(k, first=0, count=2, late_us=0):
    """Specific forces of some sensors; `late_us`: read so much after epoch k."""
    time_us = START_US + k * PERIOD_US + late_us
    values = -reading(time_us, range(first, first + count))
    return GyroChunk(ARRAY, time_us, time_us, first, NOTHING, values)


def epoch_of(k, parts=((0, 2), (2, 2)), **told):
    """The chunks of a whole epoch."""
    told.setdefault("sequence", k % 65536)
    return [chunk(k, first, count, **told) for first, count in parts]


def stream(epochs, parts=((0, 2), (2, 2)), **told):
    return [one for k in epochs for one in epoch_of(k, parts, **told)]


def assembler(*chunks, **parameters):
    """An assembler that has taken some chunks."""
    made = EpochAssembler(ArrayParameters(**parameters))
    feed(made, chunks)
    return made


def feed(into, chunks):
    return [epoch for one in chunks for epoch in into.add(one)]


def run(chunks, **parameters):
    """All epochs of a stream, and the counts."""
    made = EpochAssembler(ArrayParameters(**parameters))
    return feed(made, chunks) + made.flush(), made.counts


def numbers(epochs):
    return [(epoch.time_us - START_US) // PERIOD_US for epoch in epochs]


def samples(epochs):
    return sum(int((~np.isnan(e.rates_b[:, 0])).sum()) for e in epochs)


class TestWholeEpochs:
    def test_are_handed_on_with_their_last_chunk(self):
        made = assembler(*stream(range(10)))
        assert [numbers(made.add(one)) for one in epoch_of(10)] == [[], [10]]

    def test_hold_each_reading_at_its_place(self):
        epochs, counts = run(stream(range(10), ((0, 40), (40, 40), (80, 20))))
        assert numbers(epochs) == list(range(10))
        for epoch in epochs:
            assert (epoch.rates_b == reading(epoch.time_us, range(100))).all()
            assert (epoch.lost, epoch.forces_b.shape) == (0, (0, 3))
        assert counts == Counter(epochs=10)

    def test_know_the_time_since_the_one_before(self):
        epochs, _ = run(stream([0, 1, 2, 4]))
        assert [epoch.dt for epoch in epochs] == [0.0, 0.01, 0.01, 0.02]

    def test_come_at_once_from_an_array_that_says_how_many_sensors_it_has(self):
        made = assembler()
        assert [len(made.add(one)) for one in stream(range(3), sensors=4)] == [0, 1] * 3

    def test_come_at_once_where_the_configuration_says_it(self):
        made = assembler(sensors=4)
        assert [len(made.add(one)) for one in stream(range(3))] == [0, 1] * 3

    def test_wait_at_first_where_nobody_says_it(self):
        made = assembler()
        assert [len(made.add(one)) for one in stream(range(4))] == [0] * 6 + [3, 1]
        assert made.sensors == 4


class TestLoss:
    def test_an_incomplete_epoch_is_used_with_what_it_has(self):
        chunks = stream(range(20))
        del chunks[21]  # sensors 2 and 3 of epoch 10
        epochs, counts = run(chunks)
        assert numbers(epochs) == list(range(20))
        assert np.isnan(epochs[10].rates_b[:, 0]).tolist() == [False, False, True, True]
        assert (epochs[10].lost, epochs[11].lost) == (2, 0)
        assert counts == Counter(epochs=20, incomplete=1, samples_lost=2)

    def test_epochs_wait_for_a_lost_chunk_no_longer_than_configured(self):
        made = assembler(*stream(range(10)), max_wait=0.025)
        made.add(epoch_of(10)[0])
        assert [len(feed(made, epoch_of(k))) for k in (11, 12, 13, 14)] == [0, 0, 4, 1]

    def test_a_whole_epoch_that_is_lost_is_counted_by_its_number(self):
        _, counts = run(stream([*range(10), 11, 12, 15]))
        assert counts == Counter(epochs=13, samples_lost=3 * 4)

    def test_or_by_time_where_epochs_have_no_number(self):
        _, counts = run(stream([*range(10), 11, 12, 15], sequence=None))
        assert counts == Counter(epochs=13, samples_lost=3 * 4)

    def test_a_burst_costs_nothing_but_what_was_lost(self):
        epochs, counts = run(stream([*range(100), *range(150, 250)]))
        assert numbers(epochs) == [*range(100), *range(150, 250)]
        assert counts == Counter(epochs=200, samples_lost=50 * 4)

    def test_nothing_that_arrived_is_lost_at_30_percent_loss_and_reordering(self):
        random = np.random.default_rng(5)
        parts = ((0, 40), (40, 40), (80, 40), (120, 30))
        sent = [one for one in stream(range(1000), parts) if random.random() > 0.3]
        delays = np.arange(len(sent)) + random.uniform(0, 10, len(sent))
        epochs, counts = run([sent[i] for i in np.argsort(delays)], max_wait=0.06)
        assert samples(epochs) == sum(len(one.rates_s) for one in sent)
        assert counts["late"] == counts["duplicate"] == 0
        assert samples(epochs) + counts["samples_lost"] == 150 * 1000


class TestOrder:
    def test_a_late_chunk_joins_its_epoch_while_that_waits(self):
        chunks = stream(range(20))
        chunks.insert(24, chunks.pop(21))
        epochs, counts = run(chunks)
        assert numbers(epochs) == list(range(20))
        assert counts == Counter(epochs=20)

    def test_a_chunk_that_is_too_late_is_counted(self):
        chunks = stream(range(20))
        chunks.insert(35, chunks.pop(21))
        _, counts = run(chunks)
        assert counts == Counter(epochs=20, incomplete=1, samples_lost=2, late=2)

    def test_so_is_an_epoch_that_is_too_late(self):
        chunks = stream(range(20))
        chunks[35:35] = chunks[20:22]
        del chunks[20:22]
        epochs, counts = run(chunks)
        assert 10 not in numbers(epochs)
        assert counts == Counter(epochs=19, samples_lost=4, late=4)

    def test_epochs_of_one_chunk_that_change_places_are_put_in_order(self):
        order = [*range(10), 11, 10, 12, 14, 13, 15]
        for sequence in ({}, {"sequence": None}):
            epochs, counts = run(stream(order, ((0, 3),), **sequence))
            assert numbers(epochs) == list(range(16))
            assert counts == Counter(epochs=16)

    def test_duplicates_are_counted_and_change_nothing(self):
        chunks = stream(range(20))
        once, _ = run(chunks)
        twice, counts = run([one for one in chunks for _ in range(2)])
        assert counts == Counter(epochs=20, duplicate=80)
        for a, b in zip(once, twice, strict=True):
            assert (a.rates_b == b.rates_b).all()

    def test_a_second_link_that_lags_is_a_source_of_duplicates(self):
        lagging = [
            one
            for pair in zip(stream(range(20, 60)), stream(range(40)), strict=True)
            for one in pair
        ]
        epochs, counts = run(stream(range(20)) + lagging)
        assert numbers(epochs) == list(range(60))
        assert counts == Counter(epochs=60, duplicate=160)

    @given(st.data())
    def test_whatever_is_lost_doubled_and_reordered(self, data):
        parts = data.draw(st.sampled_from([((0, 3),), ((0, 2), (2, 2)), ((0, 1), (1, 2), (3, 1))]))
        numbered = data.draw(st.booleans())
        sent = stream(range(30), parts, **({} if numbered else {"sequence": None}))
        copies = data.draw(
            st.lists(st.sampled_from([1, 1, 1, 0, 2]), min_size=len(sent), max_size=len(sent))
        )
        arrived = [one for one, n in zip(sent, copies, strict=True) for _ in range(n)]
        delays = data.draw(
            st.lists(st.integers(0, 10), min_size=len(arrived), max_size=len(arrived))
        )
        order = sorted(range(len(arrived)), key=lambda i: i + delays[i])
        wait = data.draw(st.sampled_from([0.0, 0.025, 0.15]))
        epochs, counts = run([arrived[i] for i in order], max_wait=wait)

        times_us = [epoch.time_us for epoch in epochs]
        assert times_us == sorted(set(times_us))
        for epoch in epochs:
            right = reading(epoch.time_us, range(len(epoch.rates_b)))
            assert (np.isnan(epoch.rates_b) | (epoch.rates_b == right)).all()
        sensors_in = sum(len(one.rates_s) for one in arrived)
        assert sensors_in == samples(epochs) + counts["late"] + counts["duplicate"]
        assert counts["incomplete"] == sum(epoch.lost > 0 for epoch in epochs)
        if wait == 0.15 and numbered:
            assert counts["late"] == 0


class TestSizeOfTheArray:
    def test_is_what_the_array_says_even_if_some_never_come(self):
        epochs, counts = run(stream(range(5), ((0, 3),), sensors=5))
        assert {epoch.rates_b.shape for epoch in epochs} == {(5, 3)}
        assert counts == Counter(epochs=5, incomplete=5, samples_lost=10)

    def test_grows_at_once_and_the_growing_epoch_is_whole(self):
        made = assembler(*stream(range(10)))
        epochs = feed(made, stream(range(10, 13), ((0, 2), (2, 2), (4, 2)))) + made.flush()
        assert made.sensors == 6
        assert numbers(epochs) == [10, 11, 12]
        assert not np.isnan(epochs[-1].rates_b).any()
        assert made.counts["size_changes"] == 1

    def test_grows_although_the_new_sensors_come_when_the_epoch_seems_whole(self):
        epochs, counts = run(stream(range(10)) + stream(range(10, 20), ((0, 2), (2, 2), (4, 2))))
        assert [len(e.rates_b) for e in epochs] == [4] * 11 + [6] * 9
        assert counts == Counter(epochs=20, late=2, size_changes=1)

    def test_shrinks_when_the_array_says_so(self):
        epochs, counts = run(
            stream(range(5), sensors=4) + stream(range(5, 10), ((0, 3),), sensors=3)
        )
        assert [len(epoch.rates_b) for epoch in epochs] == [4] * 5 + [3] * 5
        assert counts == Counter(epochs=10, size_changes=1)

    def test_shrinks_when_the_last_sensors_have_been_silent_for_long(self):
        made = assembler(*stream(range(10)))
        feed(made, stream(range(10, 2 * SHRINK_AFTER + 10), ((0, 2),)))
        assert made.sensors == 2
        assert made.counts["size_changes"] == 1
        assert made.counts["samples_lost"] <= 2 * 2 * REVIEW

    def test_does_not_depend_on_where_one_starts_to_listen(self):
        made = assembler(*stream(range(5), ((0, 2), (2, 2), (4, 2)))[2:])
        assert made.sensors == 6
        assert made.counts == Counter(epochs=5, incomplete=1, samples_lost=4)

    def test_has_an_end(self):
        made = assembler(*stream(range(5)))
        assert made.add(chunk(5, first=65535)) == []
        assert made.add(chunk(5, first=MAX_SENSORS - 1)) == []
        assert (made.sensors, made.counts["out_of_range"]) == (4, 4)


class TestSensorsThatAreRare:
    """Nobody waits for them."""

    def test_a_sensor_that_falls_silent_holds_up_the_others_only_for_a_while(self):
        made = assembler(*stream(range(200)))
        feed(made, stream(range(200, 500), ((0, 2),)))
        assert [numbers(made.add(one)) for one in stream((500, 501), ((0, 2),))] == [[500], [501]]

    def test_and_is_used_again_when_it_comes_back(self):
        chunks = stream(range(200)) + stream(range(200, 600), ((0, 2),)) + stream(range(600, 1000))
        epochs, counts = run(chunks)
        assert not np.isnan(epochs[-1].rates_b).any()
        assert counts["late"] <= 2 * 2 * REVIEW

    def test_loss_does_not_make_a_sensor_rare(self):
        random = np.random.default_rng(1)
        made = assembler(*(one for one in stream(range(2000)) if random.random() > 0.6))
        assert made.counts["late"] == 0

    def test_slow_imus_of_an_autopilot_do_not_delay_the_fast_one(self):
        made, lags_us = assembler(), []
        for k in range(1000):
            names = [0] if k % 5 else [0, 1, 2]
            for sensor in names:
                one = chunk(k, sensor, 1, AUTOPILOT, tolerance_us=5000)
                lags_us += [one.time_us - epoch.time_us for epoch in made.add(one)]
        assert set(lags_us[: 2 * REVIEW]) > {0}
        assert set(lags_us[2 * REVIEW :]) == {0}
        assert made.counts["epochs"] == 1000
        assert made.counts["samples_lost"] < 2 * 2 * REVIEW

    def test_they_are_taken_along_when_they_come_first(self):
        made = assembler()
        chunks = [
            chunk(k, sensor, 1, AUTOPILOT, tolerance_us=5000)
            for k in range(1000)
            for sensor in ([0] if k % 5 else [1, 2, 0])
        ]
        epochs = feed(made, chunks) + made.flush()
        assert samples(epochs) == len(chunks)
        assert made.counts["late"] == 0


class TestAccelerometers:
    @pytest.mark.parametrize("gyros_first", [True, False])
    @pytest.mark.parametrize("count", [1, 4])
    def test_at_the_gyros_rate_are_in_the_epoch_of_their_instant(self, gyros_first, count):
        chunks = []
        for k in range(300):
            both = [*epoch_of(k), forces(k, 0, count)]
            chunks += both if gyros_first else both[::-1]
        epochs, counts = run(chunks)
        assert counts == Counter(epochs=300)
        for epoch in epochs:
            assert (epoch.forces_b == -reading(epoch.time_us, range(count))).all()

    @pytest.mark.parametrize("gyros_first", [True, False])
    def test_at_a_tenth_of_the_rate_are_used_once_and_delay_nothing(self, gyros_first):
        made, epochs, lags_us = assembler(), [], []
        for k in range(1000):
            both = [*epoch_of(k), *([forces(k)] if k % 10 == 0 else [])]
            for one in both if gyros_first else both[::-1]:
                new = made.add(one)
                epochs += new
                lags_us += [one.time_us - epoch.time_us for epoch in new]
        assert set(lags_us[2 * REVIEW :]) == {0}
        with_forces = [epoch for epoch in epochs if not np.isnan(epoch.forces_b).all()]
        assert len(with_forces) == 100
        for epoch in with_forces[-70:]:
            read_us = epoch.time_us - (PERIOD_US if gyros_first else 0)
            assert (epoch.forces_b == -reading(read_us, range(2))).all()
        assert made.counts["late"] == 0

    def test_read_at_instants_of_their_own_go_with_the_next_epoch(self):
        made, lags_us, epochs = assembler(), [], []
        for k in range(1000):
            for one in [*epoch_of(k), forces(k, late_us=1234)]:
                new = made.add(one)
                epochs += new
                lags_us += [one.time_us - epoch.time_us for epoch in new]
        assert set(lags_us[2 * REVIEW :]) == {0}
        for epoch in epochs[1:]:
            assert (epoch.forces_b == -reading(epoch.time_us - PERIOD_US + 1234, range(2))).all()
        assert made.counts["late"] == made.counts["unclaimed"] == 0

    def test_that_are_lost_are_not_replaced_by_what_another_epoch_had(self):
        chunks = [
            one for k in range(10) for one in (*epoch_of(k), *([forces(k)] if k != 5 else []))
        ]
        epochs, _ = run(chunks)
        assert [bool(np.isnan(epoch.forces_b).any()) for epoch in epochs] == [
            k == 5 for k in range(10)
        ]

    def test_that_come_twice_are_counted(self):
        chunks = [one for k in range(10) for one in (*epoch_of(k), forces(k), forces(k))]
        _, counts = run(chunks)
        assert counts == Counter(epochs=10, duplicate=20)

    def test_without_gyros_are_counted_and_need_no_memory(self):
        made = assembler(*epoch_of(0))
        feed(made, [forces(k) for k in range(1, 500)])
        assert made.counts["unclaimed"] == 2 * (499 - 64)
        assert len(pickle.dumps(made)) < 100_000


class TestMessagesOfOneInstant:
    """Stamps of an autopilot's IMUs differ a little, and some count in milliseconds."""

    def test_make_one_epoch(self):
        chunks = [
            chunk(k, sensor, 1, AUTOPILOT, time_us=k * 9_996 + late_us, tolerance_us=4_998)
            for k in range(1, 200)
            for sensor, late_us in ((0, 0), (1, -(k * 9_996 % 1000)), (2, 3000))
        ]
        epochs, counts = run(chunks)
        assert counts == Counter(epochs=199)
        assert all(not np.isnan(epoch.rates_b).any() for epoch in epochs)

    def test_belong_to_the_nearest_one(self):
        chunks = [chunk(k, 0, 1, AUTOPILOT, tolerance_us=6000) for k in (0, 1)]
        chunks.append(chunk(0, 1, 1, AUTOPILOT, time_us=START_US + 5_500, tolerance_us=6000))
        epochs, _ = run(chunks)
        assert [np.isnan(epoch.rates_b[1:, 0]).all() for epoch in epochs] == [True, False]

    def test_of_an_array_must_be_the_same(self):
        epochs, _ = run([chunk(0), chunk(0, 2, time_us=START_US + 1)])
        assert [epoch.time_us for epoch in epochs] == [START_US, START_US + 1]


def moved(chunks, time_us, received_us=0):
    """The same chunks by another clock."""
    return [
        chunk(
            0,
            one.first_sensor,
            len(one.rates_s),
            sequence=one.sequence,
            time_us=one.time_us + time_us,
            received_us=one.received_us + received_us,
        )
        for one in chunks
    ]


class TestClock:
    def test_a_reboot_loses_nothing_and_takes_as_long_as_arrival_says(self):
        rebooted = moved(stream(range(100, 150)), -START_US, 700_000)
        epochs, counts = run(stream(range(100)) + rebooted)
        assert counts == Counter(epochs=150, clock_resets=1)
        assert epochs[100].time_us == 100 * PERIOD_US
        assert [e.dt for e in epochs[99:102]] == pytest.approx([0.01, 0.71, 0.01])

    def test_after_silence_the_first_chunk_is_believed(self):
        made = assembler(*stream(range(100), sensors=4))
        first, second = moved(epoch_of(100), -START_US, 2 * SECOND)
        assert (made.add(first), len(made.add(second))) == ([], 1)

    def test_a_clock_that_is_set_far_ahead_is_followed(self):
        epochs, counts = run(stream(range(100)) + moved(stream(range(100, 150)), 10**15))
        assert counts == Counter(epochs=150, clock_jumps=1)
        assert epochs[100].dt == pytest.approx(0.01)

    def test_silence_is_no_jump(self):
        epochs, counts = run(stream([*range(100), *range(1100, 1200)]))
        assert counts == Counter(epochs=200, samples_lost=1000 * 4)
        assert epochs[100].dt == pytest.approx(10.01)

    def test_an_arrival_clock_that_goes_back_is_no_jump(self):
        _, counts = run(stream(range(100)) + moved(stream(range(100, 200)), 0, -3600 * SECOND))
        assert counts == Counter(epochs=200)

    @pytest.mark.parametrize("time_us", [0, 2**62, START_US - SECOND, START_US + 3 * SECOND])
    def test_a_single_wild_stamp_is_not_believed(self, time_us):
        chunks = stream(range(100))
        chunks.insert(101, chunk(0, time_us=time_us, received_us=START_US + 500_000))
        epochs, counts = run(chunks)
        assert numbers(epochs) == list(range(100))
        assert counts == Counter(epochs=100, astray=2)

    def test_two_clocks_at_once_do_not_disturb_each_other(self):
        other = moved(stream(range(100)), 10**15)
        mixed = [one for pair in zip(stream(range(100)), other, strict=True) for one in pair]
        epochs, counts = run(mixed)
        assert numbers(epochs) == list(range(100))
        assert counts == Counter(epochs=100, astray=400)

    def test_nothing_but_wild_stamps_is_no_dead_end(self):
        random = np.random.default_rng(0)
        wild = [chunk(0, time_us=int(t), received_us=0) for t in random.integers(0, 2**62, 200)]
        epochs, _ = run(wild + stream(range(100)))
        assert numbers(epochs)[-90:] == list(range(10, 100))
        assert all(0 <= epoch.dt < 10 for epoch in epochs)

    def test_a_clock_that_stands_still_gives_one_epoch(self):
        epochs, counts = run([chunk(0, time_us=0) for _ in range(1000)])
        assert len(epochs) == 1
        assert counts == Counter(epochs=1, duplicate=2 * 999)

    def test_small_steps_back_are_late_chunks(self):
        epochs, counts = run(stream([*range(50), *range(30, 80)]))
        assert numbers(epochs) == list(range(80))
        assert counts == Counter(epochs=80, duplicate=80)


class TestRate:
    @pytest.mark.parametrize("numbered", [True, False])
    @pytest.mark.parametrize("factor", [0.5, 2.0, 0.1, 10.0])
    def test_may_change(self, factor, numbered):
        change_us = START_US + 100 * PERIOD_US
        sent = stream(range(100))
        for k in range(100, 300):
            time_us = change_us + round((k - 100) * PERIOD_US / factor)
            number = {"sequence": k if numbered else None}
            sent += [chunk(k, first, time_us=time_us, **number) for first in (0, 2)]
        epochs, counts = run(sent)
        assert len(epochs) == 300
        assert not np.isnan([epoch.rates_b for epoch in epochs]).any()
        if numbered:
            assert counts == Counter(epochs=300)
        assert sum(epoch.dt for epoch in epochs) == pytest.approx(1 + 1.99 / factor)

    def test_a_sequence_that_starts_anew_loses_nothing(self):
        renumbered = [one for k in range(100, 200) for one in epoch_of(k, sequence=k - 100)]
        epochs, counts = run(stream(range(100)) + renumbered)
        assert numbers(epochs) == list(range(200))
        assert counts == Counter(epochs=200)

    def test_a_sequence_that_wraps_does_neither(self):
        _, counts = run(stream(range(65_500, 65_600)))
        assert counts == Counter(epochs=100)

    def test_a_sequence_that_stands_still_is_not_believed(self):
        made = assembler(*(one for k in range(100) for one in epoch_of(k, sequence=0)))
        assert made.counts == Counter(epochs=100)


class TestSource:
    def test_another_array_takes_the_place_of_the_first(self):
        other = [chunk(k, count=3, source=AUTOPILOT) for k in range(100, 110)]
        made = assembler(*stream(range(100)))
        epochs = feed(made, other) + made.flush()
        assert [epoch.rates_b.shape for epoch in epochs] == [(3, 3)] * 10
        assert epochs[0].dt == pytest.approx(0.01)
        assert (made.source, made.sensors) == (AUTOPILOT, 3)
        assert made.counts == Counter(epochs=110, source_changes=1)

    def test_what_the_first_one_left_open_is_handed_on(self):
        made = assembler(*stream(range(10)), chunk(10, sequence=10))
        assert numbers(made.add(chunk(11, source=AUTOPILOT))) == [10]


def test_memory_is_bounded_whatever_stays_open():
    made = EpochAssembler(ArrayParameters(max_wait=1.0))
    for k in range(300):
        time_us = START_US + k * 1000
        made.add(chunk(k, MAX_SENSORS - 1, 1, time_us=time_us))
        made.add(
            GyroChunk(ARRAY, time_us + 500, time_us, MAX_SENSORS - 1, NOTHING, np.ones((1, 3)))
        )
    assert made.counts["epochs"] > 200
    assert len(pickle.dumps(made)) < 4 * 64 * MAX_SENSORS * 26


def assembled(path, frames=None):
    """Epochs and counts of a recording, and how often each IMU message came."""
    ingest = Ingest(ArrayParameters(), GpsParameters(), (1, 191))
    made = EpochAssembler(ArrayParameters())
    names = {IDS[name]: name for name in ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU2")}
    epochs, messages = [], Counter()
    with path.open("rb") as file:
        for time_us, frame in TlogReader(iter(lambda: file.read(1 << 16), b"")):
            if frame.message_id in names:
                messages[names[frame.message_id]] += 1
            datum = ingest.decode(frame, time_us)
            if isinstance(datum, GyroChunk):
                epochs += made.add(datum)
            if messages.total() == frames:
                break
    return epochs + made.flush(), made, messages


class TestRecordings:
    FIXTURES = Path(__file__).parent.parent / "sitl_fixtures"

    @pytest.mark.parametrize(
        ("name", "leading"),
        [
            ("rover_sitl_fixture", "RAW_IMU"),
            ("rover_sitl_gps_unplugged", "HIGHRES_IMU"),
            ("rover_sitl_signed", "HIGHRES_IMU"),
        ],
    )
    def test_of_sitl_give_an_epoch_of_three_sensors_for_every_sample(self, name, leading):
        epochs, made, messages = assembled(self.FIXTURES / f"{name}.tlog", frames=6000)
        assert len(epochs) == messages[leading] >= 1500
        assert made.sensors == 3
        assert not np.isnan([epoch.rates_b for epoch in epochs]).any()
        assert made.counts["late"] == made.counts["samples_lost"] == 0

    def test_with_two_slow_imus_give_an_epoch_for_every_sample_of_the_fast_one(self):
        epochs, made, messages = assembled(self.FIXTURES / "rover_mavproxy.tlog")
        assert len(epochs) == messages["HIGHRES_IMU"] > 3 * messages["SCALED_IMU2"]
        full = sum(not np.isnan(epoch.rates_b).any() for epoch in epochs)
        assert full == messages["SCALED_IMU2"]
        assert made.counts["late"] == 0

    @pytest.mark.parametrize(
        ("name", "sensors"), [("dronekit_flight", 2), ("ardusub_small", 1), ("ardusub_bug", 1)]
    )
    def test_from_real_life_lose_no_sample_that_arrived(self, name, sensors):
        beside = Path(__file__).parent.parent.parent / "shared" / "data"
        path = Path(os.environ.get("RISAF_DATA", beside)) / "real_tlogs" / f"{name}.tlog"
        if not path.exists():
            pytest.skip(f"{path} is not here; RISAF_DATA may say where the data are")
        epochs, made, messages = assembled(path)
        assert made.sensors == sensors  # ArduSub's second one is a compass
        assert len(epochs) == pytest.approx(messages["RAW_IMU"], abs=5)
        assert made.counts["late"] == 0
