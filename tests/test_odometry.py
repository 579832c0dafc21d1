"""Our heading as PX4 and ArduPilot take it: each message by the rules of who receives it.

The rules are in `autopilots`; pymavlink reads the messages.
"""

import io
import math
import re
from copy import copy

import numpy as np
import pytest
from autopilots import ArduPilot, Px4, yaw_of
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from network import NEAR, OWN, Network, acks, of, public, texts
from streams import ROOT, recording
from vehicle import Vehicle
from wire import frame

from risaf_link.config import Config, identity_of, load
from risaf_link.errors import ConfigError
from risaf_link.kept import load_in_force
from risaf_link.mavlink.odometry import PROFILES, quality_of
from risaf_link.mavlink.peers import Terms
from risaf_link.mavlink.telemetry import DEFAULT_RATES, Emitter
from risaf_link.mavlink.tlog import TlogReader
from risaf_link.pipeline import Pipeline
from risaf_link.replay import OutputLog, Replay, Selection

ODOMETRY = 331
ACCEPTED, REJECTED, DENIED = 0, 1, 2
REBOOT, SET, REQUEST = 246, 511, 512
GENERIC, ARDUPILOT, PX4 = 0, 3, 12  # MAV_AUTOPILOT
PEER = ("autopilot", "")
BOOT_US = 40_000_000  # of the array's clock, on which the autopilot's is
PERIOD_US = 10_000


class Feed(Network):
    """A vehicle, the service, and what its autopilot hears: messages with their times, us."""

    def __init__(self, autopilot=None, rate=30.0, config=None) -> None:
        config = config or Config()
        self.pipeline = Pipeline(config, OWN)
        terms = {"autopilot": Terms(rates={"ODOMETRY": rate})}
        super().__init__(config, estimator=self.pipeline, links=terms)
        self.peers = [PEER]
        self.vehicle = Vehicle(5)
        self.time_us = BOOT_US
        self.pipeline.step(self.vehicle.info(), self.time_us)
        self.told = []
        if autopilot is not None:
            self.beat(autopilot)

    def beat(self, autopilot, system=1):
        beat = frame("HEARTBEAT", (system, 1), type=10, autopilot=autopilot)
        self.pipeline.step(beat, self.time_us)
        self.take(beat, PEER)

    def go(self, seconds, course=None, rate=0.0):
        """Drive on; with a course there is a fix five times a second. What was heard in it."""
        heard = []
        for _ in range(round(seconds * 1e6) // PERIOD_US):
            self.time_us += PERIOD_US
            if course is not None and self.time_us % 200_000 == 0:
                self.pipeline.step(self.vehicle.fix(self.time_us, course), self.time_us)
            epoch = self.vehicle.epoch(self.time_us, (0.0, 0.0, rate))
            (self.last,) = self.pipeline.step(epoch, self.time_us)
            heard += of(self.estimate(self.last).get(PEER, []), "ODOMETRY")
        self.told += heard
        return heard


def received_by(autopilot, messages):
    """Let an autopilot hear messages, each when it was sent."""
    for message in messages:
        times = {"now_ms": message.time_usec // 1000} if isinstance(autopilot, ArduPilot) else {}
        autopilot.hear(message, **times)
    return autopilot


def received(feed):
    """What is heard in the first seconds of a drive."""
    return feed.go(2, course=1.0)


def at_once(estimate, name="px4"):
    """The message that an autopilot hears of one estimate."""
    raw = Emitter({}, *OWN, profile=PROFILES[name]).tell("ODOMETRY", estimate)
    (message,) = public.MAVLink(None).parse_buffer(raw)
    return message


def aligned_estimate():
    feed = Feed(PX4)
    feed.go(1, course=1.0)
    return feed.last


ESTIMATE = aligned_estimate()


def with_attitude(later_us=0, **changes):
    """The estimate with another attitude, and some time later."""
    estimate = copy(ESTIMATE)
    attitude = replace(ESTIMATE.attitude, **changes)
    vars(estimate).update(boot_us=ESTIMATE.boot_us + later_us, attitude=attitude)
    return estimate


class TestWhatIsSent:
    def test_nothing_by_default(self):
        assert "ODOMETRY" not in DEFAULT_RATES

    def test_nothing_until_an_autopilot_is_known(self):
        feed = Feed()
        assert not feed.go(2, course=1.0)
        feed.beat(GENERIC)
        assert not feed.go(1, course=1.0)
        feed.beat(PX4)
        assert feed.go(1, course=1.0)

    def test_the_operator_is_told_once_that_no_autopilot_is_known(self):
        feed = Feed()
        feed.go(2, course=1.0)
        wrong = (
            "ODOMETRY: not sent: neither PX4 nor ArduPilot is heard, and mavlink.odometry is auto"
        )
        assert wrong not in texts(feed.wait(9)[PEER])
        assert texts(feed.wait(60)[PEER]) == [wrong]
        feed.beat(PX4)
        assert texts(feed.wait(60)[PEER]) == ["ODOMETRY: in order again"]

    def test_nothing_is_told_where_nobody_wants_it_or_an_autopilot_is_heard_in_time(self):
        unwanted = Network()
        assert not texts(unwanted.wait(60)[NEAR])
        feed = Feed()
        feed.wait(9)
        feed.beat(ARDUPILOT)
        assert not texts(feed.wait(60)[PEER])

    def test_another_vehicles_autopilot_changes_nothing(self):
        feed = Feed(PX4)
        feed.beat(ARDUPILOT, system=2)
        assert {m.frame_id for m in feed.go(2, course=1.0)} == {1}

    @pytest.mark.parametrize(("name", "frame_id"), [("px4", 1), ("ardupilot", 20)])
    def test_what_is_configured_needs_no_autopilot_and_stays(self, name, frame_id):
        identity = identity_of(load(None, [f"mavlink.odometry={name}"]))
        assert identity.profile.frame == frame_id
        for autopilot in (PX4, ARDUPILOT):
            identity.hear(frame("HEARTBEAT", type=10, autopilot=autopilot), 0)
        assert identity.profile.frame == frame_id

    def test_nothing_before_the_heading_is_set(self):
        feed = Feed(PX4)
        assert not feed.go(3)
        assert acks(feed.command(REQUEST, ODOMETRY, peer=PEER)) == [(REQUEST, REJECTED)]
        assert feed.go(1, course=1.0)
        told, ack = feed.command(REQUEST, ODOMETRY, peer=PEER)
        assert (told.get_type(), ack.result) == ("ODOMETRY", ACCEPTED)

    def test_it_can_be_asked_for_and_ended(self):
        feed = Feed(PX4)
        feed.go(2, course=1.0)
        feed.command(SET, ODOMETRY, 1e6 / 50, peer=PEER)
        assert len(feed.go(1)) in {50, 51}
        feed.command(SET, ODOMETRY, -1, peer=PEER)
        assert not feed.go(1)

    def test_position_and_velocity_are_not_claimed(self):
        for message in received(Feed(PX4)) + received(Feed(ARDUPILOT)):
            assert [message.pose_covariance[i] for i in (0, 6, 11)] == [pytest.approx(1e12)] * 3
            assert np.isnan([message.vx, message.vy, message.vz]).all()
            assert math.isnan(message.velocity_covariance[0])


class TestPx4:
    @pytest.fixture
    def feed(self):
        return Feed(PX4)

    def test_every_message_is_used_from_the_second_on(self, feed):
        feed.go(5, course=1.0)
        pilot = received_by(Px4(), feed.told)
        assert (pilot.refused, pilot.events) == ([], ["started"])
        assert len(pilot.fused) == len(feed.told) - 1
        _, yaw, variance = pilot.fused[-1]
        assert yaw == pytest.approx(feed.last.attitude.euler[2], abs=1e-6)
        assert variance == 0.1  # its floor, rad^2: we know better

    def test_it_aligns_a_vehicle_without_a_compass(self, feed):
        pilot = received_by(Px4(yaw_aligned=False), received(feed))
        assert pilot.events == ["started with a reset"]

    def test_attitude_rates_and_time_are_the_estimates(self, feed):
        feed.go(5, course=1.0)
        message = feed.go(0.2, rate=0.3)[-1]
        assert message.time_usec // PERIOD_US <= feed.last.boot_us // PERIOD_US
        assert feed.last.boot_us - message.time_usec < 40_000
        assert message.q == pytest.approx(feed.last.attitude.q_nb, abs=0.02)
        assert message.yawspeed == pytest.approx(0.3, abs=1e-3)

    def test_the_covariance_is_that_of_the_attitude(self):
        message = at_once(ESTIMATE)
        whole = np.zeros((6, 6))
        whole[np.triu_indices(6)] = message.pose_covariance
        attitude = ESTIMATE.attitude
        std = (attitude.roll_std, attitude.pitch_std, attitude.yaw_std)
        assert np.sqrt(whole.diagonal()[3:]) == pytest.approx(std, rel=1e-6)
        assert [*whole[3, 4:], whole[4, 5]] == pytest.approx(attitude.common, rel=1e-5)
        assert not whole[:3, 3:].any()

    def test_its_stamps_are_on_the_clock_that_answers_to_timesync_show(self, feed):
        boot_ms = feed.time_us // 1000 + 500_000  # the array counts a time of its own
        feed.pipeline.step(frame("SYSTEM_TIME", time_boot_ms=boot_ms), feed.time_us)
        (*_, message) = feed.go(3, course=1.0)
        feed.now_us = feed.time_us
        (answer,) = feed.take(frame("TIMESYNC", ts1=1), PEER)
        behind_us = answer.tc1 // 1000 - message.time_usec
        assert 0 <= behind_us < 40_000  # since that message was sent
        assert message.time_usec // 1000 - boot_ms in range(2960, 3001)

    def test_in_an_outage_it_goes_on_with_a_variance_that_grows(self, feed):
        feed.go(20, course=1.0)
        out = feed.go(60, rate=0.02)
        pilot = received_by(Px4(), feed.told)
        assert (pilot.refused, pilot.events) == ([], ["started"])
        variances = [m.pose_covariance[20] for m in out]
        assert all(np.diff(variances[::300]) > 0)  # from ten seconds to ten seconds
        assert variances[-1] > 2 * variances[0]
        assert variances[-1] == pytest.approx(feed.last.attitude.yaw_std**2, rel=1e-3)
        qualities = [m.quality for m in out]
        assert qualities == sorted(qualities, reverse=True)

    def test_a_heading_worse_than_the_floor_is_told_to_be_so(self):
        pilot = Px4()
        for k in range(2):
            received_by(pilot, [at_once(with_attitude(k * 33_000, yaw_std=0.5))])
        assert pilot.fused[-1][2] == pytest.approx(0.25)

    def test_where_yaw_is_set_anew_the_counter_steps_with_it_and_no_sooner(self, feed):
        feed.go(12, course=1.0)
        feed.go(25, course=2.5)
        yaws = np.array([yaw_of(m.q) for m in feed.told])
        (jump,) = np.flatnonzero(np.abs(np.diff(yaws)) > 0.5)
        counters = [m.reset_counter for m in feed.told]
        assert counters == [1] * (jump + 1) + [2] * (len(counters) - jump - 1)
        assert received_by(Px4(), feed.told).events == ["started", "reset"]

    def test_after_a_restart_it_is_silent_until_aligned_and_then_the_counter_is_another(self, feed):
        before = feed.go(5, course=1.0)
        assert acks(feed.command(REBOOT, 1, peer=PEER)) == [(REBOOT, ACCEPTED)]
        assert not feed.go(1)
        after = feed.go(1, course=1.5)
        assert (before[-1].reset_counter, after[0].reset_counter) == (1, 2)
        pilot = received_by(Px4(), feed.told)
        assert pilot.events == ["started", "stopped", "started"]
        assert pilot.fused[-1][1] == pytest.approx(1.5, abs=1e-3)

    def test_a_rate_without_a_sensor_behind_it_has_failed(self, feed):
        feed.go(5, course=1.0)
        feed.go(0.2, rate=math.nan)
        feed.go(1)
        pilot = received_by(Px4(ev_qmin=1), feed.told)
        assert set(pilot.refused) == {"quality"}
        assert len(pilot.refused) == 6  # 0.2 s of 30 Hz

    @pytest.mark.parametrize(("rate", "is_used"), [(4.0, False), (10.0, True), (50.0, True)])
    def test_it_starts_only_at_more_than_five_a_second(self, rate, is_used):
        assert bool(received_by(Px4(), received(Feed(PX4, rate))).fused) is is_used

    def test_the_other_profile_is_refused(self):
        messages = received(Feed(ARDUPILOT))
        assert set(received_by(Px4(), messages).refused) == {"estimator_type"}


class TestArduPilot:
    @pytest.fixture
    def feed(self):
        return Feed(ARDUPILOT)

    def test_every_message_is_used_and_no_velocity_is(self, feed):
        feed.go(5, course=1.0)
        pilot = received_by(ArduPilot(), feed.told)
        assert (pilot.refused, pilot.velocities) == ([], 0)
        assert len(pilot.used) == len(feed.told)
        _, yaw, sigma = pilot.used[-1]
        assert yaw == pytest.approx(feed.last.attitude.euler[2], abs=1e-6)
        assert sigma == 0.2  # its floor
        assert pilot.position_errors == {100.0}  # the most that it believes

    def test_it_is_healthy_from_alignment_through_an_outage(self, feed):
        pilot, healthy = ArduPilot(), []
        for seconds, course in [(3, None), (5, 1.0), (20, None)]:
            for _ in range(seconds * 10):
                received_by(pilot, feed.go(0.1, course))
                healthy.append(pilot.is_healthy(feed.time_us // 1000))
        assert healthy == [False] * (healthy.index(True)) + [True] * healthy.count(True)
        assert 30 <= healthy.index(True) <= 33

    def test_a_heading_worse_than_the_floor_is_told_to_be_so(self):
        message = at_once(with_attitude(yaw_std=0.8), "ardupilot")
        ((_, _, sigma),) = received_by(ArduPilot(), [message]).used
        assert sigma == pytest.approx(0.8 ** (4 / 3), rel=1e-3)  # by its cube root of squares

    def test_a_rate_without_a_sensor_behind_it_is_ignored(self, feed):
        feed.go(5, course=1.0)
        feed.go(0.2, rate=math.nan)
        pilot = received_by(ArduPilot(), feed.told)
        assert set(pilot.refused) == {"quality"}
        assert pilot.is_healthy(feed.time_us // 1000)  # messages come

    def test_a_reset_is_counted(self, feed):
        feed.go(12, course=1.0)
        feed.go(25, course=2.5)
        assert received_by(ArduPilot(), feed.told).resets == 2

    @pytest.mark.parametrize(("rate", "is_healthy"), [(2.0, False), (4.0, True), (30.0, True)])
    def test_it_takes_four_a_second(self, rate, is_healthy):
        feed, pilot = Feed(ARDUPILOT, rate), ArduPilot()
        received_by(pilot, feed.go(2, course=1.0))
        healthy = []
        for _ in range(100):
            received_by(pilot, feed.go(0.01))
            healthy.append(pilot.is_healthy(feed.time_us // 1000))
        assert all(healthy) is is_healthy

    def test_the_other_profile_is_dropped(self):
        pilot = received_by(ArduPilot(), received(Feed(PX4)))
        assert set(pilot.refused) == {"frame"}
        assert not pilot.is_healthy(0)


@given(
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
    st.floats(0.9999, 1.0001),
)
def test_no_rounding_takes_the_quaternion_out_of_px4s_tolerance(q, norm):
    message = at_once(with_attitude(q_nb=np.array(q) / np.linalg.norm(q) * norm))
    assert not received_by(Px4(), [message]).refused


@given(st.floats(0, math.pi), st.floats(0, math.pi))
def test_quality_is_a_percentage_that_falls_with_the_deviation(one, other):
    low, high = sorted((one, other))
    assert 1 <= quality_of(high) <= quality_of(low) <= 100
    assert [quality_of(math.radians(d)) for d in (0, 1, 10, 20, 180)] == [100, 95, 50, 1, 1]


def test_the_counter_is_a_byte():
    assert at_once(with_attitude(resets=257)).reset_counter == 1


class TestConfiguration:
    @pytest.mark.parametrize(("page", "rate"), [("px4.md", 30), ("ardupilot.md", 20)])
    def test_that_of_the_page_feeds_the_autopilot_alone(self, page, rate, tmp_path):
        (text,) = re.findall(r"```yaml\n(.*?)```", (ROOT / "docs" / page).read_text(), re.DOTALL)
        path = tmp_path / "vehicle.yaml"
        path.write_text(text)
        config = load(path)
        fed = {link.name: link.emit.get("ODOMETRY") for link in config.links if link.emit}
        assert fed == {"autopilot": rate}
        assert "ODOMETRY" not in config.emit

    def test_a_profile_that_is_none_is_refused(self):
        with pytest.raises(ConfigError, match=r"mavlink\.odometry: found 'apm', expected one of"):
            load(None, ["mavlink.odometry=apm"])

    @pytest.mark.parametrize("key", ["emit.ODOMETRY=30", "links.0.emit={ODOMETRY: 30}"])
    def test_the_autopilot_must_not_hear_itself(self, key):
        load(None, [key])
        with pytest.raises(ConfigError, match=r"gps\.messages: found GLOBAL_POSITION_INT"):
            load(None, [key, "gps.messages=[GPS_RAW_INT, GLOBAL_POSITION_INT]"])

    def test_nor_when_a_ground_station_asks_for_it(self, tmp_path):
        config = load(None, ["gps.messages=[GPS_RAW_INT, GLOBAL_POSITION_INT]"])
        feed = Feed(public.MAV_AUTOPILOT_PX4, config=config)
        assert not feed.go(2.0, course=1.0)
        assert acks(feed.command(SET, ODOMETRY, 1e6 / 50, peer=PEER)) == [(SET, DENIED)]
        assert acks(feed.command(REQUEST, ODOMETRY, peer=PEER)) == [(REQUEST, DENIED)]
        error, value = feed.set("RATE_ODOMETRY", 30.0, peer=PEER)
        assert (error.get_type(), value.param_value) == ("PARAM_ERROR", 0.0)
        assert not feed.go(1.0, course=1.0)
        path = tmp_path / "vehicle.yaml"
        path.write_text("gps: {messages: [GLOBAL_POSITION_INT]}\n")
        (tmp_path / "vehicle.parameters.yaml").write_text("RATE_ODOMETRY: 30\nFUS_GATE: 5\n")
        in_force = load_in_force(path)
        assert ("ODOMETRY" in in_force.emit, in_force.fusion.gate) == (False, 5.0)


def test_a_replay_of_ardupilots_log_tells_what_ardupilot_would_use():
    config = load(None, ["emit={ODOMETRY: 20}"])
    replay = Replay(config, recording("rover_sitl_fixture.tlog"), Selection())
    file = io.BytesIO()
    output = OutputLog(config, file, replay.identity)
    for block in replay.blocks(singly=True):
        output.write(block)
    decoder = public.MAVLink(None)
    logged = [decoder.parse_buffer(each.frame.raw)[0] for each in TlogReader([file.getvalue()])]
    messages = of(logged, "ODOMETRY")
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in messages} == {OWN}
    pilot = received_by(ArduPilot(), messages)
    assert not pilot.refused
    arrivals = np.array([now_ms for now_ms, *_ in pilot.used])
    assert np.diff(arrivals).max() <= 70  # the samples of this log come at 50 Hz
    seconds = (arrivals[-1] - arrivals[0]) / 1e3
    assert len(arrivals) == pytest.approx(20 * seconds, abs=2)
