"""What the component says by itself, and what it makes of commands; pymavlink reads every frame."""

import struct
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import structs
from network import FAR, NEAR, OTHER_GCS, OWN, Network, acks, of, texts
from pymavlink.dialects.v20 import all as public
from pymavlink.generator import mavparse
from vehicle import Vehicle
from wire import frame

from risaf_link.config import Config
from risaf_link.core.estimate import Estimate
from risaf_link.core.guard import Refused
from risaf_link.core.heading import HeadingState
from risaf_link.core.health import SensorState
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.frame import FrameParser
from risaf_link.mavlink.peers import MOST_PEERS, Terms
from risaf_link.pipeline import Pipeline

ACCEPTED, REJECTED, DENIED, UNSUPPORTED, FAILED, IN_PROGRESS = range(6)
CALIBRATE, STORE, REBOOT, GET, SET, REQUEST = 241, 245, 246, 510, 511, 512
QUATERNION = IDS["ATTITUDE_QUATERNION"]


@pytest.fixture
def network() -> Network:
    return Network()


def an_estimate() -> Estimate:
    vehicle = Vehicle(4)
    pipeline = Pipeline(Config(), OWN)
    pipeline.step(vehicle.info(), 0)
    return [e for t in (1, 2) for e in pipeline.step(vehicle.epoch(t * 10_000, (0, 0, 0)), 0)][-1]


ESTIMATE = an_estimate()


def at(time_s: float, **changes) -> Estimate:
    estimate = copy(ESTIMATE)
    changes = {"heading": ESTIMATE.heading} | changes  # it would be made of the other changes
    vars(estimate).update(time_us=round(time_s * 1e6), elapsed=time_s, **changes)
    return estimate


def heartbeat(system, component=1, autopilot=12, kind=2, base_mode=0):
    return frame(
        "HEARTBEAT", (system, component), type=kind, autopilot=autopilot, base_mode=base_mode
    )


class TestHeartbeat:
    def states(self, heard):
        return [m.system_status for m in of(heard.get(NEAR, []), "HEARTBEAT")]

    def test_it_beats_once_a_second_for_every_peer(self, network):
        heard = network.wait(5)
        assert self.states(heard) == [public.MAV_STATE_BOOT] * 5
        (one, *_) = of(heard[FAR], "HEARTBEAT")
        assert (one.type, one.autopilot) == (18, public.MAV_AUTOPILOT_INVALID)
        assert (one.get_srcSystem(), one.get_srcComponent()) == OWN

    def test_a_stalled_estimator_is_critical_then_silent_then_back(self, network):
        for k in range(10):
            network.estimate(at(k))
            assert self.states(network.wait(1)) == [public.MAV_STATE_ACTIVE]
        assert self.states(network.wait(11)) == [4] * 1 + [5] * 8
        assert not self.states(network.wait(20))
        network.estimate(at(50))
        assert self.states(network.wait(2)) == [4, 4]

    def test_a_late_look_makes_no_burst(self, network):
        network.wait(1)
        network.now_us += 10_000_000
        assert len(self.states(network.wait(1))) == 1


class TestIdentity:
    def spoken(self, network):
        return {m.get_srcSystem() for m in of(network.wait(1)[NEAR], "HEARTBEAT")}

    def hear(self, network, *beats, seconds=4):
        for _ in range(seconds):
            for beat in beats:
                network.take(beat)
            network.now_us += 1_000_000

    def test_the_system_of_the_one_autopilot_is_adopted(self):
        network = Network(adopts=True)
        self.hear(network, heartbeat(7), heartbeat(255, 190, 8, 6), heartbeat(7, 100, 8, 30))
        assert self.spoken(network) == {7}
        assert network.estimator.done == [(7, 191)]

    def test_it_is_known_by_its_type_not_by_its_component_id(self):
        network = Network(adopts=True)
        self.hear(network, heartbeat(9, component=191), heartbeat(3, component=1, autopilot=8))
        assert self.spoken(network) == {9}

    def test_of_two_none_is_adopted(self):
        network = Network(adopts=True)
        self.hear(network, heartbeat(7), heartbeat(8))
        self.hear(network, heartbeat(7))
        assert self.spoken(network) == {1}

    def test_what_is_configured_stays(self, network):
        self.hear(network, heartbeat(7))
        assert self.spoken(network) == {1}

    def test_nothing_is_decided_before_three_seconds(self):
        network = Network(adopts=True)
        self.hear(network, heartbeat(7), seconds=2)
        assert self.spoken(network) == {1}

    def test_commands_are_taken_under_the_adopted_id(self):
        network = Network(adopts=True)
        self.hear(network, heartbeat(7))
        assert not network.command(REQUEST, 0)
        assert acks(network.command(REQUEST, 0, target_system=7)) == [(REQUEST, ACCEPTED)]


class TestIntervals:
    def rate(self, network, peer, name="ATTITUDE_QUATERNION"):
        heard = [network.estimate(at(100 + k / 100)) for k in range(100)]
        return sum(len(of(h.get(peer, []), name)) for h in heard)

    def test_each_peer_has_its_own(self, network):
        assert acks(network.command(SET, QUATERNION, 100_000)) == [(SET, ACCEPTED)]
        assert self.rate(network, NEAR) == 10
        assert self.rate(network, FAR) == 50

    def test_off_default_and_back(self, network):
        network.command(SET, QUATERNION, -1)
        assert self.rate(network, NEAR) == 0
        network.command(SET, QUATERNION, 0)
        assert self.rate(network, NEAR) == 50

    def test_a_silent_link_can_be_asked_for_a_stream(self):
        network = Network(links={"ground": Terms(rates={})})
        network.command(SET, QUATERNION, 1e6 / 20)
        assert (self.rate(network, NEAR), self.rate(network, FAR)) == (20, 0)

    @pytest.mark.parametrize(
        ("message", "interval"),
        [
            (QUATERNION, -2),
            (QUATERNION, float("nan")),
            (QUATERNION, 3e9),
            (0, 1e6),
            (24, 1e6),
            (31.5, 1),
        ],
    )
    def test_what_cannot_be_is_denied(self, network, message, interval):
        assert acks(network.command(SET, message, interval)) == [(SET, DENIED)]
        assert self.rate(network, NEAR) == 50

    def test_one_peer_gets_no_more_than_two_thousand_messages_a_second(self, network):
        asked = [(QUATERNION, 1), (59615, 2000), (59616, 1000)]  # 1 us is taken for a millisecond
        results = [acks(network.command(SET, *one))[0][1] for one in asked]
        assert results == [ACCEPTED, ACCEPTED, DENIED]
        assert network.command(GET, QUATERNION)[0].interval_us == 1000
        assert acks(network.command(SET, QUATERNION, 2000)) == [(SET, ACCEPTED)]
        assert acks(network.command(SET, 59616, 1000)) == [(SET, ACCEPTED)]
        assert acks(network.command(SET, QUATERNION, 1e6, peer=FAR)) == [(SET, ACCEPTED)]

    def test_who_is_served_is_not_forgotten_for_those_who_come_and_go(self, network):
        network.command(SET, QUATERNION, 1e6 / 20)
        for port in range(2 * MOST_PEERS):
            network.peers = [NEAR, ("ground", f"10.9.9.9:{port}")]
            network.estimate(at(50 + port / 1000))
        network.peers = [NEAR]
        assert self.rate(network, NEAR) == 20

    def test_they_can_be_read_in_both_ways(self, network):
        network.command(SET, QUATERNION, 40_000)
        network.command(SET, 59615, -1)
        for wanted, interval in [(QUATERNION, 40_000), (59615, -1), (0, 1_000_000), (24, 0)]:
            for command in [(GET, wanted), (REQUEST, 244, wanted)]:
                told, ack = network.command(*command)
                assert (told.message_id, told.interval_us) == (wanted, interval)
                assert ack.result == ACCEPTED

    def test_sequence_numbers_count_for_each_peer(self, network):
        sequences = []
        for k in range(60):
            network.command(REQUEST, 0, peer=FAR)  # what another one asks leaves no gap
            heard = network.estimate(at(200 + k / 10))
            sequences += [m.get_seq() for m in heard[NEAR]]
        assert sequences == [k % 256 for k in range(len(sequences))]
        assert len(sequences) > 100


class TestRequests:
    def test_a_message_comes_once(self, network):
        network.estimate(at(1))
        told, ack = network.command(REQUEST, QUATERNION)
        assert (told.get_type(), ack.result) == ("ATTITUDE_QUATERNION", ACCEPTED)

    def test_before_the_first_estimate_it_is_too_early(self, network):
        assert acks(network.command(REQUEST, QUATERNION)) == [(REQUEST, REJECTED)]

    def test_who_we_are_is_told_as_the_definition_says(self, network, tmp_path):
        network.component.receive(
            frame(
                "COMMAND_LONG",
                (255, 190),
                target_system=1,
                target_component=191,
                command=512,
                param1=396,
            ),
            NEAR,
            0,
        )
        (_, raw), _ = network.component.collect([NEAR])
        told = tmp_path / "common.xml"
        told.write_text(BASIC)
        (message,) = mavparse.MAVXML(str(told), "2.0").message
        (found,) = FrameParser().receive_data(raw)
        assert found.message_id == message.id == 396
        crc = public.x25crc(raw[1:-2] + bytes([message.crc_extra])).crc  # the checksum of pymavlink
        assert raw[-2:] == crc.to_bytes(2, "little")
        payload = found.payload.ljust(message.wire_length, b"\0")
        capabilities, _, _, vendor, _, version, *_ = struct.unpack("<QII32s32s24s24s32s", payload)
        assert [f.name for f in message.ordered_fields][:3] == [
            *("capabilities", "time_boot_ms", "time_manufacture_s")
        ]
        assert vendor.rstrip(b"\0") == b"risaf_link"
        assert version[0:1].isdigit()
        assert capabilities & public.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
        assert not capabilities & public.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
        assert capabilities & public.MAV_PROTOCOL_CAPABILITY_MAVLINK2

    @pytest.mark.parametrize("message", [148, 24, 397, -1, 1e9])
    def test_what_we_do_not_have_is_denied(self, network, message):
        assert acks(network.command(REQUEST, message)) == [(REQUEST, DENIED)]


FIELDS = {
    "time_boot_ms": "uint32_t",
    "capabilities": "uint64_t",
    "time_manufacture_s": "uint32_t",
    "vendor_name": "char[32]",
    "model_name": "char[32]",
    "software_version": "char[24]",
    "hardware_version": "char[24]",
    "serial_number": "char[32]",
}
BASIC = f"""<mavlink><version>3</version><messages>
<message id="396" name="COMPONENT_INFORMATION_BASIC"><description>As in common.xml.</description>
{"".join(f'<field type="{kind}" name="{name}">-</field>' for name, kind in FIELDS.items())}
</message></messages></mavlink>"""


class TestAddresses:
    @pytest.mark.parametrize("to", [(2, 191), (1, 1), (2, 0)])
    def test_what_is_for_others_is_left_to_them(self, network, to):
        to = dict(zip(("target_system", "target_component"), to, strict=True))
        assert not network.command(SET, QUATERNION, 1e6, **to)
        assert network.command(GET, QUATERNION)[0].interval_us == 20_000

    def test_unknown_commands_are_unsupported_if_they_are_for_us(self, network):
        (ack,) = network.command(400, 1)
        assert (ack.command, ack.result) == (400, UNSUPPORTED)
        assert (ack.target_system, ack.target_component) == (255, 190)

    @pytest.mark.parametrize("to", [(0, 0), (1, 0), (0, 191)])
    @pytest.mark.parametrize("command", [(400, 1), (REBOOT, 1), (REQUEST, 148), (CALIBRATE, 0, 1)])
    def test_what_is_for_all_and_not_done_is_left_to_others(self, network, command, to):
        to = dict(zip(("target_system", "target_component"), to, strict=True))
        assert not network.command(*command, **to)
        assert not network.estimator.done

    def test_what_is_for_all_and_done_is_acknowledged(self, network):
        assert acks(network.command(SET, QUATERNION, 1e6, target_component=0)) == [(SET, ACCEPTED)]

    def test_our_own_frames_are_not_orders(self, network):
        assert not network.command(REQUEST, 0, sender=OWN)

    def test_a_command_int_is_a_command(self, network):
        answers = network.send("COMMAND_INT", command=SET, param1=QUATERNION, param2=50_000)
        assert acks(answers) == [(SET, ACCEPTED)]

    def test_an_answer_goes_only_to_the_one_who_asked(self, network):
        network.component.receive(
            frame("COMMAND_LONG", OTHER_GCS, target_system=1, target_component=191, command=99),
            FAR,
            0,
        )
        heard = network.heard()
        assert (len(heard[NEAR]), len(heard[FAR])) == (0, 1)


class TestRestart:
    @pytest.mark.parametrize("values", [(1,), (1, float("nan"), float("nan")), (0, 0, 1, 191)])
    def test_a_reboot_of_ours_restarts_the_filter(self, network, values):
        assert acks(network.command(REBOOT, *values)) == [(REBOOT, ACCEPTED)]
        assert network.estimator.done == ["restart"]

    @pytest.mark.parametrize("values", [(0,), (2,), (0, 1), (1, 1), (0, 0, 1, 1), (0, 0, 2, 191)])
    def test_any_other_is_denied(self, network, values):
        assert acks(network.command(REBOOT, *values)) == [(REBOOT, DENIED)]
        assert not network.estimator.done

    def test_not_while_the_vehicle_is_armed(self, network):
        network.take(heartbeat(1, base_mode=128))
        assert acks(network.command(REBOOT, 1)) == [(REBOOT, REJECTED)]
        network.take(heartbeat(1))
        assert acks(network.command(REBOOT, 1)) == [(REBOOT, ACCEPTED)]


class TestStorage:
    @pytest.fixture
    def kept(self):
        return []

    @pytest.fixture
    def network(self, kept):
        return Network(keep=kept.append, kept={"FUS_GATE": 5.0})

    def test_what_was_set_is_stored_then_acknowledged(self, network, kept):
        network.set("HDG_GATE", 4.0)
        assert acks(network.command(STORE, 1)) == [(STORE, IN_PROGRESS)]
        assert kept == [{"FUS_GATE": 5.0, "HDG_GATE": 4.0}]
        network.component.kept(kept[0])
        assert acks(network.heard()[NEAR]) == [(STORE, ACCEPTED)]

    def test_a_failure_is_told(self, network, kept):
        network.command(STORE, 1)
        network.component.kept(kept[0], "disk full")
        heard = network.heard()[NEAR]
        assert acks(heard) == [(STORE, FAILED)]
        assert texts(heard) == ["parameters not stored: disk full"]

    def test_one_at_a_time(self, network, kept):
        network.command(STORE, 1)
        assert acks(network.command(STORE, 1)) == [(STORE, IN_PROGRESS)]
        again = network.command(STORE, 1, sender=OTHER_GCS, peer=FAR)
        assert acks(again) == [(STORE, REJECTED)]
        assert len(kept) == 1

    def test_reading_brings_back_what_was_stored(self, network):
        network.set("FUS_GATE", 9.0)
        network.set("HDG_GATE", 9.0)
        assert acks(network.command(STORE, 0)) == [(STORE, ACCEPTED)]
        tuned = network.estimator.done[-1]
        assert (tuned.fusion.gate, tuned.heading.gate) == (5.0, 3.0)

    def test_a_reset_brings_back_the_configuration_and_forgets(self, network, kept):
        network.wait(1)  # everyone is known by then
        assert acks(network.command(STORE, 2)) == [(STORE, IN_PROGRESS)]
        assert network.estimator.done[-1].fusion.gate == 4.0
        assert kept == [{}]
        told = of(network.wait(2)[FAR], "PARAM_VALUE")
        assert {m.param_id: m.param_value for m in told}["FUS_GATE"] == 4.0

    def test_without_a_place_it_fails(self):
        network = Network()
        assert acks(network.command(STORE, 1)) == [(STORE, FAILED)]

    @pytest.mark.parametrize("action", [3, -1, 0.5, float("nan")])
    def test_other_actions_are_denied(self, network, action):
        assert acks(network.command(STORE, action)) == [(STORE, DENIED)]


class Vehicles(Network):
    """A network whose estimator is a real one, fed by a vehicle."""

    def __init__(self) -> None:
        self.pipeline = Pipeline(Config(), OWN)
        super().__init__(estimator=self.pipeline)
        self.vehicle = Vehicle(5)
        self.pipeline.step(self.vehicle.info(), 0)
        self.time_us = 1_000_000

    def go(self, seconds, rate=(0.0, 0.0, 0.0)):
        """Drive on, at 100 Hz; what the near one hears by the way, streams aside."""
        heard = []
        for _ in range(round(seconds * 100)):
            self.time_us += 10_000
            for estimate in self.pipeline.step(self.vehicle.epoch(self.time_us, rate), 0):
                self.estimate(estimate)
                self.last = estimate
            heard += self.heard().get(NEAR, [])
        return heard

    def bias(self):
        return self.last.attitude.bias_b


class TestCalibration:
    def test_at_rest_the_bias_is_learnt_with_progress(self):
        network = Vehicles()
        network.go(0.5)
        assert acks(network.command(CALIBRATE, 1)) == [(CALIBRATE, IN_PROGRESS)]
        bias = np.array([0.02, -0.03, 0.05])
        heard = of(network.go(6, bias), "COMMAND_ACK")
        assert [m.result for m in heard] == [IN_PROGRESS] * 9 + [ACCEPTED]
        assert [m.progress for m in heard[:-1]] == list(range(10, 100, 10))
        assert network.bias() == pytest.approx(bias, abs=2e-4)

    def test_a_vehicle_that_turns_is_refused_and_its_bias_stays(self):
        network = Vehicles()
        network.go(0.5)
        network.command(CALIBRATE, 1)
        network.go(2)
        heard = network.go(4, (0.0, 0.0, 0.1))
        assert acks(heard)[-1] == (CALIBRATE, FAILED)
        assert texts(heard) == ["gyro calibration failed: not at rest"]
        assert np.abs(network.bias()).max() < 0.01

    def test_one_at_a_time_and_again_for_who_began_it(self):
        network = Vehicles()
        network.go(0.5)
        network.command(CALIBRATE, 1)
        network.go(1.1)
        (again,) = network.command(CALIBRATE, 1)
        assert (again.result, again.progress) == (IN_PROGRESS, 20)
        other = network.command(CALIBRATE, 1, peer=FAR, sender=OTHER_GCS)
        assert acks(other) == [(CALIBRATE, REJECTED)]

    def test_it_can_be_cancelled(self):
        network = Vehicles()
        network.go(0.5)
        network.command(CALIBRATE, 1)
        assert (CALIBRATE, ACCEPTED) in acks(network.command(CALIBRATE))
        assert not acks(network.go(6))

    def test_without_samples_it_ends(self):
        network = Vehicles()
        network.go(0.5)
        network.wait(0.1)
        network.command(CALIBRATE, 1)
        assert acks(network.wait(4)[NEAR]) == [(CALIBRATE, FAILED)]

    @pytest.mark.parametrize("values", [(3,), (0, 1), (1, 0, 0, 0, 1), (float("nan"), 1)])
    def test_what_is_no_gyro_is_denied(self, values):
        network = Vehicles()
        network.go(0.1)
        assert acks(network.command(CALIBRATE, *values)) == [(CALIBRATE, DENIED)]

    def test_not_before_the_first_estimate(self, network):
        assert acks(network.command(CALIBRATE, 1)) == [(CALIBRATE, REJECTED)]


class TestNotices:
    def told(self, network, seconds=6.0, **changes):
        heard = []
        for k in range(round(seconds)):
            self.time = getattr(self, "time", 1000.0) + 1.0
            network.estimate(at(self.time + k * 1e-3, **changes))
            heard += texts(network.wait(1)[NEAR])
        return heard

    def status(self, state, **changes):
        return structs.replace(ESTIMATE.heading, state=state, **changes)

    def test_a_quiet_drive_says_nothing(self, network):
        assert self.told(network, 20) == []

    def test_alignment_outage_and_return(self, network):
        aligned = structs.replace(ESTIMATE.attitude, aligned=True, resets=1)
        on = {"attitude": aligned, "heading": self.status(HeadingState.FUSING)}
        out = {"attitude": aligned, "heading": self.status(HeadingState.DEAD_RECKONING)}
        assert self.told(network, **on) == ["heading aligned: 0 deg"]
        assert self.told(network, **out) == ["GPS lost: heading by dead reckoning"]
        assert self.told(network, **on) == ["GPS is back"]

    def test_after_a_restart_it_is_told_when_the_heading_is_aligned_again(self, network):
        aligned = structs.replace(ESTIMATE.attitude, aligned=True, resets=1)
        self.told(network, attitude=aligned)
        assert self.told(network) == []
        assert self.told(network, attitude=aligned) == ["heading aligned: 0 deg"]

    def test_where_estimates_are_refused_samples_are_not_said_to_be_missing(self, network):
        self.told(network, 2)
        network.component.trouble = "3 sensors, calibrated are 5"
        said = texts(network.wait(8)[NEAR])
        assert said == ["no estimates: 3 sensors, calibrated are 5"]

    def test_rejection_is_a_state_after_two_seconds(self, network):
        brief = {"heading": self.status(HeadingState.REJECTING, time_since_fused=1.0)}
        long = {"heading": self.status(HeadingState.REJECTING, time_since_fused=3.0)}
        on = {"heading": self.status(HeadingState.FUSING)}
        assert self.told(network, **brief) == []
        assert self.told(network, **long) == ["GPS heading rejected"]
        assert self.told(network, **on) == ["GPS heading is used again"]

    @pytest.mark.parametrize(("innovation", "told"), [(0.6, ", test ratio 2.0"), (0.1, "")])
    def test_a_rejection_tells_by_how_much_where_that_was_the_reason(
        self, network, innovation, told
    ):
        refused = Refused(innovation, 0.01, 3.0)
        status = self.status(HeadingState.REJECTING, time_since_fused=3.0, innovation=refused)
        assert self.told(network, heading=status) == [f"GPS heading rejected{told}"]

    def test_sensors_that_die_and_come_back(self, network):
        health = ESTIMATE.array.health
        dead = replace(health, state=np.array([0, 0, SensorState.DEAD, 0], dtype=np.int8))
        with_dead = {"array": replace(ESTIMATE.array, health=dead)}
        assert self.told(network, **with_dead) == ["1 of 4 sensors dead"]
        assert self.told(network) == ["all sensors are back"]

    def test_what_flickers_is_told_at_most_every_five_seconds(self, network):
        aligned = structs.replace(ESTIMATE.attitude, aligned=True, resets=0)
        said = []
        for k in range(40):
            state = HeadingState.DEAD_RECKONING if k % 2 else HeadingState.FUSING
            said += self.told(network, 1, attitude=aligned, heading=self.status(state))
        assert 5 <= len(said) <= 8

    def test_a_clock_that_was_reset(self, network):
        self.told(network, 2)
        network.estimate(at(0.5))
        assert texts(network.wait(1)[NEAR]) == ["the array's clock was reset"]

    def test_samples_that_stop_and_come_back(self, network):
        self.told(network, 2)
        assert texts(network.wait(6)[NEAR]) == ["no samples from the array: no estimates"]
        assert self.told(network, 2) == ["samples are back"]

    def test_trouble_is_told_in_chunks_and_put_together(self, network):
        network.component.trouble = "x" * 120
        said = texts(network.wait(1)[NEAR])
        assert said == ["no estimates: " + "x" * 120]

    def test_a_complaint_is_told_once_and_when_it_has_gone(self, network):
        complaints = network.component.complaints
        complaints["recording log"] = "/var: No space left on device"
        wrong = "recording log: /var: No space left on device"
        assert texts(network.wait(60)[NEAR]) == [wrong]
        complaints["recording log"] = ""
        assert texts(network.wait(60)[NEAR]) == ["recording log: in order again"]

    @pytest.mark.parametrize("length", [36, 37, 86, 87])
    def test_the_last_chunk_is_never_full_of_more_than_one(self, network, length):
        network.component.trouble = "y" * (length - 1)
        chunks = of(network.wait(1)[NEAR], "STATUSTEXT")
        assert "".join(c.text for c in chunks) == "no estimates: " + "y" * (length - 1)
        assert len(chunks) == 1 or len(chunks[-1].text) < 50


values = st.one_of(
    st.floats(width=32), st.integers(-3, 3), st.sampled_from([31, 59614, 244, 396, 1e6, 0, 191])
)


@settings(max_examples=200)
@given(
    commands=st.lists(
        st.tuples(
            st.sampled_from([CALIBRATE, STORE, REBOOT, GET, SET, REQUEST, 0, 400, 65535]),
            st.lists(values, max_size=7),
            st.booleans(),
            st.sampled_from([NEAR, FAR]),
        ),
        max_size=12,
    )
)
def test_whatever_is_commanded_is_answered_once_at_least(commands):
    kept = []
    network = Network(keep=kept.append)
    for k, (command, params, is_int, peer) in enumerate(commands):
        if is_int:
            fields = {f"param{i}": v for i, v in enumerate(params[:4], 1)}
            answers = network.send("COMMAND_INT", peer=peer, command=command, **fields)
        else:
            answers = network.command(command, *params, peer=peer)
        assert [c for c, _ in acks(answers)].count(command) >= 1
        network.estimate(at(10 + k / 10))
        network.wait(0.1)


numbers = st.floats(width=32)
byte = st.integers(0, 255)
ORDERS = st.one_of(
    st.tuples(
        st.just("COMMAND_LONG"),
        st.fixed_dictionaries(
            {"command": st.integers(0, 65535), "confirmation": byte},
            optional={f"param{i}": values for i in range(1, 8)},
        ),
    ),
    st.tuples(
        st.just("COMMAND_INT"),
        st.fixed_dictionaries(
            {"command": st.integers(0, 65535), "frame": byte},
            optional={f"param{i}": values for i in range(1, 5)}
            | {axis: st.integers(-(2**31), 2**31 - 1) for axis in "xy"}
            | {"z": numbers},
        ),
    ),
    st.tuples(
        st.just("PARAM_SET"),
        st.fixed_dictionaries(
            {"param_id": st.binary(max_size=16), "param_value": numbers, "param_type": byte}
        ),
    ),
    st.tuples(
        st.just("PARAM_REQUEST_READ"),
        st.fixed_dictionaries(
            {"param_id": st.binary(max_size=16), "param_index": st.integers(-(2**15), 2**15 - 1)}
        ),
    ),
    st.tuples(st.just("PARAM_REQUEST_LIST"), st.just({})),
)


@settings(max_examples=300)
@given(orders=st.lists(ORDERS, max_size=10), is_armed=st.booleans(), runs=st.booleans())
def test_whoever_asks_us_anything_is_answered(orders, is_armed, runs):
    network = Network(keep=lambda _: None)
    network.component.receive(heartbeat(1, base_mode=128 * is_armed), NEAR, 0)
    for k, (name, fields) in enumerate(orders):
        if runs:
            network.estimate(at(1 + k / 10))
        answers = network.send(name, **fields) + network.wait(0.2)[NEAR]
        if "command" in fields:
            assert fields["command"] in [command for command, _ in acks(answers)]
        else:
            assert of(answers, "PARAM_VALUE") + of(answers, "PARAM_ERROR")
    assert of(network.wait(1.5)[FAR], "HEARTBEAT")


@settings(max_examples=200)
@given(
    name=st.sampled_from(
        [
            "COMMAND_LONG",
            "COMMAND_INT",
            "PARAM_SET",
            "PARAM_REQUEST_READ",
            "PARAM_REQUEST_LIST",
            "HEARTBEAT",
        ]
    ),
    payload=st.binary(max_size=60),
    sender=st.tuples(st.integers(0, 255), st.integers(0, 255)),
)
def test_no_bytes_of_a_payload_raise(name, payload, sender):
    network = Network(adopts=True)
    template = frame(name, sender)
    network.component.receive(structs.replace(template, payload=payload), NEAR, 5)
    network.wait(0.3)
