"""The autopilot is asked for what the estimator lives on, as long as it is not there."""

from collections import Counter

import pytest
from network import FAR, NEAR, OWN, Network, of
from pymavlink.dialects.v20 import all as public
from wire import AUTOPILOT, debug_array, frame, imu, info

from risaf_link.mavlink.frame import FrameParser
from risaf_link.mavlink.requests import Requests

ACCEPTED, REJECTED, DENIED, UNSUPPORTED, FAILED = range(5)
ALL = {"HIGHRES_IMU", "SCALED_IMU2", "SCALED_IMU3", "GPS_RAW_INT", "SYSTEM_TIME"}
VEHICLE = ("vehicle", "")


class Autopilot:
    """An autopilot that sends what it was asked for, up to what it can, and a HEARTBEAT."""

    def __init__(self, can: dict[str, float], cap: float = 1000.0, answers: bool = True) -> None:
        self.rates: dict[str, float] = {}
        self.can, self.cap, self.answers = can, cap, answers
        self.denies_above = 1e9
        self.asked: list[tuple[str, float]] = []
        self.speaks = True
        self._owed: Counter[str] = Counter()
        self._beat = 0.0

    def obey(self, order) -> list:
        name = public.mavlink_map[int(order.param1)].msgname
        rate = 1e6 / order.param2
        assert (order.target_system, order.target_component) == AUTOPILOT
        assert (order.command, order.param3, order.param7) == (511, 0, 0)
        self.asked.append((name, round(rate, 2)))
        result = ACCEPTED
        if name not in self.can:
            result = FAILED
        elif rate > self.denies_above:
            result = DENIED
        else:
            self.rates[name] = min(rate, self.cap, self.can[name])
        ack = {"command": 511, "result": result}
        to = {"target_system": OWN[0], "target_component": OWN[1]}
        return [frame("COMMAND_ACK", AUTOPILOT, **ack, **to)] if self.answers else []

    def frames(self, seconds: float) -> list:
        self._beat += seconds
        sent = []
        if self._beat >= 1.0:
            self._beat -= 1.0
            sent.append(frame("HEARTBEAT", AUTOPILOT, type=10, autopilot=3))
        for name, rate in self.rates.items():
            self._owed[name] += rate * seconds  # type: ignore[assignment]
            whole = int(self._owed[name])
            self._owed[name] -= whole
            sent += [frame(name, AUTOPILOT)] * whole
        return sent if self.speaks else []


class Vehicle:
    """A service whose links lead to an autopilot."""

    def __init__(self, autopilot: Autopilot, requests: Requests | None = None) -> None:
        self.net = Network(requests=requests or Requests({"vehicle": None, "ground": None}))
        self.net.peers = [VEHICLE, NEAR, FAR]
        self.autopilot = autopilot
        self.peers = [VEHICLE]  # where the autopilot is heard
        self.others: list = []  # frames that come each time
        self.asked_at: Counter = Counter()

    def wait(self, seconds: float) -> list[tuple[str, float]]:
        """Let time pass; what was asked for."""
        before = len(self.autopilot.asked)
        for _ in range(round(seconds * 10)):
            arriving = self.autopilot.frames(0.1) + self.others
            for peer in self.peers:
                table = FrameParser().receive_table(b"".join(each.raw for each in arriving))
                self.net.component.note_traffic(table, peer)
                for each in arriving:
                    self.net.component.receive(each, peer, self.net.now_us)
            for peer, messages in self.net.wait(0.1).items():
                for order in of(messages, "COMMAND_LONG"):
                    self.asked_at[peer] += 1
                    for answer in self.autopilot.obey(order):
                        self.net.component.receive(answer, peer, self.net.now_us)
        return self.autopilot.asked[before:]


EVERYTHING = dict.fromkeys(ALL, 1000.0)


@pytest.mark.parametrize("answers", [True, False])
def test_what_is_needed_is_asked_for_once_and_then_left_alone(answers):
    vehicle = Vehicle(Autopilot(EVERYTHING, answers=answers))
    assert dict(vehicle.wait(20)) == {
        **dict.fromkeys(("HIGHRES_IMU", "SCALED_IMU2", "SCALED_IMU3"), 100),
        "GPS_RAW_INT": 5,
        "SYSTEM_TIME": 1,
    }
    assert len(vehicle.autopilot.asked) == 5
    assert vehicle.wait(300) == []


def test_nothing_is_asked_for_that_comes_by_itself():
    autopilot = Autopilot(EVERYTHING)
    autopilot.rates = {
        name: {"GPS_RAW_INT": 5.0, "SYSTEM_TIME": 1.0}.get(name, 100) for name in ALL
    }
    assert Vehicle(autopilot).wait(60) == []


def test_nothing_is_asked_for_without_an_autopilot_or_of_another_vehicles():
    autopilot = Autopilot(EVERYTHING)
    autopilot.speaks = False
    vehicle = Vehicle(autopilot)
    vehicle.others = [
        frame("HEARTBEAT", (1, 1), type=6, autopilot=3),
        frame("HEARTBEAT", (1, 158), type=18, autopilot=8),
        frame("HEARTBEAT", (2, 1), type=10, autopilot=3),
    ]
    assert vehicle.wait(60) == []


@pytest.mark.parametrize("rate", [0.0, 2.0])
def test_what_another_program_slows_down_is_asked_for_again(rate):
    vehicle = Vehicle(Autopilot(EVERYTHING))
    vehicle.wait(90)
    vehicle.autopilot.rates["HIGHRES_IMU"] = rate
    assert vehicle.wait(12) == [("HIGHRES_IMU", 100)]
    assert vehicle.autopilot.rates["HIGHRES_IMU"] == 100


def test_a_quarrel_with_another_program_ends():
    vehicle = Vehicle(Autopilot(EVERYTHING))
    vehicle.wait(90)
    asked = 0
    for _ in range(200):
        vehicle.autopilot.rates["HIGHRES_IMU"] = 2.0
        asked += len(vehicle.wait(5))
    assert 5 <= asked <= 8


def test_the_autopilots_cap_is_taken_as_it_is():
    vehicle = Vehicle(Autopilot(EVERYTHING, cap=40.0))
    vehicle.wait(120)
    assert Counter(name for name, _ in vehicle.autopilot.asked) == {
        **dict.fromkeys(("HIGHRES_IMU", "SCALED_IMU2", "SCALED_IMU3"), 3),
        "GPS_RAW_INT": 1,
        "SYSTEM_TIME": 1,
    }
    assert vehicle.wait(600) == []
    vehicle.autopilot.rates["SCALED_IMU2"] = 10.0
    assert vehicle.wait(12) == [("SCALED_IMU2", 100)]


def test_less_is_asked_for_where_so_much_is_denied():
    autopilot = Autopilot(EVERYTHING)
    autopilot.denies_above = 40.0
    vehicle = Vehicle(autopilot)
    vehicle.wait(30)
    assert [rate for name, rate in autopilot.asked if name == "HIGHRES_IMU"] == [100, 50, 25]
    assert autopilot.rates["HIGHRES_IMU"] == 25
    assert vehicle.wait(600) == []


def test_another_message_of_the_same_sensor_is_asked_for_where_the_finest_is_not_known():
    vehicle = Vehicle(Autopilot({"RAW_IMU": 1000.0, "GPS_RAW_INT": 10.0, "SYSTEM_TIME": 1.0}))
    vehicle.wait(60)
    asked = [name for name, _ in vehicle.autopilot.asked]
    assert asked[:2] == ["HIGHRES_IMU", "RAW_IMU"]
    assert Counter(asked) == dict.fromkeys([*ALL, "RAW_IMU"], 1)


def test_what_is_accepted_and_never_comes_is_not_asked_for_for_ever():
    vehicle = Vehicle(Autopilot({**EVERYTHING, "SCALED_IMU3": 0.0}))
    vehicle.wait(900)
    times = Counter(name for name, _ in vehicle.autopilot.asked)
    assert times.pop("SCALED_IMU3") == 8
    assert set(times.values()) == {1}


def test_an_autopilot_that_comes_back_is_asked_again():
    vehicle = Vehicle(Autopilot(EVERYTHING))
    vehicle.wait(60)
    vehicle.autopilot.speaks = False
    vehicle.wait(10)
    vehicle.autopilot.rates.clear()
    vehicle.autopilot.speaks = True
    assert {name for name, _ in vehicle.wait(20)} == ALL


@pytest.mark.parametrize(
    "better",
    [info(), debug_array(1, b"gyro", [(0, 0, 0)])],
    ids=["GYRO_ARRAY", "DEBUG_FLOAT_ARRAY"],
)
def test_an_array_of_its_own_needs_no_imu(better):
    array = frame("GYRO_ARRAY", (1, 158)) if better.message_id == info().message_id else better
    encodings = ("GYRO_ARRAY", "DEBUG_FLOAT_ARRAY", "IMU")
    vehicle = Vehicle(Autopilot(EVERYTHING), Requests({"vehicle": None}, encodings))
    vehicle.others = [array]
    assert {name for name, _ in vehicle.wait(30)} == {"GPS_RAW_INT", "SYSTEM_TIME"}
    vehicle.others = []
    assert {name for name, _ in vehicle.wait(30)} == ALL - {"GPS_RAW_INT", "SYSTEM_TIME"}


def test_of_two_links_with_the_same_autopilot_the_first_is_asked():
    vehicle = Vehicle(Autopilot(EVERYTHING))
    vehicle.peers = [NEAR, VEHICLE]
    vehicle.wait(20)
    assert vehicle.asked_at == {VEHICLE: 5}
    vehicle.peers = [NEAR]
    vehicle.wait(6)  # then it is known to be gone
    vehicle.autopilot.rates.clear()
    vehicle.asked_at.clear()
    vehicle.wait(20)
    assert vehicle.asked_at == {NEAR: 5}


def brought(vehicle: Vehicle, rates: dict[str, float], peer, seconds: float) -> set[str]:
    """Let the autopilot speak on its own account by one way, besides; what it was asked for."""
    streams = Autopilot(EVERYTHING)
    streams.rates = dict(rates)
    asked = []
    for _ in range(round(10 * seconds)):
        raw = b"".join(each.raw for each in streams.frames(0.1))
        vehicle.net.component.note_traffic(FrameParser().receive_table(raw), peer)
        asked += vehicle.wait(0.1)
    return {name for name, _ in asked}


def test_what_comes_by_a_link_on_which_nothing_is_asked_for_is_not_asked_for_on_a_later_one():
    vehicle = Vehicle(Autopilot(EVERYTHING), Requests({"vehicle": {}, "ground": None}))
    vehicle.peers = [NEAR]
    all_but_time = {**dict.fromkeys(ALL, 100.0), "GPS_RAW_INT": 5.0}
    del all_but_time["SYSTEM_TIME"]
    assert brought(vehicle, all_but_time, VEHICLE, 30) == {"SYSTEM_TIME"}
    assert brought(vehicle, {}, VEHICLE, 30) == ALL - {"SYSTEM_TIME"}


def test_what_comes_by_a_later_link_is_asked_for_all_the_same():
    vehicle = Vehicle(Autopilot(EVERYTHING))
    assert "GPS_RAW_INT" in brought(vehicle, {"GPS_RAW_INT": 5.0}, NEAR, 30)


def test_what_comes_twice_too_slowly_is_too_slow():
    vehicle = Vehicle(Autopilot(EVERYTHING), Requests({"vehicle": {}, "ground": None}))
    vehicle.peers = [NEAR]
    vehicle.autopilot.rates["GPS_RAW_INT"] = 2.0
    assert "GPS_RAW_INT" in brought(vehicle, {"GPS_RAW_INT": 2.0}, VEHICLE, 30)


def test_a_link_may_ask_for_other_things_or_for_nothing():
    links = {"vehicle": {}, "ground": {"RAW_IMU": 50.0}}
    vehicle = Vehicle(Autopilot({"RAW_IMU": 1000.0}), Requests(links))  # type: ignore[arg-type]
    vehicle.peers = [VEHICLE, NEAR]
    assert vehicle.wait(30) == [("RAW_IMU", 50)]
    assert vehicle.asked_at == {NEAR: 1}


def test_a_slow_serial_line_is_not_filled_up():
    requests = Requests({"vehicle": None}, capacity={"vehicle": 5760.0})
    autopilot = Autopilot(EVERYTHING)
    Vehicle(autopilot, requests).wait(30)
    size = {
        name: 12 + kind.unpacker.size
        for kind in public.mavlink_map.values()
        for name in [kind.msgname]
    }
    assert sum(rate * size[name] for name, rate in autopilot.rates.items()) <= 0.55 * 5760
    assert autopilot.rates["SYSTEM_TIME"] == pytest.approx(1.0)


def test_no_more_than_one_request_waits_for_its_answer():
    autopilot = Autopilot(EVERYTHING, answers=False)
    vehicle = Vehicle(autopilot)
    most = max(len(vehicle.wait(0.9)) for _ in range(12))
    assert most == 1


def test_answers_to_others_and_other_commands_are_not_taken_for_ours():
    autopilot = Autopilot(EVERYTHING, answers=False)
    vehicle = Vehicle(autopilot)
    ack = {"command": 511, "result": FAILED, "target_system": 255, "target_component": 190}
    ours = {"command": 512, "result": FAILED, "target_system": 1, "target_component": 191}
    vehicle.others = [frame("COMMAND_ACK", AUTOPILOT, **each) for each in (ack, ours)]
    vehicle.wait(30)
    assert "RAW_IMU" not in {name for name, _ in autopilot.asked}


def test_a_gyro_of_the_autopilot_is_no_array():
    vehicle = Vehicle(Autopilot(EVERYTHING))
    vehicle.others = [imu("RAW_IMU", 1), debug_array(1, b"temps", [(0, 0, 0)])]
    assert {name for name, _ in vehicle.wait(20)} == ALL
