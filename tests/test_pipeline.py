"""Frames in, estimates out: what the estimator says when this and that happens."""

import math
from dataclasses import replace

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as public
from vehicle import Vehicle
from wire import array, debug_array, frame, imu, info

from risaf_link.core.estimate import Estimate
from risaf_link.core.heading import HeadingState
from risaf_link.core.rotation import wrap, yaw_of
from risaf_link.mavlink import risaf
from risaf_link.mavlink.epoch import ArrayParameters
from risaf_link.mavlink.frame import Frame, FrameParser
from risaf_link.mavlink.telemetry import DEFAULT_RATES, Emitter
from risaf_link.pipeline import Pipeline, PipelineParameters
from risaf_link.sim.receiver_faults import RECEIVER_FAULTS
from risaf_link.sim.scenario import BOOT_US, scenario
from risaf_link.sim.stream import frames

OWN = (1, 191)
ROVER = {"type": 10, "autopilot": 3, "base_mode": 0, "custom_mode": 0, "system_status": 4}
ROVER |= {"mavlink_version": 3}
PERIOD_US = 10_000


class Drive:
    """A pipeline and a vehicle that feeds it, sample by sample; time is the vehicle's."""

    def __init__(self, parameters: PipelineParameters | None = None, sensors: int = 5) -> None:
        self.vehicle = Vehicle(sensors)
        self.pipeline = Pipeline(parameters or PipelineParameters(), OWN)
        self.time_us = 5_000_000
        self.take(self.vehicle.info())

    def take(self, frame: Frame) -> list[Estimate]:
        return self.pipeline.step(frame, self.time_us)

    def go(self, seconds: float, rate_z: float = 0.0, course: float | None = None) -> Estimate:
        """Drive on; with a course there is a fix five times a second."""
        for _ in range(round(seconds * 100)):
            self.time_us += PERIOD_US
            if course is not None and self.time_us % 200_000 == 0:
                self.take(self.vehicle.fix(self.time_us, course))
            (estimate,) = self.take(self.vehicle.epoch(self.time_us, (0, 0, rate_z)))
        return estimate


@pytest.fixture
def drive() -> Drive:
    return Drive()


def test_yaw_is_unknown_until_the_first_heading(drive):
    before = drive.go(1)
    assert (before.heading.state, before.attitude.aligned) == (HeadingState.NO_FIX, False)
    assert before.heading.yaw_std == math.pi
    after = drive.go(1, course=2.0)
    assert (after.heading.state, after.attitude.resets) == (HeadingState.FUSING, 1)
    assert after.heading.yaw == pytest.approx(2.0, abs=1e-3)


def test_dead_reckoning_carries_the_heading_on(drive):
    drive.go(10, course=3.0)
    estimate = drive.go(10, rate_z=math.radians(9))
    assert estimate.heading.state is HeadingState.DEAD_RECKONING
    assert estimate.heading.time_since_fused == pytest.approx(10, abs=0.21)
    assert estimate.heading.yaw == pytest.approx(3.0 + math.pi / 2 - math.tau, abs=0.02)


def test_a_slow_vehicle_has_a_fix_but_no_heading(drive):
    drive.take(drive.vehicle.fix(drive.time_us, course=1.0, speed=0.5))
    assert drive.go(0.1).heading.state is HeadingState.TOO_SLOW


def test_a_heading_that_jumps_is_rejected_and_believed_only_after_a_while(drive):
    drive.go(20, course=0.5)
    rejecting = drive.go(5, course=1.5)
    assert rejecting.heading.state is HeadingState.REJECTING
    assert rejecting.heading.yaw == pytest.approx(0.5, abs=0.02)
    assert rejecting.heading.rejected_count == 25
    assert rejecting.attitude.resets == 1
    assert drive.go(14, course=1.5).attitude.resets == 1
    later = drive.go(2, course=1.5)
    assert later.attitude.resets == 2
    assert later.heading.yaw == pytest.approx(1.5, abs=0.02)


def errors_of(chosen, begin, end):
    """Errors of yaw between two times, and the same in standard deviations."""
    pipeline, parser = Pipeline(PipelineParameters(), OWN), FrameParser()
    rows = [
        ((e.time_us - BOOT_US) / 1e6, e.heading.yaw, e.heading.yaw_std, e.attitude.resets)
        for time_us, raw in frames(chosen)
        for frame in parser.receive_data(raw)
        for e in pipeline.step(frame, time_us)
    ]
    time_s, yaw, std, resets = np.array([r for r in rows if begin < r[0] < end]).T
    true_yaw = np.array([yaw_of(q_nb) for q_nb in chosen.trajectory(time_s).q_nb])
    assert resets.max() == 1
    errors = np.remainder(yaw - true_yaw + math.pi, math.tau) - math.pi
    return np.degrees(errors), errors / std


@pytest.mark.parametrize("fault", list(RECEIVER_FAULTS))
def test_gps_that_is_present_but_wrong_is_no_worse_than_none(fault):
    """The fault lasts from 50 to 90 s; an outage of that length is the measure."""
    sound = scenario("ekf2", 1, duration=95.0, rate=50.0, faults=["none"])
    spoilt = replace(sound, receiver_faults={fault: RECEIVER_FAULTS[fault]})
    without, _ = errors_of(replace(sound, outages=((50.0, 90.0),)), 50.0, 90.0)
    errors, ratios = errors_of(spoilt, 50.0, 95.0)
    assert np.sqrt(np.mean(ratios**2)) < 1.5
    assert np.abs(errors).max() < np.abs(without).max() + 0.5


def test_a_receiver_that_repeats_its_last_fix_is_gone(drive):
    drive.go(10, course=1.0)
    stale = drive.vehicle.fix(drive.time_us, course=1.0)
    for _ in range(300):
        drive.take(stale)
        estimate = drive.go(0.01)
    assert estimate.heading.state is HeadingState.DEAD_RECKONING


def test_an_epoch_without_any_reading_loses_no_time(drive):
    drive.go(5, course=1.0)
    rate = math.radians(10)
    before = drive.go(1, rate_z=rate)
    drive.time_us += PERIOD_US
    (blind,) = drive.take(drive.vehicle.epoch(drive.time_us, math.nan))
    assert np.isnan(blind.fused.rate_b).all()
    after = drive.go(0.01, rate_z=rate)
    assert after.heading.yaw - before.heading.yaw == pytest.approx(0.02 * rate, rel=0.01)


@pytest.mark.parametrize("restarted", [False, True])
def test_a_fix_older_than_the_first_epoch_is_not_taken_for_better_than_it_is(drive, restarted):
    rate, began = math.radians(20), drive.time_us
    if restarted:
        drive.go(20, course=1.0)
        drive.pipeline.restart()
        began = drive.time_us
    ratios = []
    for _ in range(100):
        drive.time_us += PERIOD_US
        course = 1.0 + rate * (drive.time_us - began) / 1e6
        (estimate,) = drive.take(drive.vehicle.epoch(drive.time_us, (0, 0, rate)))
        if drive.time_us % 200_000 == (began + PERIOD_US) % 200_000:
            drive.take(drive.vehicle.fix(drive.time_us, course - 0.11 * rate))
        if estimate.attitude.aligned:
            ratios.append(abs(wrap(estimate.heading.yaw - course)) / estimate.heading.yaw_std)
    assert len(ratios) > 90
    assert max(ratios) < 2.0


def test_estimates_are_stamped_when_late_samples_were_taken_and_never_go_back(drive):
    stamps = []
    for k in range(200):
        if k == 100:
            drive.take(drive.vehicle.frame("HEARTBEAT", **ROVER))
        drive.time_us += PERIOD_US
        stamps += [e.boot_us for e in drive.take(imu("RAW_IMU", drive.time_us))]
    assert stamps[90] % PERIOD_US == 0
    assert stamps[-1] == drive.time_us - 56_270
    assert stamps == sorted(stamps)


@pytest.mark.parametrize("together", [False, True])
def test_epochs_are_as_late_as_their_own_source_when_another_takes_its_place(together):
    pipeline = Pipeline(PipelineParameters(), OWN)
    read_us = [5_000_000 + 20_000 * k for k in range(5)]
    imus = [imu("RAW_IMU", time_us) for time_us in read_us]
    blocks = []
    for one in (frame("HEARTBEAT", **ROVER), info(), *imus, array(5_100_000, 3 * [(0, 0, 1)])):
        blocks += pipeline.gather(one, 6_000_000)
        blocks += [] if together else pipeline.release()
    blocks += pipeline.flush(6_000_000)
    *filtered, raw = np.concatenate([block.boot_us for block in blocks]).tolist()
    assert filtered == [time_us - 56_270 for time_us in read_us]  # 4 Hz, as ArduPilot's rovers
    assert raw == 5_100_000


@pytest.mark.parametrize("delay", [0.0, 0.05])
def test_yaw_is_that_of_the_stamp_whatever_the_delay_of_the_samples(delay):
    rate = math.radians(20)
    drive = Drive(PipelineParameters(array=ArrayParameters(delay=delay)))
    courses = [1.0] * 2000 + [1.0 + rate * 0.01 * k for k in range(2000)]
    late_gyro, late_fix = round(delay * 100), 11
    for k in range(20, 3900):
        drive.time_us += PERIOD_US
        if k % 20 == 0:
            drive.take(drive.vehicle.fix(drive.time_us, courses[k - late_fix]))
        turns = courses[k - late_gyro] > 1.0
        (estimate,) = drive.take(drive.vehicle.epoch(drive.time_us, (0, 0, rate * turns)))
    taken = k - (drive.time_us - estimate.boot_us) / PERIOD_US
    assert taken == k - late_gyro
    error = wrap(estimate.heading.yaw - courses[round(taken)])
    assert abs(error) < math.radians(0.1)


def test_nothing_that_the_service_sent_itself_is_taken_for_input(drive):
    drive.go(1)
    assert drive.take(drive.vehicle.epoch(drive.time_us + PERIOD_US, component=OWN[1])) == []
    assert drive.pipeline.ingest.counts["own"] == 1


def test_a_reboot_keeps_the_heading(drive):
    before = drive.go(10, course=1.0)
    received_us = drive.time_us
    drive.time_us = 100_000
    frame = drive.vehicle.epoch(drive.time_us)
    (after,) = drive.pipeline.step(frame, received_us + 2_000_000)
    assert after.time_us == 100_000
    assert after.elapsed - before.elapsed == pytest.approx(2.0)
    assert after.heading.yaw == pytest.approx(before.heading.yaw, abs=0.01)
    assert drive.pipeline.assembler.counts["clock_resets"] == 1


READING = [(1, 2, 3)] * 3
SENDERS = {
    "GYRO_ARRAY": lambda time_us: array(time_us, READING, epoch_seq=time_us // PERIOD_US % 65536),
    "DEBUG_FLOAT_ARRAY": lambda time_us: debug_array(time_us, b"gyro", READING),
    "HIGHRES_IMU": lambda time_us: imu("HIGHRES_IMU", time_us),
    "SCALED_IMU": lambda time_us: imu("SCALED_IMU", time_us),
}


@pytest.mark.parametrize("name", SENDERS)
def test_time_goes_by_the_senders_own_clock_not_by_arrival(name):
    random = np.random.default_rng(4)
    pipeline = Pipeline(PipelineParameters(), OWN)
    pipeline.step(info(), 0)
    times_us = 5_000_000 + PERIOD_US * np.arange(300)
    arrivals_us = times_us + random.integers(0, 5000, 300)
    arrivals_us[150:] -= 40_000  # the receiver's clock is set
    estimates = [
        estimate
        for time_us, received_us in zip(times_us.tolist(), arrivals_us.tolist(), strict=True)
        for estimate in pipeline.step(SENDERS[name](time_us), received_us)
    ]
    assert len(estimates) > 290
    steps = np.diff([estimate.elapsed for estimate in estimates])
    assert steps == pytest.approx(PERIOD_US / 1e6, abs=1e-9)
    assert set(np.diff([estimate.boot_us for estimate in estimates])) == {PERIOD_US}


def test_boot_time_is_the_autopilots_for_an_array_with_a_clock_of_its_own(drive):
    heartbeat = {"autopilot": 3, "base_mode": 0, "custom_mode": 0, "system_status": 4}
    drive.take(drive.vehicle.frame("HEARTBEAT", type=10, mavlink_version=3, **heartbeat))
    drive.go(0.5)
    boot_ms = 1_000_000 + drive.time_us // 1000
    drive.take(drive.vehicle.frame("SYSTEM_TIME", time_unix_usec=0, time_boot_ms=boot_ms))
    estimate = drive.go(0.5)
    assert estimate.time_us == drive.time_us
    assert estimate.boot_us == drive.time_us + 1_000_000_000
    (frame,) = Emitter({"ATTITUDE_QUATERNION": 100.0}, *OWN).emit(estimate)
    assert int.from_bytes(frame[10:14], "little") == estimate.boot_us // 1000


def test_the_status_messages_say_what_the_estimate_says(drive):
    drive.go(10, course=1.0)
    estimate = drive.go(3)
    emitter = Emitter({"GPS_HEADING_STATUS": 5.0, "ARRAY_STATUS": 1.0}, *OWN)
    decoder = risaf.MAVLink(None)
    status, array = (decoder.parse_buffer(raw)[0] for raw in emitter.emit(estimate))
    assert (status.get_type(), array.get_type()) == ("GPS_HEADING_STATUS", "ARRAY_STATUS")
    assert status.time_usec == array.time_usec == drive.time_us
    assert status.heading == pytest.approx(1.0, abs=1e-4)
    assert status.test_ratio == pytest.approx(
        abs(status.innovation) / (3.0 * status.innovation_std), rel=1e-5, abs=1e-9
    )
    assert status.yaw == pytest.approx(estimate.attitude.euler[2], abs=1e-6)
    assert status.speed == 10.0
    assert (status.fused_count, status.rejected_count) == (50, 0)
    assert status.state == risaf.RISAF_HEADING_STATE_DEAD_RECKONING
    assert status.source == risaf.RISAF_HEADING_SOURCE_VELOCITY
    assert array.active == [5, 5, 5]
    assert (array.sensors_expected, array.sensors_valid, array.healthy) == (5, 5, 5)
    assert (array.epochs, array.epochs_incomplete, array.samples_lost) == (1300, 0, 0)


def test_the_attitude_comes_with_its_variances(drive):
    drive.go(10, course=1.0)
    estimate = drive.go(3)
    (told,) = heard(Emitter({"ATTITUDE_QUATERNION_COV": 5.0}, *OWN).emit(estimate))
    attitude = estimate.attitude
    assert told.time_usec == estimate.boot_us
    assert told.q == pytest.approx(attitude.q_nb, abs=1e-7)
    rates = (told.rollspeed, told.pitchspeed, told.yawspeed)
    assert rates == pytest.approx(attitude.rate_b, abs=1e-7)
    told_of = np.reshape(told.covariance, (3, 3))
    std = (attitude.roll_std, attitude.pitch_std, attitude.yaw_std)
    assert np.sqrt(told_of.diagonal()) == pytest.approx(std, rel=1e-6)
    common = (told_of[0, 1], told_of[0, 2], told_of[1, 2])
    assert common == pytest.approx(attitude.common, rel=1e-6, abs=1e-12)
    assert (told_of == told_of.T).all()


def test_what_is_asked_for_beside_it_says_the_same(drive):
    drive.go(10, course=1.0)
    estimate = drive.go(3)
    assert not {"ESTIMATOR_STATUS", "NAMED_VALUE_FLOAT"} & set(DEFAULT_RATES)
    emitter = Emitter({"ESTIMATOR_STATUS": 1.0}, *OWN)
    (status,) = heard(emitter.emit(estimate))
    assert status.flags == public.ESTIMATOR_ATTITUDE
    assert status.mag_ratio == pytest.approx(estimate.heading.innovation.test_ratio, rel=1e-6)
    assert math.isnan(status.vel_ratio)
    assert math.isnan(status.pos_horiz_accuracy)
    named = heard([emitter.tell("NAMED_VALUE_FLOAT", estimate) for _ in range(22)])
    values = {message.name: message.value for message in named}
    assert [message.name for message in named[:11]] == [message.name for message in named[11:]]
    assert len(values) == 11
    assert values["yaw_std"] == pytest.approx(estimate.attitude.yaw_std, rel=1e-6)
    assert values["hdg_ratio"] == pytest.approx(status.mag_ratio)
    assert values["bias_z"] == pytest.approx(estimate.attitude.bias_b[2], rel=1e-6, abs=1e-12)
    std = [values[f"bias_std_{axis}"] for axis in "xyz"]
    assert std == pytest.approx(estimate.attitude.bias_std, rel=1e-6)
    assert (values["healthy"], values["dead"]) == (5, 0)


def heard(frames):
    decoder = public.MAVLink(None)
    return [decoder.parse_buffer(raw)[0] for raw in frames]


def test_messages_are_thinned_out_on_the_estimates_own_time(drive):
    emitter = Emitter({"ATTITUDE_QUATERNION": 20.0}, *OWN)
    drive.go(0.04)
    sent = [len(emitter.emit(drive.go(0.01))) for _ in range(1000)]
    assert sum(sent) == 200
    assert {sum(sent[k : k + 5]) for k in range(0, 1000, 5)} == {1}


def test_every_sensors_standing_goes_round_with_its_reason():
    drive, generator = Drive(sensors=35), np.random.default_rng(1)
    rates = ["ARRAY_STATUS", "ARRAY_SENSOR_HEALTH", "ARRAY_SENSOR_REASON"]
    emitter = Emitter(dict.fromkeys(rates, 1.0), *OWN)
    decoder, told = risaf.MAVLink(None), []
    bias = np.linspace(-0.02, 0.02, 35)[:, np.newaxis] * [1.0, -1.0, 0.5]
    for step in range(800):
        rate = bias + generator.normal(0.0, math.radians(0.1), (35, 3))
        rate[3] = bias[3]
        if step > 300:
            rate[33] = math.nan
        drive.time_us += PERIOD_US
        (estimate,) = drive.take(drive.vehicle.epoch(drive.time_us, rate))
        told += [decoder.parse_buffer(raw)[0] for raw in emitter.emit(estimate)]
    array, health, reason = ([m for m in told if m.get_type() == name] for name in rates)
    assert (array[-1].healthy, array[-1].suspect, array[-1].dead) == (33, 0, 2)
    blocks = [(m.first_sensor, m.sensor_count) for m in health]
    assert blocks[:4] == [(0, 30), (30, 5), (0, 30), (30, 5)]
    first, second = sorted(health[-2:], key=lambda m: m.first_sensor)
    assert first.state[3] == second.state[3] == risaf.RISAF_SENSOR_STATE_DEAD
    assert sum(first.state) + sum(second.state) == 2 * risaf.RISAF_SENSOR_STATE_DEAD
    assert np.reshape(first.relative_bias, (30, 3))[10] == pytest.approx(bias[10] * 1e5, abs=100)
    assert (reason[-1].first_sensor, reason[-1].sensor_count) == (0, 35)
    assert reason[-1].reason[3] == risaf.RISAF_SENSOR_REASON_FROZEN
    assert reason[-1].reason[33] == risaf.RISAF_SENSOR_REASON_SILENT
    assert sum(reason[-1].reason) == 9


def test_accelerometers_hold_the_tilt_that_gyros_alone_lose():
    drive = Drive()
    drive.go(10, course=0.0)
    for _ in range(6000):
        drive.time_us += PERIOD_US
        drive.take(drive.vehicle.forces(drive.time_us, (0.0, 1.0, -9.75)))
        (estimate,) = drive.take(drive.vehicle.epoch(drive.time_us))
    assert estimate.attitude.euler[0] == pytest.approx(math.atan2(-1.0, 9.75), abs=0.01)
