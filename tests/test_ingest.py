"""What the estimator needs is read from every message that carries it, and nothing else is."""

import math
import pickle
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal
from wire import ARRAY, AUTOPILOT, FORCES, SERVICE, array, debug_array, frame, imu, info

from risaf_link.core.heading import GpsFix
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.epoch import ArrayParameters, EpochAssembler, GyroChunk
from risaf_link.mavlink.frame import FrameParser, encode
from risaf_link.mavlink.ingest import GpsParameters, Ingest
from risaf_link.mavlink.truth import truth_of, truths_in

G = 9.80665
SECOND = 1_000_000
NAN3 = [math.nan] * 3


def ingest(*frames, gps=GpsParameters(), **array_parameters) -> Ingest:  # noqa: B008
    """An ingest that has read some frames."""
    made = Ingest(ArrayParameters(**array_parameters), gps, SERVICE)
    for one in frames:
        made.decode(one, 0)
    return made


def rates(chunk):
    return chunk.rates_s.tolist()


class TestOurDialect:
    def test_counts_become_rates_of_the_sensors_in_the_chunk(self):
        counts = [(1, -2, 3), (4000, -5000, 6000)]
        chunk = ingest(info()).decode(array(77, counts, first_sensor=40, epoch_seq=9), 88)
        assert chunk.rates_s == pytest.approx(np.array(counts) * 1e-3, rel=1e-6)
        assert chunk.forces_s.shape == (0, 3)
        assert (chunk.time_us, chunk.received_us) == (77, 88)
        assert (chunk.first_sensor, chunk.sequence, chunk.sensors) == (40, 9, 3)
        assert chunk.source == (*ARRAY, "GYRO_ARRAY", 0)

    def test_a_full_message_holds_forty_sensors(self):
        counts = np.arange(120).reshape(40, 3)
        chunk = ingest(info()).decode(array(1, counts.tolist()), 0)
        assert chunk.rates_s == pytest.approx(counts * 1e-3, rel=1e-6)

    def test_counts_become_specific_forces_by_a_scale_of_their_own(self):
        reader = ingest(info(accel_scale=0.01), array(1, [(1, 1, 1)]))
        chunk = reader.decode(array(1, [(0, 100, -981)], of=FORCES), 0)
        assert chunk.forces_s == pytest.approx(np.array([[0, 1, -9.81]]))
        assert chunk.rates_s.shape == (0, 3)

    def test_invalid_and_saturated_readings_are_nan_and_counted(self):
        reader = ingest(info(gyro_scale=1e-3, gyro_range=20.0))
        chunk = reader.decode(array(1, [(-32768, 19_999, 20_000), (-20_001, 32_767, -32_767)]), 0)
        assert np.isnan(chunk.rates_s).tolist() == [[True, False, True], [True, True, True]]
        assert reader.counts == Counter(invalid=1, saturated=4)

    def test_the_end_of_the_counts_saturates_where_the_range_is_unknown(self):
        reader = ingest(info(gyro_range=math.nan))
        chunk = reader.decode(array(1, [(32_766, 32_767, -32_767)]), 0)
        assert np.isnan(chunk.rates_s).tolist() == [[False, True, True]]

    def test_without_a_scale_nothing_can_be_read(self):
        reader = ingest()
        assert reader.decode(array(1, [(1, 2, 3)]), 0) is None
        assert reader.counts == Counter(unscaled=1)

    def test_the_configuration_tells_the_scale_of_an_array_that_does_not(self):
        reader = ingest(gyro_scale=0.5, gyro_range=1.0)
        assert rates(reader.decode(array(1, [(1, -2, 3)]), 0))[0][0] == 0.5
        assert reader.counts == Counter(saturated=2)

    def test_the_array_knows_its_scale_better_than_the_configuration(self):
        chunk = ingest(info(), gyro_scale=0.5).decode(array(1, [(1, 1, 1)]), 0)
        assert chunk.rates_s == pytest.approx(1e-3)

    def test_forces_need_accelerometers(self):
        reader = ingest(info(), array(1, [(1, 1, 1)]))
        assert reader.decode(array(1, [(1, 1, 1)], of=FORCES), 0) is None
        assert reader.counts == Counter(unscaled=1)

    @pytest.mark.parametrize("count", [0, 41, 255])
    def test_a_sensor_count_that_cannot_be_is_malformed(self, count):
        reader = ingest(info())
        assert reader.decode(array(1, [(1, 1, 1)], sensor_count=count), 0) is None
        assert reader.counts == Counter(malformed=1)

    @pytest.mark.parametrize("time_us", [2**63, 2**64 - 1])
    def test_a_time_that_no_clock_shows_is_malformed(self, time_us):
        reader = ingest(info())
        assert reader.decode(array(time_us, [(1, 1, 1)]), 0) is None
        assert reader.counts == Counter(malformed=1)

    @pytest.mark.parametrize(
        "told",
        [{"gyro_scale": scale} for scale in (0.0, -1.0, math.nan, math.inf)]
        + [{"sensor_count": 65535}],
    )
    def test_what_an_array_cannot_be_is_malformed_and_what_it_said_before_stays(self, told):
        reader = ingest(info(), info(**told))
        assert reader.counts == Counter(malformed=1)
        assert reader.decode(array(1, [(1, 1, 1)]), 0).rates_s == pytest.approx(1e-3)

    def test_an_array_that_says_otherwise_is_believed_when_it_says_so_again(self):
        reader = ingest(info(), info(gyro_scale=2e-3), info())
        assert reader.decode(array(1, [(1, 1, 1)]), 0).rates_s == pytest.approx(1e-3)
        assert reader.counts == Counter(contested=1)
        reader = ingest(info(), *(info(gyro_scale=2e-3, time_usec=at) for at in (1, 2, 3)))
        assert reader.decode(array(1, [(1, 1, 1)]), 0).rates_s == pytest.approx(2e-3)
        assert reader.counts == Counter(contested=1)

    @pytest.mark.parametrize("scale", [0.0, -1.0, math.inf, math.nan])
    def test_a_scale_that_cannot_be_means_no_accelerometers(self, scale):
        told = ingest(info(accel_scale=scale)).info(array_source(0))
        assert math.isnan(told.accel_scale)

    def test_what_an_array_says_of_itself(self):
        told = ingest(info(accel_scale=0.5, accel_range=40.0, array_id=7)).info(array_source(7))
        assert (told.name, told.sensors, told.gyro_range) == ("bench", 3, 10.0)
        assert (told.accel_scale, told.accel_range) == (0.5, 40.0)
        assert told.gyro_scale == pytest.approx(1e-3)

    def test_names_end_at_the_first_nul_and_need_not_be_text(self):
        assert ingest(info(name=b"a\0b")).info(array_source(0)).name == "a"
        assert ingest(info(name=b"\xff" * 16)).info(array_source(0)).name == "�" * 16


def array_source(array_id):
    reader = ingest(info(array_id=array_id), array(1, [(1, 1, 1)], array_id=array_id))
    return reader.decode(array(2, [(1, 1, 1)], array_id=array_id), 0).source


class TestDebugFloatArray:
    def test_the_array_id_is_the_first_sensor_and_the_rest_is_padding(self):
        reader = ingest()
        chunk = reader.decode(debug_array(5, b"gyro", [(1, 2, 3), (4, 5, 6)], first=19), 6)
        assert rates(chunk) == [[1, 2, 3], [4, 5, 6]]
        assert (chunk.time_us, chunk.first_sensor) == (5, 19)
        assert reader.counts == Counter()

    def test_nineteen_sensors_fit(self):
        readings = np.arange(57.0).reshape(19, 3).tolist()
        assert rates(ingest().decode(debug_array(5, b"gyro", readings), 6)) == readings

    def test_accelerometers_may_be_fewer(self):
        reader = ingest(debug_array(5, b"gyro", [(1, 2, 3)] * 2))
        chunk = reader.decode(debug_array(5, b"accel", [(0, 0, -G)]), 6)
        assert chunk.forces_s == pytest.approx(np.array([[0, 0, -G]]))
        assert len(chunk.rates_s) == 0

    def test_a_reading_that_is_not_finite_is_nan_and_counted(self):
        reader = ingest()
        chunk = reader.decode(debug_array(5, b"gyro", [NAN3, (1, math.inf, 3)]), 6)
        assert np.isnan(chunk.rates_s).tolist() == [[True] * 3, [False, True, False]]
        assert reader.counts == Counter(invalid=4)

    def test_the_configured_range_is_where_it_saturates(self):
        reader = ingest(gyro_range=2.0)
        assert np.isnan(reader.decode(debug_array(5, b"gyro", [(1, 2, -3)]), 6).rates_s).sum() == 2
        assert reader.counts == Counter(saturated=2)

    def test_other_arrays_are_nothing_to_us(self):
        assert ingest().decode(debug_array(5, b"gyroscope", [(1, 2, 3)]), 6) is None
        assert ingest().decode(debug_array(5, b"", [(1, 2, 3)]), 6) is None


class TestAutopilotImus:
    def test_highres_imu_is_in_si_units_and_its_id_is_the_sensor(self):
        sent = imu("HIGHRES_IMU", 123, (0.5, -0.25, 2.0), (1.0, 2.0, -9.5), id=2)
        chunk = ingest().decode(sent, 7)
        assert (rates(chunk), chunk.forces_s.tolist()) == ([[0.5, -0.25, 2.0]], [[1.0, 2.0, -9.5]])
        assert (chunk.time_us, chunk.received_us, chunk.first_sensor) == (123, 7, 2)

    @pytest.mark.parametrize(
        ("name", "sensor"),
        [("RAW_IMU", 0), ("SCALED_IMU", 0), ("SCALED_IMU2", 1), ("SCALED_IMU3", 2)],
    )
    def test_the_others_are_in_mrad_per_s_and_milli_g(self, name, sensor):
        chunk = ingest().decode(imu(name, 123_000, (1, -20, 300), (0, 500, -1000)), 7)
        assert chunk.rates_s == pytest.approx(np.array([[0.001, -0.02, 0.3]]))
        assert chunk.forces_s == pytest.approx(np.array([[0, G / 2, -G]]))
        assert (chunk.time_us, chunk.first_sensor) == (123_000, sensor)

    def test_raw_imu_may_have_an_id(self):
        assert ingest().decode(imu("RAW_IMU", 1, id=5), 0).first_sensor == 5

    def test_mavlink_1_has_no_id(self):
        sent = frame("RAW_IMU", version=1, time_usec=9, xgyro=1000)
        assert sent.version == 1
        assert rates(ingest().decode(sent, 0)) == [[1.0, 0.0, 0.0]]

    def test_readings_at_the_end_of_the_range_are_saturated(self):
        reader = ingest()
        chunk = reader.decode(imu("RAW_IMU", 1, (32767, -32768, 32766), (0, 32767, 0)), 0)
        assert np.isnan(chunk.rates_s).tolist() == [[True, True, False]]
        assert np.isnan(chunk.forces_s).tolist() == [[False, True, False]]
        assert reader.counts == Counter(saturated=3)

    def test_readings_that_are_not_finite_are_invalid(self):
        reader = ingest()
        chunk = reader.decode(imu("HIGHRES_IMU", 1, (math.nan, math.inf, 1.0), (0.0,) * 3), 0)
        assert np.isnan(chunk.rates_s).tolist() == [[True, True, False]]
        assert reader.counts == Counter(invalid=2)

    def test_a_message_for_a_compass_alone_is_no_gyro_at_rest(self):
        reader = ingest()
        assert reader.decode(imu("SCALED_IMU3", 1000, (0, 0, 0), (0, 0, 0), xmag=300), 0) is None
        assert reader.counts == Counter(absent=1)


class TestTheSameSensorInSeveralMessages:
    ORDER = ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU")

    @staticmethod
    def taken(rates_hz, seconds=1.0, stop_s=math.inf):
        """Which messages are taken in the second half; `stop_s`: when the first one stops."""
        reader, taken = ingest(), []
        events = sorted(
            (round(k * SECOND / rate), order, name)
            for order, (name, rate) in enumerate(rates_hz.items())
            for k in range(round(seconds * rate))
            if order or k / rate < stop_s
        )
        for time_us, _, name in events:
            if reader.decode(imu(name, time_us + SECOND), time_us) and time_us > seconds * 5e5:
                taken.append(name)
        return taken

    @pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 0, 2), (2, 0, 1)])
    def test_the_finest_is_taken_whatever_the_order(self, order):
        names = {self.ORDER[i]: 100 for i in order}
        assert self.taken(names) == ["HIGHRES_IMU"] * 49

    def test_the_finer_integer_is_taken(self):
        assert set(self.taken({"SCALED_IMU": 50, "RAW_IMU": 50})) == {"RAW_IMU"}

    def test_a_fine_one_that_is_rare_does_not_replace_a_frequent_one(self):
        assert set(self.taken({"HIGHRES_IMU": 10, "RAW_IMU": 100})) == {"RAW_IMU"}

    def test_a_fine_one_at_half_the_rate_does(self):
        assert set(self.taken({"HIGHRES_IMU": 50, "RAW_IMU": 100})) == {"HIGHRES_IMU"}

    def test_a_coarse_one_steps_in_when_the_finest_stops(self):
        taken = self.taken({"HIGHRES_IMU": 100, "RAW_IMU": 100}, stop_s=0.7)
        assert set(taken[:18]) == {"HIGHRES_IMU"}
        assert set(taken[-20:]) == {"RAW_IMU"}

    def test_other_sensors_go_on_beside_it(self):
        taken = self.taken({"RAW_IMU": 20, "SCALED_IMU2": 20, "HIGHRES_IMU": 100})
        assert (taken.count("HIGHRES_IMU"), taken.count("SCALED_IMU2")) == (49, 9)
        assert "RAW_IMU" not in taken

    def test_a_single_message_of_a_finer_kind_changes_nothing(self):
        reader = ingest()
        reader.decode(imu("HIGHRES_IMU", 0, (0.1, 0.2, 0.3)), 0)
        chunks = [reader.decode(imu("RAW_IMU", k * 10_000), 0) for k in range(100)]
        assert sum(chunk is not None for chunk in chunks) >= 99

    def test_it_is_chosen_anew_after_a_reboot(self):
        reader = ingest()
        times_us = (*range(10**9, 10**9 + 300_000, 10_000), *range(0, 300_000, 10_000))
        taken = [
            name
            for time_us in times_us
            for name in ("RAW_IMU", "HIGHRES_IMU")
            if reader.decode(imu(name, time_us), time_us)
        ]
        assert set(taken[-28:]) == {"HIGHRES_IMU"}
        assert len(taken) <= 64


class TestWhoIsListenedTo:
    def test_what_the_service_sent_itself_is_not(self):
        reader = ingest(info(SERVICE))
        own = [array(1, [(1, 1, 1)], SERVICE), imu("RAW_IMU", 1, sender=SERVICE)]
        own.append(frame("GPS_RAW_INT", SERVICE, fix_type=3, time_usec=1))
        assert [reader.decode(one, 0) for one in own] == [None] * 3
        assert reader.counts == Counter(own=4)

    def test_an_array_before_an_autopilot(self):
        reader = ingest(info())
        assert reader.decode(imu("RAW_IMU", 1), 1)
        assert reader.decode(array(2, [(1, 1, 1)]), 2)
        assert reader.decode(imu("RAW_IMU", 3), 3) is None
        assert reader.counts == Counter(other_source=1)

    def test_an_array_that_cannot_be_read_yet_silences_nobody(self):
        reader = ingest(array(1, [(1, 1, 1)]))
        assert reader.decode(imu("RAW_IMU", 1), 1)

    def test_accelerometers_alone_silence_nobody(self):
        reader = ingest(info(accel_scale=0.1))
        assert reader.decode(array(1, [(1, 1, 1)], of=FORCES), 1) is None
        assert reader.decode(debug_array(1, b"accel", [(1, 1, 1)]), 1) is None
        assert reader.decode(imu("RAW_IMU", 1), 1)

    def test_another_source_takes_over_after_three_seconds_of_silence(self):
        reader = ingest(info())
        assert reader.decode(array(1, [(1, 1, 1)]), 0)
        assert reader.decode(imu("RAW_IMU", 1), 3 * SECOND) is None
        assert reader.decode(imu("RAW_IMU", 2), 3 * SECOND + 1)
        assert reader.decode(array(2, [(1, 1, 1)]), 3 * SECOND + 2)

    def test_arrival_times_that_go_back_a_little_are_no_silence(self):
        reader = ingest(info(), info(array_id=1))
        assert reader.decode(array(1, [(1, 1, 1)]), 10_000)
        assert reader.decode(array(1, [(1, 1, 1)], array_id=1), 9_000) is None

    def test_of_two_arrays_the_first_one_is_kept(self):
        reader = ingest(info(array_id=4), info(array_id=1))
        ids = [4, 1] * 5
        chunks = [reader.decode(array(k, [(1, 1, 1)], array_id=i), k) for k, i in enumerate(ids)]
        assert [chunk.source.array_id for chunk in chunks if chunk] == [4] * 5

    def test_the_configuration_may_say_which_array(self):
        reader = ingest(info(array_id=4), info(array_id=1), id=1)
        assert reader.decode(array(1, [(1, 1, 1)], array_id=4), 0) is None
        assert reader.decode(array(1, [(1, 1, 1)], array_id=1), 0)

    def test_an_autopilot_has_no_array_id(self):
        assert ingest(id=1).decode(imu("RAW_IMU", 1), 0)

    def test_the_configuration_may_say_which_encodings(self):
        reader = ingest(info(), encodings=("IMU",))
        assert reader.decode(array(1, [(1, 1, 1)]), 0) is None
        assert reader.decode(imu("RAW_IMU", 1), 0)

    def test_an_autopilot_before_a_gimbal(self):
        reader = ingest()
        assert reader.decode(imu("RAW_IMU", 1, sender=(1, 154)), 0)
        assert reader.decode(imu("RAW_IMU", 1), 0)
        assert reader.decode(imu("RAW_IMU", 2, sender=(1, 154)), 0) is None

    def test_this_vehicle_before_another(self):
        reader = ingest()
        assert reader.decode(imu("RAW_IMU", 1, sender=(2, 1)), 0)
        assert reader.decode(imu("RAW_IMU", 1), 0)
        assert reader.decode(imu("RAW_IMU", 2, sender=(2, 1)), 0) is None


HEARTBEAT = {"base_mode": 0, "custom_mode": 0, "system_status": 4, "mavlink_version": 3}


class TestDelay:
    @pytest.mark.parametrize(
        ("vehicle_type", "autopilot", "hertz"), [(10, 3, 4.0), (11, 3, 4.0), (2, 3, 20.0)]
    )
    def test_ardupilots_gyros_are_late_by_its_low_pass(self, vehicle_type, autopilot, hertz):
        beat = frame("HEARTBEAT", type=vehicle_type, autopilot=autopilot, **HEARTBEAT)
        reader = ingest(beat)
        source = reader.decode(imu("RAW_IMU", 1), 0).source
        low_pass = signal.butter(2, math.tau * hertz, analog=True)
        _, response = signal.freqs(*low_pass, worN=[0.0, 0.01])
        assert reader.delay_of(source) == pytest.approx(-np.diff(np.angle(response))[0] / 0.01)

    @pytest.mark.parametrize("autopilot", [12, 8])
    def test_those_of_others_and_of_arrays_are_not(self, autopilot):
        reader = ingest(frame("HEARTBEAT", type=10, autopilot=autopilot, **HEARTBEAT), info())
        assert reader.delay_of(reader.decode(imu("RAW_IMU", 1), 0).source) == 0.0
        reader = ingest(frame("HEARTBEAT", type=10, autopilot=3, **HEARTBEAT), info())
        assert reader.delay_of(reader.decode(array(1, [(1, 1, 1)]), 0).source) == 0.0
        assert reader.delay_of(None) == 0.0

    def test_the_configuration_knows_better(self):
        reader = ingest(info(), delay=0.02)
        assert reader.delay_of(reader.decode(array(1, [(1, 1, 1)]), 0).source) == 0.02


# Fields of one fix in the sender's units, and what it is in ours.
POSITION = {"lat": 302217000, "lon": -348012000}
RAW_FIX = {"time_usec": 5, "fix_type": 3, **POSITION, "vel": 1234, "cog": 9000}
INPUT_FIX = {"time_usec": 5, "fix_type": 3, **POSITION, "vn": 3.0, "ve": -4.0}


def fix_of(name, **fields) -> GpsFix:
    return ingest(gps=GpsParameters((name,))).decode(frame(name, **fields), 0)


class TestGps:
    @pytest.mark.parametrize("name", ["GPS_RAW_INT", "GPS2_RAW", "HIL_GPS"])
    def test_position_speed_and_course(self, name):
        fix = fix_of(name, **RAW_FIX)
        assert (fix.time_us, fix.usable) == (5, True)
        assert fix.latitude == pytest.approx(math.radians(30.2217))
        assert fix.longitude == pytest.approx(math.radians(-34.8012))
        assert fix.speed == pytest.approx(12.34)
        assert fix.course == pytest.approx(math.pi / 2)

    @pytest.mark.parametrize("name", ["GPS_RAW_INT", "GPS2_RAW"])
    def test_accuracies(self, name):
        fix = fix_of(name, **RAW_FIX, vel_acc=250, hdg_acc=100_000, h_acc=1500)
        assert fix.speed_std == pytest.approx(0.25)
        assert fix.course_std == pytest.approx(math.radians(1.0))
        assert fix.position_std == pytest.approx(1.5)

    @pytest.mark.parametrize("name", ["GPS_RAW_INT", "GPS2_RAW", "HIL_GPS"])
    def test_what_a_receiver_does_not_say_is_unknown(self, name):
        fix = fix_of(name, **RAW_FIX)
        unknown = (fix.yaw, fix.speed_std, fix.course_std, fix.position_std)
        assert np.isnan(unknown).all()

    def test_mavlink_1_has_none_of_the_later_fields(self):
        fix = ingest().decode(frame("GPS_RAW_INT", version=1, **RAW_FIX), 0)
        assert fix.speed == pytest.approx(12.34)
        assert np.isnan((fix.yaw, fix.speed_std, fix.course_std, fix.position_std)).all()

    @pytest.mark.parametrize("name", ["GPS_RAW_INT", "GPS2_RAW", "HIL_GPS"])
    def test_65535_is_no_speed_and_no_course(self, name):
        assert math.isnan(fix_of(name, **RAW_FIX | {"vel": 65535}).speed)
        assert math.isnan(fix_of(name, **RAW_FIX | {"cog": 65535}).course)
        assert fix_of(name, **RAW_FIX | {"vel": 65534, "cog": 35999}).speed == 655.34

    @pytest.mark.parametrize("name", ["GPS_RAW_INT", "GPS2_RAW", "HIL_GPS", "GPS_INPUT"])
    def test_yaw_of_two_antennas_has_two_ways_to_be_missing_and_one_to_be_north(self, name):
        fix = INPUT_FIX if name == "GPS_INPUT" else RAW_FIX
        assert math.isnan(fix_of(name, **fix, yaw=0).yaw)
        assert math.isnan(fix_of(name, **fix, yaw=65535).yaw)
        assert math.cos(fix_of(name, **fix, yaw=36000).yaw) == pytest.approx(1.0)
        assert fix_of(name, **fix, yaw=9000).yaw == pytest.approx(math.pi / 2)

    @pytest.mark.parametrize("name", ["GPS_RAW_INT", "GPS2_RAW", "HIL_GPS", "GPS_INPUT"])
    def test_a_receiver_without_a_yaw_now_is_told_from_one_with_one_antenna(self, name):
        fix = INPUT_FIX if name == "GPS_INPUT" else RAW_FIX
        assert not fix_of(name, **fix, yaw=0).yaw_capable
        assert fix_of(name, **fix, yaw=65535).yaw_capable
        assert fix_of(name, **fix, yaw=9000).yaw_capable

    @pytest.mark.parametrize(
        ("vehicle_type", "autopilot", "heads"),
        [(2, 3, False), (1, 12, False), (13, 3, False), (10, 3, True), (11, 3, True), (2, 8, True)],
    )
    def test_what_hovers_or_flies_says_so_by_its_heartbeat(self, vehicle_type, autopilot, heads):
        service = ingest()
        service.decode(frame("HEARTBEAT", type=vehicle_type, autopilot=autopilot, **HEARTBEAT), 0)
        assert service.decode(frame("GPS_RAW_INT", **RAW_FIX), 0).course_is_heading is heads

    def test_gps_input_has_velocity_and_accuracies_in_si_units(self):
        fix = fix_of("GPS_INPUT", **INPUT_FIX, speed_accuracy=0.5, horiz_accuracy=2.0)
        assert fix.speed == pytest.approx(5.0)
        assert fix.course == pytest.approx(math.atan2(-4, 3))
        assert (fix.speed_std, fix.position_std) == (0.5, 2.0)
        assert fix.latitude == pytest.approx(math.radians(30.2217))

    @pytest.mark.parametrize(
        ("flag", "unknown"),
        [
            (0, set()),
            (8, {"speed", "course"}),
            (32, {"speed_std"}),
            (64, {"position_std"}),
            (255, {"speed", "course", "speed_std", "position_std"}),
            (1 | 2 | 4 | 16 | 128, set()),
        ],
    )
    def test_gps_input_says_what_to_ignore(self, flag, unknown):
        sent = INPUT_FIX | {"speed_accuracy": 0.5, "horiz_accuracy": 2.0, "ignore_flags": flag}
        fix = fix_of("GPS_INPUT", **sent)
        names = ("speed", "course", "speed_std", "position_std")
        assert {name for name in names if math.isnan(getattr(fix, name))} == unknown

    def test_a_position_that_is_none_is_unknown(self):
        fix = fix_of("GPS_RAW_INT", **RAW_FIX | {"lat": 2**31 - 1, "lon": 2**31 - 1})
        assert math.isnan(fix.latitude)
        assert math.isnan(fix.longitude)
        assert fix.speed == pytest.approx(12.34)

    def test_global_position_is_read_when_configured(self):
        sent = {"time_boot_ms": 7, **POSITION, "vx": 300, "vy": -400}
        fix = fix_of("GLOBAL_POSITION_INT", **sent)
        assert (fix.time_us, fix.speed) == (7000, pytest.approx(5.0))
        assert fix.course == pytest.approx(math.atan2(-4, 3))
        assert ingest().decode(frame("GLOBAL_POSITION_INT", **sent), 0) is None
        assert fix_of("GLOBAL_POSITION_INT", time_boot_ms=7) is None  # it does not know yet

    @pytest.mark.parametrize("name", ["GPS_RAW_INT", "GPS2_RAW", "HIL_GPS", "GPS_INPUT"])
    @pytest.mark.parametrize("fix_type", range(9))
    def test_the_fix_type_is_believed(self, name, fix_type):
        reader = ingest()
        fix = reader.decode(frame(name, time_usec=5, fix_type=fix_type, lat=1), 0)
        assert (fix is not None) == (fix_type >= 3)
        assert reader.counts["no_fix"] == (fix_type < 3)


class TestRepeatedFixes:
    def test_the_same_time_is_not_taken_twice(self):
        reader = ingest()
        assert reader.decode(frame("GPS_RAW_INT", **RAW_FIX), 0)
        assert reader.decode(frame("GPS_RAW_INT", **RAW_FIX | {"fix_type": 6, "vel": 9}), 1) is None
        assert reader.counts == Counter(repeated_fix=1)
        assert reader.decode(frame("GPS_RAW_INT", **RAW_FIX | {"time_usec": 6}), 2)

    def test_without_a_time_the_same_message_is_not_taken_twice(self):
        reader, timeless = ingest(), RAW_FIX | {"time_usec": 0}
        assert reader.decode(frame("GPS_RAW_INT", **timeless), 0)
        assert reader.decode(frame("GPS_RAW_INT", **timeless), 1) is None
        assert reader.decode(frame("GPS_RAW_INT", **timeless | {"cog": 9001}), 2)

    def test_nor_one_whose_velocity_is_not_a_number(self):
        reader, sent = ingest(), frame("GPS_INPUT", **INPUT_FIX | {"time_usec": 0, "vn": math.nan})
        assert reader.decode(sent, 0)
        assert reader.decode(sent, 1) is None

    def test_an_old_fix_that_comes_again_over_a_slower_link_is_not_taken(self):
        reader = ingest()
        times_us = [10, 20, 10, 30, 20]
        fixes = [
            reader.decode(frame("GPS_RAW_INT", **RAW_FIX | {"time_usec": t}), 0) for t in times_us
        ]
        assert [fix.time_us for fix in fixes if fix] == [10, 20, 30]

    def test_after_a_reboot_earlier_times_are_taken(self):
        reader = ingest()
        assert reader.decode(frame("GPS_RAW_INT", **RAW_FIX | {"time_usec": 60 * SECOND}), 0)
        assert reader.decode(frame("GPS_RAW_INT", **RAW_FIX | {"time_usec": SECOND}), 1)

    def test_a_receiver_that_repeats_itself_makes_way_for_another(self):
        reader = ingest()
        assert reader.decode(frame("GPS_RAW_INT", **RAW_FIX), 0)
        for second in range(1, 5):
            assert reader.decode(frame("GPS_RAW_INT", **RAW_FIX), second * SECOND) is None
        assert reader.decode(frame("GPS2_RAW", **RAW_FIX), 5 * SECOND)


class TestReceivers:
    def test_the_best_message_is_taken_and_the_next_after_silence(self):
        reader = ingest()
        first, second = (
            lambda k, n=name: frame(n, **RAW_FIX | {"time_usec": k})
            for name in ("GPS_RAW_INT", "GPS2_RAW")
        )
        assert reader.decode(second(1), 0)
        assert reader.decode(first(1), 1)
        assert reader.decode(second(2), 2) is None
        assert reader.counts == Counter(other_source=1)
        assert reader.decode(second(3), 3 * SECOND + 2)
        assert reader.decode(first(4), 3 * SECOND + 3)

    def test_a_receiver_without_a_fix_makes_way(self):
        reader = ingest(frame("GPS_RAW_INT", **RAW_FIX | {"fix_type": 1}))
        assert reader.decode(frame("GPS2_RAW", **RAW_FIX), 0)

    def test_two_receivers_of_one_sender_are_not_mixed(self):
        reader = ingest()
        fixes = [
            reader.decode(frame("GPS_INPUT", **INPUT_FIX | {"time_usec": k}, gps_id=k % 2), k)
            for k in range(1, 9)
        ]
        assert [fix.time_us for fix in fixes if fix] == [1, 2, 4, 6, 8]

    def test_this_vehicles_before_anothers(self):
        reader = ingest()
        assert reader.decode(frame("GPS_RAW_INT", (2, 1), **RAW_FIX), 0)
        assert reader.decode(frame("GPS2_RAW", **RAW_FIX), 0)
        assert reader.decode(frame("GPS_RAW_INT", (2, 1), **RAW_FIX | {"time_usec": 6}), 0) is None


class TestTruth:
    def test_of_hil_state_quaternion(self):
        q_nb = [0.5, -0.5, 0.5, 0.5]
        truth = truth_of(frame("HIL_STATE_QUATERNION", time_usec=8, attitude_quaternion=q_nb))
        assert (truth.time_us, truth.q_nb.tolist()) == (8, q_nb)

    @pytest.mark.parametrize("name", ["SIM_STATE", "SIMSTATE"])
    def test_of_simulators_that_tell_angles(self, name):
        truth = truth_of(frame(name, yaw=math.pi / 2))
        assert truth.time_us is None
        assert truth.q_nb == pytest.approx([math.sqrt(0.5), 0, 0, math.sqrt(0.5)])

    def test_is_not_in_anything_else(self):
        assert truth_of(frame("ATTITUDE", yaw=1.0)) is None

    @pytest.mark.parametrize("angle", [math.nan, math.inf])
    def test_must_be_a_number(self, angle):
        assert truth_of(frame("SIM_STATE", yaw=angle)) is None
        quaternion = [1.0, 0.0, 0.0, angle]
        assert truth_of(frame("HIL_STATE_QUATERNION", attitude_quaternion=quaternion)) is None
        assert truth_of(frame("HIL_STATE_QUATERNION")) is None

    def test_a_nan_that_signals_is_no_number_either(self):
        q_nb, signalling = [0.5, -0.5, 0.5, 0.5], b"\x01\x00\xa0\x7f"
        good = frame("HIL_STATE_QUATERNION", time_usec=8, attitude_quaternion=q_nb)
        payload = good.payload[:8] + 4 * signalling + good.payload[24:]
        raws = encode(good.message_id, payload, 0, 1, 1), good.raw
        table = FrameParser().receive_table(b"".join(raws))
        (truths,) = truths_in(table, np.array([1, 2], np.uint64))
        assert truths.q_nb.tolist() == [q_nb]
        assert truths.received_us.tolist() == [2]


READ = [
    *("IMU_ARRAY_INFO", "GYRO_ARRAY", "ACCEL_ARRAY", "DEBUG_FLOAT_ARRAY", "HIGHRES_IMU", "RAW_IMU"),
    *("SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3", "GPS_RAW_INT", "GPS2_RAW", "GPS_INPUT"),
    *("HIL_GPS", "GLOBAL_POSITION_INT", "HIL_STATE_QUATERNION", "SIM_STATE", "SIMSTATE"),
]
ALL_GPS = GpsParameters(("GPS_RAW_INT", "GPS2_RAW", "GPS_INPUT", "HIL_GPS", "GLOBAL_POSITION_INT"))
TIMES = st.sampled_from([0, 1, 10_000, 10**9, 2**62, 2**63, 2**64 - 1]) | st.integers(0, 10**6)


class Service:
    """Ingest and assembler behind a parser, as in the pipeline."""

    def __init__(self):
        self.ingest = Ingest(ArrayParameters(), ALL_GPS, SERVICE)
        self.assembler = EpochAssembler(ArrayParameters())
        self._parser = FrameParser()

    def take(self, raw, received_us):
        epochs = []
        for one in self._parser.receive_data(raw):
            truth_of(one)
            datum = self.ingest.decode(one, received_us)
            if isinstance(datum, GyroChunk):
                epochs += self.assembler.add(datum)
        return epochs

    def size(self):
        return len(pickle.dumps((self.ingest, self.assembler)))


class TestWhateverComes:
    @given(
        st.lists(
            st.tuples(
                st.sampled_from(READ),
                st.binary(min_size=1, max_size=255),
                st.integers(0, 255),
                TIMES,
            ),
            max_size=40,
        )
    )
    def test_random_payloads_do_not_raise(self, messages):
        service = Service()
        for name, payload, component, received_us in messages:
            service.take(encode(IDS[name], payload, 0, 1, component), received_us)
        service.assembler.flush()

    @given(
        st.lists(
            st.tuples(
                *(TIMES, st.sampled_from([0, 3, 65535]), st.sampled_from([0, 1, 3, 40, 41, 255])),
                *(st.integers(0, 1), st.booleans(), st.binary(max_size=20), TIMES),
            ),
            max_size=40,
        ),
        st.floats(width=32),
        st.floats(width=32),
        st.integers(0, 65535),
    )
    def test_wild_arrays_do_not_raise(self, messages, scale, limit, sensors):
        service = Service()
        told = {"gyro_scale": scale, "accel_scale": scale, "gyro_range": limit}
        for one in (info(), info(array_id=1, sensor_count=0), info(**told, sensor_count=sensors)):
            service.take(one.raw, 0)
        for time_us, first, count, array_id, is_gyro, noise, received_us in messages:
            head = time_us.to_bytes(8, "little") + noise[:2].ljust(2) + first.to_bytes(2, "little")
            payload = (head + noise).ljust(252, b"\1") + bytes((count, array_id))
            name = "GYRO_ARRAY" if is_gyro else "ACCEL_ARRAY"
            for epoch in service.take(encode(IDS[name], payload, 0, *ARRAY), received_us):
                assert epoch.rates_b.shape[1] == epoch.forces_b.shape[1] == 3
        service.assembler.flush()

    @pytest.mark.parametrize("senders", [2, 255])
    def test_memory_is_bounded(self, senders):
        random = np.random.default_rng(senders)
        service, sizes = Service(), []
        for k in range(6000):
            name = READ[random.integers(len(READ))]
            payload = bytearray(random.bytes(254))
            payload[:8] = int(10_000 * k * random.uniform(0.9, 1.1)).to_bytes(8, "little")
            payload[10:12] = random.integers(1100, dtype="<u2").tobytes()  # first_sensor
            payload[252:] = bytes((random.integers(40), 0))  # sensor_count, array_id
            service.take(info(sensor_count=0).raw, 10_000 * k)
            service.take(
                encode(IDS[name], bytes(payload), 0, 1, random.integers(senders)), 10_000 * k
            )
            if k % 1000 == 999:
                sizes.append(service.size())
        assert service.assembler.counts["epochs"] > 50
        assert max(sizes) < 500_000

    def test_a_frame_that_others_cut_short_or_extended_is_read(self):
        whole = array(5, [(1, 2, 3)]).payload
        service = Service()
        service.take(info().raw, 0)
        for payload in (whole, whole + b"\0"):
            service.take(encode(IDS["GYRO_ARRAY"], payload, 0, *ARRAY), 0)
        assert service.assembler.counts["duplicate"] == 1


def test_ids_of_this_file_are_what_the_service_reads():
    names = [*READ[:14], "HEARTBEAT"]
    assert {IDS[name] for name in names} == set(Service().ingest._readers)


def test_the_autopilot_is_the_sender_by_default():
    assert (frame("RAW_IMU").system, frame("RAW_IMU").component) == AUTOPILOT
