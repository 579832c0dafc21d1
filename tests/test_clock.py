"""The vehicle's boot clock, from an array that counts its own time."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from risaf_link.mavlink.clock import SAME_CLOCK_US, VehicleClock
from risaf_link.mavlink.dialect import pack
from risaf_link.mavlink.frame import Frame, FrameParser, encode

AUTOPILOT, OTHER, GROUND = (1, 1), (2, 1), (255, 190)
START_US = 1_700_000_000_000_000  # when the first frame arrives
VEHICLE_US, ARRAY_US = 100_000_000, 3_000_000  # what both clocks show then
OFFSET_US = VEHICLE_US - ARRAY_US


def framed(name: str, sender: tuple[int, int], **fields: object) -> Frame:
    (frame,) = FrameParser().receive_data(encode(*pack(name, **fields), 0, *sender))
    return frame


def heartbeat(sender=AUTOPILOT, kind=2, autopilot=3) -> Frame:
    status = {"base_mode": 0, "custom_mode": 0, "system_status": 0, "mavlink_version": 3}
    return framed("HEARTBEAT", sender, type=kind, autopilot=autopilot, **status)


def system_time(boot_us: int, sender=AUTOPILOT) -> Frame:
    return framed("SYSTEM_TIME", sender, time_unix_usec=0, time_boot_ms=boot_us // 1000)


class Bench:
    """A vehicle and an array, whose frames take time to arrive."""

    def __init__(self, vehicle_us: int = VEHICLE_US) -> None:
        self.clock = VehicleClock()
        self.vehicle_us, self.array_us, self.received_us = vehicle_us, ARRAY_US, START_US
        self.clock.hear(heartbeat(), START_US)

    def wait(self, time_us: int) -> None:
        self.vehicle_us += time_us
        self.array_us += time_us
        self.received_us += time_us

    def tell_time(self, delay_us: int = 0, sender: tuple[int, int] = AUTOPILOT) -> None:
        self.clock.hear(system_time(self.vehicle_us, sender), self.received_us + delay_us)

    def error_us(self, delay_us: int = 0) -> int:
        """How far an epoch of now is from the vehicle's time."""
        return self.clock.boot_us(self.array_us, self.received_us + delay_us) - self.vehicle_us

    def run(self, seconds: int) -> list[int]:
        """Errors of ten epochs a second, with SYSTEM_TIME once a second."""
        errors = []
        for i in range(10 * seconds):
            if i % 10 == 0:
                self.tell_time()
            errors.append(self.error_us())
            self.wait(100_000)
        return errors


def test_an_epoch_gets_the_vehicles_time():
    assert set(Bench().run(30)) == {0}


def test_stamps_stay_as_they_are_while_no_autopilot_has_told_its_time():
    clock = VehicleClock()
    clock.hear(system_time(VEHICLE_US), START_US)  # nobody knows that it is an autopilot
    assert clock.boot_us(ARRAY_US, START_US) == ARRAY_US
    clock.hear(heartbeat(), START_US)
    assert clock.boot_us(ARRAY_US, START_US) == ARRAY_US
    clock.hear(system_time(VEHICLE_US), START_US)
    assert clock.boot_us(ARRAY_US, START_US) == VEHICLE_US


@given(st.integers(1 - SAME_CLOCK_US // 1000, SAME_CLOCK_US // 1000 - 1))
def test_stamps_stay_as_they_are_if_both_clocks_are_the_same(apart_ms):
    bench = Bench(vehicle_us=ARRAY_US + 1000 * apart_ms)
    bench.tell_time()
    assert bench.clock.boot_us(ARRAY_US, START_US) == ARRAY_US


@pytest.mark.parametrize(
    "other",
    [
        heartbeat(GROUND, kind=6, autopilot=8),
        heartbeat(GROUND, kind=6, autopilot=3),
        heartbeat(OTHER, kind=18, autopilot=8),
    ],
)
def test_only_an_autopilot_tells_the_time(other):
    clock = VehicleClock()
    clock.hear(other, START_US)
    clock.hear(system_time(VEHICLE_US, (other.system, other.component)), START_US)
    assert clock.boot_us(ARRAY_US, START_US) == ARRAY_US


def test_the_first_autopilot_is_listened_to():
    bench = Bench()
    bench.tell_time()
    bench.clock.hear(heartbeat(OTHER), START_US)
    bench.clock.hear(system_time(5_000_000_000, OTHER), START_US)
    assert bench.error_us() == 0


@given(st.lists(st.integers(0, 400_000), min_size=20, max_size=20))
def test_the_least_delayed_frames_count(delays):
    bench = Bench()
    for delay_us in [*delays, 0]:
        bench.tell_time(delay_us)
        bench.wait(100_000)
    for delay_us in [*delays, 0]:
        bench.error_us(delay_us)
        bench.wait(100_000)
    assert bench.error_us(300_000) == 0


def test_the_least_delayed_frame_counts_for_some_seconds():
    bench = Bench()
    for second in range(14):
        bench.tell_time(0 if second == 5 else 300_000)
        assert bench.error_us() == (0 if second >= 5 else -300_000)
        bench.wait(1_000_000)


@pytest.mark.parametrize("drift", [-200, 200])  # microseconds a second
def test_clocks_that_drift_are_followed(drift):
    bench = Bench()
    for second in range(300):
        bench.tell_time()
        assert abs(bench.error_us()) <= (15 * abs(drift) if second < 15 else 2)
        bench.wait(1_000_000)
        bench.array_us += drift


def test_a_reboot_of_the_vehicle_is_followed_when_it_tells_its_time():
    bench = Bench()
    bench.run(5)
    bench.vehicle_us = 2_000_000
    assert set(bench.run(5)) == {0}


def test_a_reboot_of_the_array_is_followed_when_the_vehicle_tells_its_time():
    bench = Bench()
    bench.run(5)
    bench.array_us = 0
    bench.error_us()
    bench.wait(100_000)
    assert set(bench.run(5)) == {0}


@pytest.mark.parametrize("step_us", [-3_600_000_000, -700_000, 700_000, 10**12])
def test_setting_the_receivers_clock_does_not_move_the_vehicles(step_us):
    bench = Bench()
    bench.run(5)
    bench.received_us += step_us
    assert [bench.error_us() for _ in range(3)] == [0, 0, 0]
    bench.wait(500_000)
    assert bench.error_us() == 0
    assert set(bench.run(5)) == {0}


def test_a_stalled_link_does_not_move_the_vehicles_clock():
    bench = Bench()
    bench.run(5)
    for delay_us in (3_000_000, 2_900_000, 2_800_000, 0):
        assert bench.error_us(delay_us) == 0
        bench.wait(100_000)
    assert set(bench.run(5)) == {0}


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 2**32 - 1), st.integers(0, 2**52))))
def test_no_time_is_negative_whatever_the_clocks_tell(told):
    clock = VehicleClock()
    clock.hear(heartbeat(), START_US)
    for is_vehicle, time_ms, received_us in told:
        if is_vehicle:
            clock.hear(system_time(time_ms * 1000), received_us)
        else:
            assert clock.boot_us(time_ms * 1000, received_us) >= 0


def test_times_go_on_as_the_array_counts_them():
    bench = Bench()
    bench.run(3)
    times = []
    for _ in range(50):
        times.append(bench.clock.boot_us(bench.array_us, bench.received_us))
        bench.wait(10_000)
    assert {b - a for a, b in pairwise(times)} == {10_000}
