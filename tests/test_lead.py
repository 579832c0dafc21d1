"""Skew, delays and jumps of the array's, the vehicle's and the receiver's clock, simulated."""

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_clock import AUTOPILOT, START_US, framed, heartbeat, system_time

from risaf_link.mavlink import timesync
from risaf_link.mavlink.clock import VehicleClock
from risaf_link.mavlink.lead import SKEW_SPAN_US, SPELL_US, WINDOW_US, Lead

SECOND = 1_000_000
RATE = 100  # Hz
DELAY_US = 5000  # of a frame, at most

Delays = Callable[[int], np.ndarray]


def uniform(random: np.random.Generator) -> Delays:
    return lambda count: random.uniform(0, DELAY_US, count)


def mostly_short(random: np.random.Generator) -> Delays:
    return lambda count: np.minimum(random.exponential(DELAY_US / 4, count), DELAY_US)


class Clocks:
    """An array at 100 Hz and a vehicle, with clocks that run unevenly, on links that delay."""

    def __init__(self, delays: Delays, answers: bool, array_ppm=50.0, vehicle_ppm=-30.0) -> None:
        self.clock = VehicleClock()
        self.clock.hear(heartbeat(), START_US)
        self.delays, self.answers = delays, answers
        self.array_ppm, self.vehicle_ppm = array_ppm, vehicle_ppm
        self.array_start_us, self.vehicle_start_us, self.unix_us = 3e6, 500e6, START_US
        self.held_up_us = 0  # on the array's link
        self.second = 0
        self.stamps: list[int] = []

    def array_us(self, now_us):
        return np.rint(self.array_start_us + now_us * (1 + self.array_ppm * 1e-6)).astype(np.int64)

    def vehicle_us(self, now_us):
        return self.vehicle_start_us + now_us * (1 + self.vehicle_ppm * 1e-6)

    def run(self, seconds: int) -> np.ndarray:
        """Errors of the stamps, (seconds * RATE,) us, each second's after the vehicle's time."""
        errors = []
        for _ in range(seconds):
            begun_us = self.second * SECOND
            self.tell(begun_us)
            now_us = begun_us + np.arange(RATE) * SECOND // RATE
            came_us = np.maximum.accumulate(now_us + self.delays(RATE)) + self.held_up_us
            came_us = (self.unix_us + came_us).astype(np.int64)
            stamps = self.clock.boot_times(self.array_us(now_us), came_us)
            self.stamps += stamps.tolist()
            errors.append(stamps - self.vehicle_us(now_us))
            self.second += 1
        return np.concatenate(errors)

    def tell(self, now_us: float) -> None:
        there_us, back_us = self.delays(2)
        told_us = self.vehicle_us(now_us + there_us)
        got_us = int(self.unix_us + now_us + there_us + back_us)
        if self.answers:
            asked = timesync.request(int(self.unix_us + now_us), 191)
            answer = framed("TIMESYNC", AUTOPILOT, **asked | {"tc1": int(told_us * 1000)})
            self.clock.hear(answer, got_us)
        else:
            self.clock.hear(system_time(int(told_us)), got_us)

    @property
    def steps_back(self) -> list[int]:
        return [before - after for before, after in pairwise(self.stamps) if after < before]


@pytest.fixture
def clocks(request) -> Clocks:
    return Clocks(mostly_short(np.random.default_rng(5)), answers=request.param)


either_way = pytest.mark.parametrize(
    "clocks", [True, False], ids=["answers", "alone"], indirect=True
)


@pytest.mark.parametrize("delays", [uniform, mostly_short])
@pytest.mark.parametrize(("array", "vehicle"), [(50, -30), (-50, 50)])
def test_after_a_minute_stamps_are_right_to_a_millisecond_and_stay_so(delays, array, vehicle):
    clocks = Clocks(delays(np.random.default_rng(1)), True, array, vehicle)
    errors = clocks.run(3600)
    assert np.abs(errors[60 * RATE :]).max() < 1000
    assert np.sqrt(np.mean(errors[180 * RATE :] ** 2)) < 200
    assert not clocks.steps_back


@pytest.mark.parametrize("seed", range(8))
def test_without_answers_system_time_is_good_to_two_milliseconds(seed):
    clocks = Clocks(uniform(np.random.default_rng(seed)), False)
    errors = clocks.run(600)
    assert np.abs(errors[60 * RATE :]).max() < 2000
    assert np.sqrt(np.mean(errors[180 * RATE :] ** 2)) < 600
    assert not clocks.steps_back


@pytest.mark.parametrize("answers", [True, False])
def test_a_receiver_whose_clock_is_slewed_moves_the_stamps_little(answers):
    """By up to 500 ppm, as far as adjtimex goes; to and fro in 20 minutes."""
    clocks = Clocks(uniform(np.random.default_rng(3)), answers)
    errors = []
    for second in range(2400):
        clocks.unix_us = START_US + round(95_000 * np.sin(second * 2 * np.pi / 1200))
        errors.append(clocks.run(1))
    assert np.abs(np.concatenate(errors[60:])).max() < 5000
    assert not clocks.steps_back


@either_way
@pytest.mark.parametrize("step_us", [-3600 * SECOND, -300_000, -40_000, 40_000, 300_000, 10**12])
def test_setting_the_receivers_clock_moves_nothing(clocks, step_us):
    clocks.run(120)
    clocks.unix_us += step_us
    assert np.abs(clocks.run(120)).max() < 1500
    assert not clocks.steps_back


@either_way
@pytest.mark.parametrize("for_s", [1, 5, 60])
def test_a_link_that_stalls_moves_nothing(clocks, for_s):
    clocks.run(120)
    clocks.held_up_us = 3 * SECOND
    stalled = clocks.run(for_s)
    now_us = clocks.second * SECOND
    told_us = clocks.clock.now_us(clocks.unix_us + now_us)
    assert abs(told_us - clocks.vehicle_us(now_us)) < 1500 + 100 * for_s
    clocks.held_up_us = 0
    assert np.abs(stalled).max() < 1500 + 100 * for_s  # the drift of clocks that are not compared
    assert np.abs(clocks.run(60)[RATE:]).max() < 1500


@either_way
def test_a_link_that_is_slower_for_good_is_believed_in_the_end(clocks):
    clocks.run(60)
    clocks.held_up_us = 40_000
    errors = clocks.run(2 * WINDOW_US // SECOND)
    assert np.abs(errors[-RATE:].mean() - 40_000) < 1500


@either_way
def test_an_array_that_restarts_gets_the_right_stamps_at_once(clocks):
    clocks.run(120)
    clocks.second += 3
    clocks.array_start_us = -clocks.array_us(clocks.second * SECOND) + 3e6
    assert np.abs(clocks.run(60)).max() < DELAY_US + 1500
    assert not clocks.steps_back


@either_way
@pytest.mark.parametrize("step_us", [40_000, 2 * SECOND])
def test_an_array_whose_clock_is_set_ahead_is_found_out(clocks, step_us):
    clocks.run(120)
    clocks.array_start_us += step_us
    errors = np.abs(clocks.run(60))
    assert errors.max() < 50_000
    assert errors[5 * RATE :].max() < DELAY_US + 1500


@either_way
def test_an_autopilot_that_restarts_takes_the_stamps_with_it(clocks):
    clocks.run(120)
    clocks.vehicle_start_us = 2e6 - clocks.second * SECOND
    errors = np.abs(clocks.run(120))
    assert errors.max() < DELAY_US + 2500
    assert errors[60 * RATE :].max() < 1500
    assert len(clocks.steps_back) == 1


# The line alone

POINTS = st.lists(
    st.tuples(st.integers(0, 9 * SPELL_US), st.integers(0, 400_000)), min_size=1, max_size=60
).map(sorted)


def told(lead: Lead, points: list[tuple[int, int]], skew: float = 0.0) -> Iterator[int]:
    """Let a clock be told that is ahead by a second and gains, each time with a delay."""
    for sent_us, delay_us in points:
        came_us = START_US + sent_us + delay_us
        lead.note(START_US + SECOND + round(sent_us * (1 + skew)), came_us)
        yield came_us


@given(POINTS)
def test_nothing_that_was_told_lies_above_the_line(points):
    lead = Lead()
    for came_us, (_, delay_us) in zip(told(lead, points), points, strict=True):
        assert lead.at(came_us) >= SECOND - delay_us


@given(st.floats(-3e-4, 3e-4), st.lists(st.integers(0, 9000), min_size=60, max_size=60))
def test_frames_without_delay_among_others_tell_the_skew(skew, delays):
    points = [(i * SECOND, delay if i % 5 else 0) for i, delay in enumerate(delays)]
    lead = Lead()
    *_, last_us = told(lead, [*points, (60 * SECOND, 0)], skew)
    assert lead.skew == pytest.approx(skew, abs=1e-6)
    assert lead.at(last_us) == pytest.approx(SECOND + skew * 60 * SECOND, abs=50)


def test_no_skew_is_told_by_a_few_seconds_or_by_what_no_clock_does():
    brief, steep = Lead(), Lead()
    list(told(brief, [(i * SECOND, 100 * i) for i in range(SKEW_SPAN_US // SECOND)]))
    assert brief.skew == 0.0
    list(told(steep, [(i * SECOND, 400_000 - 3000 * i) for i in range(100)]))
    assert steep.skew == 0.0


@given(POINTS, st.integers(1, 20))
def test_many_at_once_are_what_each_would_be(points, length):
    came_us = START_US + np.maximum.accumulate([sent_us + d % 20_000 for sent_us, d in points])
    time_us = START_US + SECOND + np.array([sent_us for sent_us, _ in points])
    one, many = Lead(), Lead()
    singly = [each(one, *pair) for pair in zip(time_us.tolist(), came_us.tolist(), strict=True)]
    together: list[int] = []
    while (done := len(together)) < len(points):
        some = slice(done, done + length)
        leads = many.note_each(time_us[some], came_us[some]).tolist()
        together += leads or [each(many, int(time_us[done]), int(came_us[done]))]
    assert together == singly


def each(lead: Lead, time_us: int, received_us: int) -> int:
    if not lead.off(time_us, received_us):
        lead.note(time_us, received_us)
    return lead.at(received_us)
