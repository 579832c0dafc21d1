"""What the page knows: frames that pymavlink made, into the model; and what it asks, out of it."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from network import NEAR, OWN, Network, public
from wire import SERVICE, frame

from risaf_link.mavlink.commands import Command
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.frame import FrameParser, encode
from risaf_link.mavlink.notices import Notice, Severity, statustexts
from risaf_link.monitor.asking import AGAIN_US, GONE_US, SYSTEM, TIMESYNC_US, WANTED, Asking
from risaf_link.monitor.estimator import HISTORY_S, STEP_S
from risaf_link.monitor.traffic import Account
from risaf_link.monitor.vehicles import COMPONENT, MOST_EVENTS, Vehicles

NOW_US = 1_800_000_000_000_000
STATUS = {
    "heading": 1.0,
    "heading_std": 0.02,
    "innovation": -0.03,
    "innovation_std": 0.025,
    "test_ratio": 0.4,
    "yaw": 1.03,
    "yaw_std": 0.004,
    "speed": 9.0,
    "time_since_fused": 0.2,
    "fused_count": 7,
    "rejected_count": 1,
    "source": 1,
    "state": 3,
}
LEVEL = {"q1": math.cos(0.5), "q4": math.sin(0.5)}


def taken(vehicles: Vehicles, *raws: bytes, time_us: int = NOW_US, peer: str = "") -> Vehicles:
    """Let frames arrive at one time."""
    table = FrameParser().receive_table(b"".join(raws))
    vehicles.take(table, np.full(len(table), time_us, np.uint64), peer)
    return vehicles


def told(
    vehicles: Vehicles, kind: str, /, sender=SERVICE, time_us: int = NOW_US, **fields: object
) -> None:
    taken(vehicles, frame(kind, sender, **fields).raw, time_us=time_us)


def test_a_component_is_found_by_what_nobody_else_sends():
    vehicles = Vehicles()
    told(vehicles, "ATTITUDE_QUATERNION", sender=(1, 1), **LEVEL)
    told(vehicles, "HEARTBEAT", type=18, autopilot=8, system_status=4)
    assert not vehicles.estimators
    told(vehicles, "GPS_HEADING_STATUS", **STATUS)
    told(vehicles, "ARRAY_STATUS", sender=(2, 191), sensors_expected=3)
    assert set(vehicles.estimators) == {SERVICE, (2, 191)}
    assert vehicles.pulses[SERVICE].status == 4


def test_it_knows_what_was_told_last():
    vehicles = Vehicles()
    told(vehicles, "GPS_HEADING_STATUS", **STATUS)
    told(vehicles, "ATTITUDE_QUATERNION", **LEVEL, yawspeed=0.25)
    covariance = np.diag(np.square([0.01, 0.02, 0.03])).ravel()
    told(vehicles, "ATTITUDE_QUATERNION_COV", covariance=covariance)
    told(vehicles, "ARRAY_STATUS", rate=[0.1, 0.2, 0.3], healthy=2, dead=1, sensors_expected=3)
    told(vehicles, "NAMED_VALUE_FLOAT", name=b"bias_z", value=0.001)
    told(vehicles, "NAMED_VALUE_FLOAT", name=b"bias_std_x", value=0.002)
    known = vehicles.estimators[SERVICE]
    assert known.heading.yaw == pytest.approx(1.03)
    assert known.heading.gate == pytest.approx(0.075)  # 3 standard deviations
    assert (known.attitude.roll, known.attitude.yaw) == pytest.approx((0.0, 1.0))
    assert known.attitude.rate == pytest.approx((0, 0, 0.25))
    assert known.deviations.roll == pytest.approx(0.01)
    assert known.deviations.yaw == pytest.approx(0.03)
    assert known.array.rate == pytest.approx((0.1, 0.2, 0.3))
    assert (known.array.healthy, known.array.dead) == (2, 1)
    assert known.bias[2] == pytest.approx(0.001)
    assert math.isnan(known.bias[0])
    assert known.bias_std[0] == pytest.approx(0.002)


def test_sensors_are_put_together_from_their_parts():
    vehicles = Vehicles()
    told(vehicles, "ARRAY_STATUS", sensors_expected=35)
    biases = list(range(90))
    health = {"relative_bias": biases, "rejected_percent": [5] * 30, "state": [0] * 29 + [2]}
    told(vehicles, "ARRAY_SENSOR_HEALTH", first_sensor=0, sensor_count=30, **health)
    known = vehicles.estimators[SERVICE].sensors
    assert known.state == [0] * 29 + [2] + [None] * 5
    assert known.bias[1] == (3, 4, 5)
    told(vehicles, "ARRAY_SENSOR_HEALTH", first_sensor=30, sensor_count=5, **health)
    told(vehicles, "ARRAY_SENSOR_REASON", sensor_count=35, reason=[0] * 29 + [5] + [0] * 90)
    assert known.state == [0] * 29 + [2] + [0] * 5
    assert known.reason[28:31] == [0, 5, 0]
    assert known.bias[31] == (3, 4, 5)
    told(vehicles, "ARRAY_STATUS", sensors_expected=10)
    assert len(known.bias) == len(known.reason) == 10


def test_more_sensors_than_anybody_has_are_not_believed():
    vehicles = Vehicles()
    told(vehicles, "ARRAY_SENSOR_HEALTH", first_sensor=65_000, sensor_count=255)
    told(vehicles, "ARRAY_STATUS", sensors_expected=65_000)
    assert not vehicles.estimators[SERVICE].sensors.state


def test_a_gps_heading_is_remembered_once():
    vehicles = Vehicles()
    told(vehicles, "ATTITUDE_QUATERNION", time_us=NOW_US, **LEVEL)
    for i in range(30):  # a new heading in every third message
        status = {**STATUS, "fused_count": i // 3}
        told(vehicles, "GPS_HEADING_STATUS", time_us=NOW_US + i * 200_000, **status)
        told(vehicles, "ATTITUDE_QUATERNION", time_us=NOW_US + i * 200_000 + 1, **LEVEL)
    rows = vehicles.estimators[SERVICE].rows
    shown = [row.gps for row in rows if not math.isnan(row.gps)]
    assert len(rows) == 29
    assert len(shown) == 9
    assert all(row.yaw == pytest.approx(1.03) for row in rows)


def test_the_past_is_bounded():
    vehicles = Vehicles()
    told(vehicles, "GPS_HEADING_STATUS", **STATUS)
    for i in range(4000):
        told(vehicles, "ATTITUDE_QUATERNION", time_us=NOW_US + i * 200_000, **LEVEL)
    known = vehicles.estimators[SERVICE]
    assert len(known.rows) == round(HISTORY_S / STEP_S)
    assert known.row_count == 3999
    for system in range(1, 200):
        told(vehicles, "GPS_HEADING_STATUS", sender=(system, 1), **STATUS)
        told(vehicles, "HEARTBEAT", sender=(system, 1), type=18)
        told(vehicles, "STATUSTEXT", sender=(system, 1), text=b"?" * 50, id=9)
        told(vehicles, "STATUSTEXT", sender=(system, 1), text=b"here")
        told(vehicles, "STATUSTEXT", sender=(system, 1), text=b"there")
    assert len(vehicles.estimators) < 20
    assert len(vehicles.pulses) < 200
    assert len(vehicles.traffic.accounts) < 100
    assert len(vehicles.events) == MOST_EVENTS


@given(st.text(st.characters(min_codepoint=32, max_codepoint=126), min_size=1, max_size=160))
def test_what_comes_in_parts_is_one_event(text):
    vehicles = Vehicles()
    for fields in statustexts(Notice(Severity.WARNING, text), number=4):
        fields["text"] = fields["text"].ljust(50, b"\0")
        told(vehicles, "STATUSTEXT", **fields)
    (event,) = vehicles.events
    assert (event.severity, event.text, event.system) == (4, text, 1)


def test_a_part_that_is_lost_or_comes_twice_spoils_no_other_text():
    def heard(*parts: int) -> list[str]:
        for part in parts:
            told(
                vehicles,
                "STATUSTEXT",
                text=b"%d" % part * (50 if part < 2 else 9),
                id=4,
                chunk_seq=part,
            )
        return [event.text for event in vehicles.events]

    vehicles, whole = Vehicles(), "0" * 50 + "1" * 50 + "2" * 9
    assert heard(0, 2, 1, 1, 2) == []
    assert heard(0, 1, 2) == [whole]
    assert heard(0, 0, 1, 1, 2) == [whole, whole]


@given(st.lists(st.sampled_from(["next", "lost", "late"]), max_size=80), st.integers(1, 7))
def test_losses_are_what_did_not_come(steps, cut):
    sent, came, held = 250, [250 % 256], None
    missing = 0
    for step in steps:
        sent += 1
        if step == "lost":
            missing += 1
        elif step == "late" and held is None:
            held = sent
        else:
            came.append(sent % 256)
            if held is not None:
                came.append(held % 256)
                held = None
    came.append((sent + 1) % 256)
    missing += held is not None
    account = Account(("", 1, 1))
    for i in range(0, len(came), cut):
        some = np.array(came[i : i + cut], np.uint8)
        account.note(np.full(len(some), NOW_US, np.uint64), some, np.full(len(some), 20))
    loss = account.loss(NOW_US + 1_000_000)
    assert loss == pytest.approx(missing / (missing + len(came)))


def test_a_restart_is_no_loss():
    account = Account(("", 1, 1))
    numbers = np.array([*range(100), *range(100)], np.uint8)
    account.note(np.full(200, NOW_US, np.uint64), numbers, np.full(200, 20))
    assert account.loss(NOW_US + 1_000_000) == 0


def test_rates_are_those_of_the_last_seconds():
    vehicles = Vehicles()
    for i in range(100):
        raw = encode(IDS["HEARTBEAT"], bytes(9), i, 1, 1)
        taken(vehicles, raw, time_us=NOW_US + i * 100_000, peer="a")
    (account,) = vehicles.traffic.accounts.values()
    frames, size = account.rates(NOW_US + 10_000_000)
    assert frames == pytest.approx(10)
    assert size == pytest.approx(10 * len(raw))
    assert account.rates(NOW_US + 60_000_000) == (0, 0)
    assert account.loss(NOW_US + 10_000_000) == 0
    assert account.loss(NOW_US + 300_000_000) is None


class Talk:
    """The page's questions, read by pymavlink."""

    def __init__(self) -> None:
        self.vehicles = Vehicles()
        self.asking = Asking()
        self.now_us = NOW_US
        self.decoder = public.MAVLink(None)

    def wait(self, seconds: float, then=lambda _: None) -> list:
        asked = []
        for _ in range(round(seconds * 10)):
            self.now_us += 100_000
            for raw in self.asking.advance(self.vehicles, self.now_us):
                asked += self.decoder.parse_buffer(raw)
                then(raw)
        return asked


def intervals(messages: list) -> dict[str, float]:
    """What was asked for, Hz."""
    names = {number: name for name, number in IDS.items()}
    commands = [m for m in messages if m.get_type() == "COMMAND_LONG"]
    assert {m.command for m in commands} <= {Command.SET_MESSAGE_INTERVAL}
    return {names[int(m.param1)]: 1e6 / m.param2 for m in commands}


def test_it_asks_who_may_be_one_and_then_for_all_that_it_shows():
    talk = Talk()
    assert not intervals(talk.wait(5))
    told(talk.vehicles, "HEARTBEAT", sender=(1, 1), time_us=talk.now_us, type=10, autopilot=3)
    told(talk.vehicles, "HEARTBEAT", time_us=talk.now_us, type=18, autopilot=8)
    asked = talk.wait(4)
    assert intervals(asked) == {"GPS_HEADING_STATUS": 5.0}
    commands = [m for m in asked if m.get_type() == "COMMAND_LONG"]
    assert {(m.target_system, m.target_component) for m in commands} == {SERVICE}
    told(talk.vehicles, "GPS_HEADING_STATUS", time_us=talk.now_us, **STATUS)
    assert intervals(talk.wait(4)).keys() == WANTED.keys() - {"GPS_HEADING_STATUS"}
    assert not intervals(talk.wait(20))  # and it is gone


def test_it_asks_again_in_case_the_service_was_started_anew():
    talk = Talk()
    times = []
    for _ in range(round(2.5 * AGAIN_US / GONE_US * 2)):
        told(talk.vehicles, "GPS_HEADING_STATUS", time_us=talk.now_us, **STATUS)
        times += [
            talk.now_us for name in intervals(talk.wait(GONE_US / 2e6)) if name == "ARRAY_STATUS"
        ]
    assert len(times) == 3


def test_nothing_else_is_ever_sent():
    talk = Talk()
    told(talk.vehicles, "HEARTBEAT", time_us=NOW_US + 2_000_000, type=18, autopilot=8)
    told(talk.vehicles, "GPS_HEADING_STATUS", time_us=NOW_US + 2_000_000, **STATUS)
    asked = talk.wait(10)
    assert {m.get_type() for m in asked} == {"TIMESYNC", "COMMAND_LONG"}
    assert {m.get_srcSystem() for m in asked} == {SYSTEM}
    assert sum(m.get_type() == "TIMESYNC" for m in asked) == 10_000_000 / TIMESYNC_US
    assert [m.get_seq() for m in asked] == list(range(len(asked)))


def test_a_component_does_what_is_asked_and_tells_the_time():
    network, talk = Network(), Talk()
    told(talk.vehicles, "GPS_HEADING_STATUS", time_us=NOW_US, **STATUS)
    results = []

    def answer(raw: bytes) -> None:
        network.now_us = NOW_US
        (question,) = FrameParser().receive_data(raw)
        for message in network.take(question):
            if message.get_type() == "COMMAND_ACK":
                results.append(message.result)
            late = talk.now_us + 30_000
            taken(talk.vehicles, bytes(message.get_msgbuf()), time_us=late, peer=NEAR[1])

    talk.wait(4, answer)
    assert results == [0] * len(WANTED)
    account = talk.vehicles.traffic.accounts[NEAR[1], *OWN]
    assert account.sender.trip_us == 30_000


def test_anything_of_any_content_is_taken():
    random = np.random.default_rng(3)
    vehicles = Vehicles()
    for name in (*WANTED, "STATUSTEXT", "HEARTBEAT", "TIMESYNC"):
        for size in random.integers(0, 256, 40):
            raw = encode(IDS[name], random.bytes(int(size)) or b"\0", 0, 1, COMPONENT)
            taken(vehicles, raw)
    assert vehicles.estimators
