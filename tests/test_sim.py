"""A scenario is a stream of frames that others can read, the same for the same seed."""

import math
from collections import defaultdict
from dataclasses import replace
from itertools import islice, pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from risaf_link.errors import ConfigError
from risaf_link.mavlink import risaf
from risaf_link.mavlink.tlog import TlogReader, record
from risaf_link.sim import autopilot
from risaf_link.sim.array import CHUNK, count_scale
from risaf_link.sim.readings import readings
from risaf_link.sim.scenario import BOOT_US, scenario
from risaf_link.sim.sensors import TriadErrors
from risaf_link.sim.stream import EPOCH_START_US, frames, record_time_us

GPS = common.MAVLink_gps_raw_int_message
FIX_TYPE = GPS.ordered_fieldnames.index("fix_type")
ACCELEROMETERS = TriadErrors(1e-3, 0.05, 1e-4, 4 * 9.80665)


def decoded(chosen):
    """Every frame of a scenario as pymavlink reads it, by name: lists of (time_us, message)."""
    by_name = defaultdict(list)
    codecs = {True: risaf.MAVLink(None), False: common.MAVLink(None)}
    for time_us, raw in frames(chosen):
        ours = 59610 <= int.from_bytes(raw[7:10], "little") < 59620
        message = codecs[ours].decode(bytearray(raw))
        by_name[message.get_type()].append((time_us, message))
    return by_name


def assembled(messages, field, scale, sensors):
    """Readings of whole epochs, shape (k, sensors, 3), NaN where none came."""
    by_epoch = {}
    for _, message in messages:
        epoch = by_epoch.setdefault(message.time_usec, np.full((sensors, 3), np.nan))
        counts = np.reshape(getattr(message, field), (40, 3))[: message.sensor_count]
        epoch[message.first_sensor :][: message.sensor_count] = counts
    return np.array(list(by_epoch)), scale * np.array(list(by_epoch.values()))


@pytest.mark.parametrize("sensors", [1, 41, 300])
def test_the_rates_in_the_frames_are_the_simulated_ones_within_half_a_count(sensors):
    chosen = scenario("circle", 7, duration=1.1, sensors=sensors)
    messages = decoded(chosen)
    info = messages["IMU_ARRAY_INFO"][0][1]
    assert info.gyro_scale == count_scale(chosen.gyros)
    times, rates = assembled(messages["GYRO_ARRAY"], "rates", info.gyro_scale, sensors)
    blocks = list(readings(chosen))
    expected = np.concatenate([block.rates_b for block in blocks])
    assert rates.shape == expected.shape == (110, sensors, 3)
    assert abs(rates - expected).max() <= info.gyro_scale * 0.5001
    assert (times == np.concatenate([block.time_us for block in blocks])).all()
    assert (times == BOOT_US + 10_000 * np.arange(110)).all()


def test_accelerometers_read_specific_force():
    chosen = replace(scenario("circle", 7, duration=0.5), accelerometers=ACCELEROMETERS)
    messages = decoded(chosen)
    info = messages["IMU_ARRAY_INFO"][0][1]
    assert info.accel_range == pytest.approx(4 * 9.80665)
    _, forces = assembled(messages["ACCEL_ARRAY"], "forces", info.accel_scale, 100)
    expected = np.concatenate([block.forces_b for block in readings(chosen)])
    assert abs(forces - expected).max() <= info.accel_scale * 0.5001
    assert np.median(forces, axis=(0, 1)) == pytest.approx([0.0, 1.0, -9.80665], abs=0.03)


def test_an_array_without_accelerometers_says_so():
    messages = decoded(scenario("circle", 7, duration=0.5))
    assert "ACCEL_ARRAY" not in messages
    assert math.isnan(messages["IMU_ARRAY_INFO"][0][1].accel_scale)


def test_chunks_tell_which_sensors_of_which_epoch_they_hold():
    messages = decoded(scenario("circle", 7, duration=0.05, sensors=90))["GYRO_ARRAY"]
    told = [(m.epoch_seq, m.first_sensor, m.sensor_count) for _, m in messages]
    assert told == [(k, *part) for k in range(5) for part in ((0, 40), (40, 40), (80, 10))]


def test_the_layout_of_readings_is_the_dialects():
    for message in (risaf.MAVLink_gyro_array_message, risaf.MAVLink_accel_array_message):
        assert CHUNK.itemsize == message.unpacker.size
        assert [n for n in CHUNK.names if n != "readings"] == [
            n for n in message.ordered_fieldnames if n not in {"rates", "forces"}
        ]


def test_epoch_numbers_wrap():
    chosen = scenario("circle", 7, duration=66.0, sensors=1, rate=1000)
    raws = (raw for _, raw in frames(chosen) if raw[7:10] == (59611).to_bytes(3, "little"))
    numbers = [int.from_bytes(raw[18:20], "little") for raw in islice(raws, 65530, 65540)]
    assert numbers == [65530, 65531, 65532, 65533, 65534, 65535, 0, 1, 2, 3]


def test_a_rate_beyond_the_range_saturates_and_never_becomes_invalid():
    chosen = scenario("circle", 7, duration=0.3)
    narrow = replace(chosen.gyros, full_scale=math.radians(3.0))
    messages = decoded(replace(chosen, gyros=narrow))["GYRO_ARRAY"]
    counts = np.array([m.rates for _, m in messages]).reshape(-1, 40, 3)
    assert counts.max() == 32767
    assert counts.min() == -32767
    assert (counts[0, :, 2] == 32767).sum() > 35  # the circle turns with 5.7 deg/s


def test_a_reading_that_is_not_valid_is_marked():
    chosen = scenario("circle", 7, duration=0.02, sensors=2)

    class Blind:
        def strike(self, _target):
            return lambda _time_s, _truth_b, readings: np.copyto(readings[:, 1, 2], np.nan)

    message = decoded(replace(chosen, faults={"invalid": Blind()}))["GYRO_ARRAY"][0][1]
    assert message.rates[5] == -32768
    assert -32768 not in message.rates[:5]


def test_gps_describes_where_the_vehicle_was_before_its_latency():
    chosen = scenario("circle", 7, duration=30.0, sensors=1, rate=1)
    messages = decoded(chosen)["GPS_RAW_INT"]
    assert len(messages) == 150
    assert messages[0][0] == BOOT_US + 110_000
    errors = []
    for time_us, gps in messages:
        assert gps.time_usec == time_us
        valid_s = np.array([(time_us - BOOT_US) / 1e6 - 0.11])
        truth = chosen.trajectory(valid_s)
        assert gps.lat == pytest.approx(math.degrees(truth.latitude[0]) * 1e7, abs=6 * 135)
        assert gps.lon == pytest.approx(math.degrees(truth.longitude[0]) * 1e7, abs=6 * 156)
        error = (gps.cog / 100 - math.degrees(0.1 * valid_s[0]) + 180) % 360 - 180
        errors.append(error * 1e5 / gps.hdg_acc)
        assert gps.vel == pytest.approx(1000, abs=50)
    # Taken for the course at arrival, it would be wrong by 1.1 standard deviations.
    assert abs(np.mean(errors)) < 5 / math.sqrt(150)
    assert np.std(errors) == pytest.approx(1.0, abs=5 / math.sqrt(2 * 150))
    assert {(gps.fix_type, gps.h_acc, gps.vel_acc, gps.yaw) for _, gps in messages} == {
        (3, 1500, 100, 0)
    }
    assert gps.hdg_acc / 1e5 == pytest.approx(math.degrees(0.01), rel=0.05)


def test_courses_are_told_from_north_through_east_up_to_less_than_a_turn():
    chosen = scenario("circle", 7, duration=70.0, sensors=1, rate=1)
    to_the_left = replace(chosen.trajectory, radius=-100.0)
    exact = replace(chosen.receiver, velocity_noise=0.0)
    messages = decoded(replace(chosen, trajectory=to_the_left, receiver=exact))["GPS_RAW_INT"]
    told = np.array([gps.cog for _, gps in messages])
    courses = -np.degrees(0.1 * (np.arange(len(told)) / 5))
    assert told[0] == 0
    assert 0 <= told.min() < told.max() < 36_000
    assert (told / 100 - courses + 180) % 360 - 180 == pytest.approx(0.0, abs=0.00501)


def test_the_truth_is_told_ten_times_a_second():
    chosen = scenario("circle", 7, duration=20.0, sensors=1, rate=1)
    messages = decoded(chosen)["HIL_STATE_QUATERNION"]
    assert len(messages) == 200
    for time_us, told in messages:
        assert told.time_usec == time_us
        truth = chosen.trajectory(np.array([(time_us - BOOT_US) / 1e6]))
        assert told.attitude_quaternion == pytest.approx(truth.q_nb[0], abs=1e-7)
        assert told.yawspeed == pytest.approx(0.1)
        assert (told.rollspeed, told.pitchspeed) == (0, 0)
        assert told.lat == pytest.approx(math.degrees(truth.latitude[0]) * 1e7, abs=0.51)
        assert told.lon == pytest.approx(math.degrees(truth.longitude[0]) * 1e7, abs=0.51)
        assert told.alt == 300_000
        assert [told.vx, told.vy, told.vz] == pytest.approx(truth.velocity_n[0] * 100, abs=0.51)
        assert (told.xacc, told.yacc, told.zacc) == (0, 102, -1000)  # 1 m/s^2 to the right


def test_the_array_introduces_itself_first_and_every_second():
    chosen = scenario("circle", 7, duration=3.0, sensors=5)
    messages = decoded(chosen)
    for name in ("IMU_ARRAY_INFO", "HEARTBEAT"):
        assert [time_us - BOOT_US for time_us, _ in messages[name]] == [0, 1_000_000, 2_000_000]
    first = risaf.MAVLink(None).decode(bytearray(next(frames(chosen))[1]))
    assert first.get_type() == "IMU_ARRAY_INFO"
    assert (first.sensor_count, first.rate, first.name) == (5, 100.0, "sim-circle")
    assert first.gyro_range == pytest.approx(math.radians(250))


def test_every_component_numbers_its_own_frames():
    sequences = defaultdict(list)
    for _, raw in frames(scenario("circle", 7, duration=60.0, sensors=1, rate=10)):
        sequences[raw[5], raw[6]].append(raw[4])
    assert set(sequences) == {(1, 1), (1, 158)}
    for numbers in sequences.values():
        assert numbers == [i % 256 for i in range(len(numbers))]
        assert len(numbers) > 256


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 1000), st.floats(1, 1000), st.floats(0.01, 0.3), st.integers(0, 2**70))
def test_frames_are_sent_in_order_whatever_the_array(sensors, rate, duration, seed):
    times = [t for t, _ in islice(frames(scenario("circle", seed, duration, sensors, rate)), 3000)]
    assert times[0] == BOOT_US
    assert all(a <= b for a, b in pairwise(times))
    assert times[-1] <= BOOT_US + 1e6 * max(duration, 0.2) + 1e6 / rate


def test_the_same_seed_gives_the_same_bytes_and_another_does_not():
    first, again, other = (
        list(frames(scenario("circle", seed, duration=2.0, sensors=50))) for seed in (1, 1, 2)
    )
    assert first == again
    assert first != other
    assert [t for t, _ in first] == [t for t, _ in other]


def test_gps_does_not_depend_on_the_array():
    def gps(sensors):
        chosen = scenario("circle", 3, duration=5.0, sensors=sensors)
        return [str(message) for _, message in decoded(chosen)["GPS_RAW_INT"]]

    assert gps(1) == gps(20)


def test_gyros_and_accelerometers_do_not_err_together():
    chosen = scenario("circle", 3, duration=1.0)
    block = next(readings(replace(chosen, accelerometers=chosen.gyros)))
    rates = block.rates_b - block.ideal_rates_b[:, None]
    forces = block.forces_b - block.ideal_forces_b[:, None]
    assert abs(np.corrcoef(rates[..., :2].ravel(), forces[..., :2].ravel())[0, 1]) < 0.05


@given(st.integers(0, 2**40))
def test_record_times_leave_the_two_low_bits_free(time_us):
    stamp = record_time_us(time_us)
    assert stamp % 4 == 0
    assert EPOCH_START_US + time_us - 4 < stamp <= EPOCH_START_US + time_us


def test_a_tlog_of_a_scenario_reads_back():
    sent = list(frames(scenario("circle", 1, duration=1.0, sensors=80)))
    log = b"".join(record(record_time_us(time_us), raw) for time_us, raw in sent)
    reader = TlogReader([log])
    read = [(entry.time_us, entry.frame.raw) for entry in reader]
    assert read == [(EPOCH_START_US + time_us & ~3, raw) for time_us, raw in sent]
    assert (reader.stamps_replaced, reader.parser.skipped) == (0, 0)


def test_an_unknown_scenario_is_refused_and_the_known_ones_are_named():
    with pytest.raises(ConfigError, match=r"^scenario: 'cricle', expected one of circle"):
        scenario("cricle", 1)


@pytest.mark.parametrize(
    ("bad", "text"),
    [
        ({"sensors": 0}, "sensors: 0, expected 1 to 1000"),
        ({"sensors": 1001}, "sensors: 1001, expected 1 to 1000"),
        ({"rate": 0.5}, "rate: 0.5, expected 1 to 1000"),
        ({"rate": math.nan}, "rate: nan, expected 1 to 1000"),
        ({"duration": -1.0}, "duration: -1.0, expected 0.001 to 86400"),
        ({"duration": math.inf}, "duration: inf, expected 0.001 to 86400"),
        ({"seed": -1}, "seed: -1, expected 0 or more"),
    ],
)
def test_what_cannot_be_simulated_is_refused_in_one_line(bad, text):
    with pytest.raises(ConfigError) as error:
        scenario("circle", **{"seed": 1, **bad})
    assert str(error.value) == text


def test_a_receiver_without_a_fix_says_so_and_recovers():
    chosen = replace(
        scenario("circle", 7, duration=30.0, sensors=1, rate=1), outages=((5.0, 8.0), (20.0, 22.0))
    )
    seen = decoded(chosen)
    messages = seen["GPS_RAW_INT"]
    assert len(messages) == 150
    last = None
    for time_us, gps in messages:
        arrival_s = (time_us - BOOT_US) / 1e6
        if 5.0 <= arrival_s < 8.0 or 20.0 <= arrival_s < 22.0:
            assert (gps.fix_type, gps.satellites_visible) == (1, 0)
            assert {gps.vel, gps.cog, gps.eph, gps.epv} == {65535}
            assert (gps.lat, gps.lon, gps.alt) == last
        else:
            assert (gps.fix_type, gps.h_acc) == (3, 1500)
            assert gps.vel < 1100
            last = gps.lat, gps.lon, gps.alt
    sound = decoded(replace(chosen, outages=()))
    told = [str(m) for _, m in messages if m.fix_type == 3]
    assert set(told) < {str(m) for _, m in sound["GPS_RAW_INT"]}
    truth = [str(m) for _, m in seen["HIL_STATE_QUATERNION"]]
    assert truth == [str(m) for _, m in sound["HIL_STATE_QUATERNION"]]


def test_a_receiver_that_never_had_a_fix_tells_none():
    chosen = replace(
        scenario("circle", 7, duration=3.0, sensors=1, rate=1), outages=((0.0, math.inf),)
    )
    messages = decoded(chosen)["GPS_RAW_INT"]
    assert {(gps.fix_type, gps.lat, gps.lon, gps.alt) for _, gps in messages} == {(1, 0, 0, 0)}


@pytest.mark.parametrize(
    ("name", "duration", "sensors", "cut", "back"),
    [
        ("drive1", 300.0, 150, 100.0, math.inf),
        ("drive2", 800.0, 100, 400.0, 650.0),
        ("ekf2", 300.0, 1, 100.0, math.inf),
    ],
)
def test_gps_is_cut_where_the_scenario_says(name, duration, sensors, cut, back):
    chosen = scenario(name, 7)
    assert (chosen.duration, chosen.sensors, chosen.rate) == (duration, sensors, 100.0)
    times, fixed = [], []
    for message in autopilot.gps(chosen):
        times.append((message.time_us - BOOT_US) / 1e6)
        fixed.append(GPS.unpacker.unpack(message.payload)[FIX_TYPE] == 3)
    expected = [not cut <= time_s < back for time_s in times]
    assert fixed == expected
    assert np.diff(times) == pytest.approx(0.2)
