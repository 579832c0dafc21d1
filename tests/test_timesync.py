"""TIMESYNC both ways, and the two clocks that it brings together."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from network import FAR, GCS, NEAR, OWN, Network, Recorder, of
from pymavlink.dialects.v20 import all as public
from test_clock import ARRAY_US, AUTOPILOT, START_US, VEHICLE_US, framed, heartbeat, system_time
from wire import frame

from risaf_link.mavlink import timesync
from risaf_link.mavlink.clock import MANY, SAME_CLOCK_US, VehicleClock
from risaf_link.mavlink.dialect import pack
from risaf_link.mavlink.frame import FrameParser, encode
from risaf_link.mavlink.requests import Requests

TAG = OWN[1]
SECOND = 1_000_000


class Clocks:
    """An array and a vehicle, each with a clock of its own, and a link that takes its time."""

    def __init__(self, array_ppm: float = 0.0, vehicle_ppm: float = 0.0) -> None:
        self.clock = VehicleClock(TAG)
        self.clock.hear(heartbeat(), START_US)
        self.array_ppm, self.vehicle_ppm = array_ppm, vehicle_ppm
        self.now_us = 0  # true time
        self.unix_us = START_US  # what the receiver's clock shows then
        self.vehicle_start_us, self.array_start_us = VEHICLE_US, ARRAY_US

    @property
    def vehicle_us(self) -> int:
        return self.vehicle_start_us + round(self.now_us * (1 + self.vehicle_ppm * 1e-6))

    @property
    def array_us(self) -> int:
        return self.array_start_us + round(self.now_us * (1 + self.array_ppm * 1e-6))

    def wait(self, time_us: int) -> None:
        self.now_us += time_us

    def synchronise(self, there_us: int = 200, back_us: int = 200, tag: int = TAG) -> None:
        """Ask, and hear the answer."""
        asked = timesync.request(self.unix_us + self.now_us, tag)
        self.wait(there_us)
        told = asked | {"tc1": self.vehicle_us * 1000}
        self.wait(back_us)
        answer = framed("TIMESYNC", AUTOPILOT, **told)
        self.clock.hear(answer, self.unix_us + self.now_us)

    def tell_time(self, delay_us: int) -> None:
        boot_us = self.vehicle_us
        self.clock.hear(system_time(boot_us), self.unix_us + self.now_us + delay_us)

    def error_us(self) -> int:
        """How far an epoch of now is from the vehicle's time."""
        return self.clock.boot_us(self.array_us, self.unix_us + self.now_us) - self.vehicle_us

    def run(self, seconds: int, **trip: int) -> list[int]:
        errors = []
        for _ in range(seconds):
            self.synchronise(**trip)
            for _ in range(10):
                errors.append(self.error_us())
                self.wait(100_000)
        return errors


# Answers


def timesync_heard(messages: list) -> list[tuple[int, int]]:
    return [(m.tc1, m.ts1) for m in of(messages, "TIMESYNC")]


def test_a_request_is_answered_with_the_time_of_our_stamps():
    network = Network()
    answers = network.take(frame("TIMESYNC", GCS, tc1=0, ts1=123_456_789))
    assert timesync_heard(answers) == [((network.now_us - 7_000_000) * 1000, 123_456_789)]


def test_an_answer_is_addressed_to_the_asker():
    network = Network()
    asked = frame("TIMESYNC", GCS, tc1=0, ts1=5)
    network.component.receive(asked, NEAR, network.now_us)
    ((peer, raw),) = network.component.collect([NEAR, FAR])
    (answer,) = FrameParser().receive_data(raw)
    assert peer == NEAR
    assert timesync.timesync_in(answer).to == GCS


@pytest.mark.parametrize("to", [(2, 0), (1, 1), (2, 191)])
def test_what_others_are_asked_we_do_not_answer(to):
    network = Network()
    fields = {"tc1": 0, "ts1": 5, "target_system": to[0], "target_component": to[1]}
    network.component.receive(framed("TIMESYNC", GCS, **fields), NEAR, network.now_us)
    assert network.heard() == {}


def test_a_clock_that_shows_more_than_an_answer_holds_is_not_told():
    estimator = Recorder()
    network = Network(estimator=estimator)
    request = frame("TIMESYNC", GCS, tc1=0, ts1=5)
    for clock_us, answers in [((2**63 - 1) // 1000, 1), ((2**63 - 1) // 1000 + 1, 0), (2**62, 0)]:
        estimator.now_us = lambda _, shown=clock_us: shown
        assert len(network.take(request)) == answers


def test_an_answer_is_not_answered():
    assert Network().take(frame("TIMESYNC", GCS, tc1=7, ts1=5)) == []


@given(tc1=st.integers(-(2**63), 2**63 - 1), ts1=st.integers(-(2**63), 2**63 - 1))
def test_no_time_is_too_strange(tc1, ts1):
    network = Network()
    told = frame("TIMESYNC", AUTOPILOT, tc1=tc1, ts1=ts1)
    answers = timesync_heard(network.take(told))
    assert [answer[1] for answer in answers] == ([ts1] if tc1 == 0 else [])
    clock = VehicleClock(TAG)
    clock.hear(heartbeat(), START_US)
    clock.hear(told, START_US)
    assert clock.boot_us(ARRAY_US, START_US) >= 0


# Requests


def asked(network: Network, seconds: int) -> list:
    """What the autopilot is asked for its time with."""
    requests = []
    for _ in range(10 * seconds):
        network.component.receive(frame("HEARTBEAT", AUTOPILOT, type=2, autopilot=3), NEAR, 0)
        network.now_us += 100_000
        network.component.advance(network.now_us, START_US + network.now_us)
        requests += of(network.heard().get(NEAR, []), "TIMESYNC")
    return requests


def test_the_autopilot_is_asked_once_a_second_in_our_time():
    requests = asked(Network(requests=Requests({"ground": None})), 14)
    assert len(requests) == 10
    assert {each.tc1 for each in requests} == {0}
    assert {each.ts1 % 1000 for each in requests} == {OWN[1]}
    assert {b.ts1 - a.ts1 for a, b in pairwise(requests)} == {10**9}


def test_a_link_on_which_nothing_is_requested_is_not_asked():
    assert asked(Network(requests=Requests({"ground": {}})), 10) == []
    assert asked(Network(requests=Requests({"ground": {"RAW_IMU": 5.0}})), 10) == []
    assert len(asked(Network(requests=Requests({"ground": {"TIMESYNC": 2.0}})), 9)) == 10


def test_pymavlink_reads_our_request():
    fields = timesync.request(START_US, TAG)
    raw = encode(*pack("TIMESYNC", **fields), 0, *OWN)
    (heard,) = public.MAVLink(None).parse_buffer(raw)
    assert (heard.tc1, heard.ts1) == (0, START_US * 1000 + TAG)


# Clocks


def test_the_middle_of_a_round_trip_is_when_the_other_told_its_time():
    clocks = Clocks()
    assert set(clocks.run(20)) == {0}


@given(st.integers(0, 5000), st.integers(0, 5000))
def test_the_error_is_at_most_half_the_round_trip(there_us, back_us):
    clocks = Clocks()
    worst = max(abs(error) for error in clocks.run(20, there_us=there_us, back_us=back_us))
    assert worst <= (there_us + back_us) / 2 + 1


@pytest.mark.parametrize(("array", "vehicle"), [(50, -60), (-100, 100), (0, 117)])
def test_skew_is_followed(array, vehicle):
    clocks = Clocks(array, vehicle)
    errors = clocks.run(90)[600:]
    assert max(map(abs, errors)) <= 2
    assert clocks.clock._vehicle.skew == pytest.approx(vehicle * 1e-6, abs=2e-6)


def test_fast_answers_count_more_than_slow_ones():
    clocks = Clocks()
    random = np.random.default_rng(2)
    for _ in range(60):
        is_slow = random.random() < 0.5
        clocks.synchronise(200, 8000 if is_slow else 250)
        clocks.error_us()
        clocks.wait(SECOND)
    assert abs(clocks.error_us()) <= 30


def test_slow_answers_and_those_to_others_are_left_alone():
    clocks = Clocks()
    clocks.run(5)
    clocks.vehicle_start_us += 3_000_000  # what they tell is wrong
    clocks.synchronise(5001, 5000)
    clocks.synchronise(200, 200, tag=TAG - 1)
    assert abs(clocks.error_us() + 3_000_000) <= 1


def test_without_answers_system_time_is_good_enough():
    clocks = Clocks()
    clocks.run(5)
    for _ in range(100):
        clocks.tell_time(2000)
        errors = clocks.error_us()
        clocks.wait(SECOND)
    assert -2000 <= errors <= 0


@pytest.mark.parametrize("answers", [True, False])
def test_a_reboot_of_the_autopilot_is_followed(answers):
    clocks = Clocks()
    clocks.run(30)
    clocks.vehicle_start_us = 1_500_000 - clocks.now_us
    for _ in range(6):
        if answers:
            clocks.synchronise()
        clocks.tell_time(200 if answers else 0)
        errors = clocks.error_us()
        clocks.wait(SECOND)
    assert abs(errors) <= 1


@pytest.mark.parametrize("step_us", [-3600 * SECOND, -300_000, -40_000, 40_000, 300_000, 10**12])
def test_setting_the_receivers_clock_does_not_move_the_vehicles(step_us):
    clocks = Clocks()
    clocks.run(30)
    clocks.unix_us += step_us
    assert set(clocks.run(30)[10:]) == {0}


MOMENTS = st.lists(
    st.tuples(
        st.sampled_from(["epochs", "epochs", "sync", "time", "set", "reboot", "restart", "pause"]),
        st.integers(-600_000, 600_000),
    ),
    max_size=40,
)


def happen(clocks: Clocks, what: str, amount: int) -> None:
    if what == "sync":
        clocks.synchronise(abs(amount) % 6000, 300)
    elif what == "time":
        clocks.tell_time(abs(amount) % 50_000)
    elif what == "set":
        clocks.unix_us += amount
    elif what == "reboot":
        clocks.vehicle_start_us = -clocks.now_us
    elif what == "restart":
        clocks.array_start_us = -clocks.now_us
    elif what == "pause":
        clocks.wait(10 * abs(amount))
    clocks.wait(300_000)


@given(MOMENTS)
def test_stamps_do_not_go_back_but_for_a_clock_that_was_started_anew(moments):
    clocks, last_us = Clocks(80, -80), 0
    for what, amount in moments:
        happen(clocks, what, amount)
        for _ in range(3):
            clocks.wait(1000)
            stamp = clocks.clock.boot_us(clocks.array_us, clocks.unix_us + clocks.now_us)
            assert stamp >= last_us or last_us - stamp >= SAME_CLOCK_US
            last_us = stamp


@given(MOMENTS, st.booleans())
def test_many_epochs_at_once_get_the_stamps_that_each_would(moments, is_asked_at_once):
    one, many = Clocks(80, -80), Clocks(80, -80)
    singly, together = [], []
    for what, amount in moments:
        times = []
        for clocks in (one, many):
            happen(clocks, what, amount)
            for _ in range(2 * MANY):
                clocks.wait(1000)
                epoch = clocks.array_us, clocks.unix_us + clocks.now_us
                if clocks is one:
                    singly.append(one.clock.boot_us(*epoch))
                else:
                    times.append(epoch)
        together += [many.clock.stamps(*run.T) for run in np.split(np.array(times), [1, MANY])]
        if is_asked_at_once:
            together[-1]()
    assert [stamp for stamps in together for stamp in stamps().tolist()] == singly
    now_us = one.unix_us + one.now_us
    assert one.clock.now_us(now_us) == many.clock.now_us(now_us)


def test_the_time_that_others_are_told_is_that_of_the_stamps():
    clocks = Clocks()
    assert clocks.clock.now_us(START_US) == START_US
    clocks.run(20)
    assert abs(clocks.clock.now_us(clocks.unix_us + clocks.now_us) - clocks.vehicle_us) <= 1
    clocks.wait(50_000)
    assert abs(clocks.clock.now_us(clocks.unix_us + clocks.now_us) - clocks.vehicle_us) <= 1
