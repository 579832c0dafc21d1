"""Parameters as a ground station reads and sets them; pymavlink reads every answer."""

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from network import FAR, NEAR, Network, changed, of
from pymavlink.dialects.v20 import all as public
from wire import frame

from risaf_link.config import Config
from risaf_link.mavlink.parameters import Parameters, parameters_of
from risaf_link.mavlink.peers import Terms

ALL = parameters_of(Config)


def f32(value: float) -> float:
    return struct.unpack("<f", struct.pack("<f", value))[0]


@pytest.fixture
def network() -> Network:
    return Network()


def test_names_fit_and_differ():
    names = [parameter.name for parameter in ALL]
    assert len(set(names)) == len(names)
    assert all(0 < len(name) <= 16 and name.isascii() for name in names)


def test_every_default_is_in_its_range():
    parameters = Parameters(Config())
    assert all(p.admits(parameters.value(i)) for i, p in enumerate(ALL))


def test_the_list_is_whole_in_order_and_paced(network):
    network.wait(0.1)
    assert network.send("PARAM_REQUEST_LIST") == []
    listed = [of(network.wait(0.1)[NEAR], "PARAM_VALUE") for _ in range(10)]
    assert max(map(len, listed)) <= 20
    values = [value for tenth in listed for value in tenth]
    assert [v.param_id for v in values] == [p.name for p in ALL]
    assert [v.param_index for v in values] == list(range(len(ALL)))
    assert {(v.param_count, v.param_type) for v in values} == {(len(ALL), 9)}
    assert values[3].param_value == 4.0


def test_a_slow_link_gets_the_list_at_its_pace():
    network = Network(links={"ground": Terms(pace=5.0)})
    network.wait(0.1)
    network.send("PARAM_REQUEST_LIST")
    assert len(of(network.wait(2)[NEAR], "PARAM_VALUE")) == 10


def test_a_list_that_is_asked_for_again_begins_anew(network):
    network.wait(0.1)
    network.send("PARAM_REQUEST_LIST")
    network.wait(0.1)
    network.send("PARAM_REQUEST_LIST")
    assert of(network.wait(0.1)[NEAR], "PARAM_VALUE")[0].param_index == 0


def test_only_the_one_who_asked_gets_the_list(network):
    network.wait(0.1)
    network.send("PARAM_REQUEST_LIST")
    heard = network.wait(1)
    assert not of(heard[FAR], "PARAM_VALUE")


@pytest.mark.parametrize("to", [(1, 191), (1, 0), (0, 191), (0, 0)])
def test_reading_by_name_and_by_index_gives_the_same(network, to):
    to = {"target_system": to[0], "target_component": to[1]}
    (by_name,) = network.send("PARAM_REQUEST_READ", param_id=b"HDG_DELAY", param_index=-1, **to)
    (by_index,) = network.send(
        "PARAM_REQUEST_READ", param_id=b"x", param_index=by_name.param_index, **to
    )
    assert by_name.param_value == f32(0.11)
    assert by_index.to_dict() == by_name.to_dict()


def test_a_name_of_sixteen_characters_needs_no_end(network):
    (error,) = network.send("PARAM_REQUEST_READ", param_id=b"A" * 16, param_index=-1)
    assert (error.get_type(), error.param_id, error.error) == ("PARAM_ERROR", "A" * 16, 1)


@pytest.mark.parametrize(("index", "name"), [(-1, b"NONE"), (len(ALL), b""), (-2, b"FUS_GATE")])
def test_what_does_not_exist_is_said_to_the_one_who_asked(network, index, name):
    read = {"param_id": name, "param_index": index}
    (error,) = network.send("PARAM_REQUEST_READ", **read)
    assert error.error == public.MAV_PARAM_ERROR_DOES_NOT_EXIST
    assert (error.target_system, error.target_component) == (255, 190)
    assert not network.send("PARAM_REQUEST_READ", target_component=0, **read)


def test_a_set_value_is_in_force_and_told_to_all(network):
    to = {"target_system": 1, "target_component": 191}
    told = {"param_id": b"FUS_GATE", "param_value": 6.0, "param_type": 9}
    network.component.receive(frame("PARAM_SET", (255, 190), **told, **to), NEAR, 0)
    assert network.estimator.done[-1].fusion.gate == 6.0
    heard = network.heard()
    for peer in (NEAR, FAR):
        assert [(m.param_id, m.param_value) for m in heard[peer]] == [("FUS_GATE", 6.0)]


@pytest.mark.parametrize("value", [1.9, 1001.0, math.nan, math.inf, -math.inf])
def test_a_refused_value_answers_with_the_one_in_force(network, value):
    error, answer = network.set("FUS_GATE", value)
    assert error.error == public.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE
    assert (answer.param_id, answer.param_value) == ("FUS_GATE", 4.0)
    assert not network.estimator.done


def test_a_value_of_another_type_is_refused(network):
    error, answer = network.set(
        "FUS_METHOD", struct.unpack("<f", struct.pack("<i", 1))[0], param_type=6
    )
    assert error.error == 7  # MAV_PARAM_ERROR_TYPE_MISMATCH
    assert answer.param_value == 0


def test_a_choice_is_set_by_its_index(network):
    network.set("HDG_SOURCE", 4)
    assert network.estimator.done[-1].heading.source == "dual_antenna"
    assert network.set("HDG_SOURCE", 0.5)[1].param_value == 4


def test_a_vector_is_set_by_its_components(network):
    network.set("HDG_ANT_Y", -1.5)
    network.set("HDG_ANT_Z", 0.5)
    assert network.estimator.done[-1].heading.antenna == (0.0, -1.5, 0.5)


def test_setting_the_value_in_force_changes_nothing(network):
    network.set("FUS_ALPHA", f32(0.995))
    assert not network.estimator.done
    assert network.parameters.tuned.fusion.alpha == 0.995


def test_a_parameter_of_another_component_is_not_ours_to_answer(network):
    assert not network.set("FUS_GATE", 5.0, target_component=1)
    assert not network.set("FUS_GATE", 5.0, target_system=2)
    assert not network.set("RATE_ROLL", 5.0, target_component=0)
    assert not network.estimator.done


def test_rates_change_what_is_sent_to_who_has_not_asked(network):
    network.set("RATE_ARRAY", 0)
    network.set("RATE_GPS_HDG", 20)
    emit = network.parameters.tuned.emit
    assert "ARRAY_STATUS" not in emit
    assert emit["GPS_HEADING_STATUS"] == 20
    assert network.command(510, 59614)[0].interval_us == 50_000


def test_a_silent_link_answers_but_hears_nothing_else():
    network = Network(links={"ground": Terms(rates={})})
    assert not network.wait(3)
    (answer,) = network.set("FUS_GATE", 6.0)
    assert answer.param_value == 6.0


def test_what_was_kept_goes_over_the_configuration():
    network = Network(
        changed(Config(), fusion={"gate": 7.0}), kept={"FUS_GATE": 8.0, "FUS_ALPHA": 9.0, "X": 1.0}
    )
    assert network.parameters.tuned.fusion.gate == 8.0
    assert network.parameters.kept == {"FUS_GATE": 8.0}


def test_what_the_command_line_overrules_stays_kept_until_all_is_forgotten():
    parameters = Parameters(Config(), {"HDG_GATE": 5.0}, {"FUS_GATE": 8.0})
    assert parameters.tuned.fusion.gate == 4.0
    assert parameters.kept == {"FUS_GATE": 8.0, "HDG_GATE": 5.0}
    parameters.reset()
    assert (parameters.kept, parameters.tuned) == ({}, Config())


@given(
    index=st.integers(0, len(ALL) - 1),
    value=st.floats(width=32) | st.integers(-10, 10).map(float),
    kind=st.sampled_from([9, 9, 9, 0, 1, 6, 10, 255]),
)
def test_whatever_is_set_the_answer_is_a_value_in_range(index, value, kind):
    network = Network()
    before = network.parameters.value(index)
    *_, answer = network.set(ALL[index].name, value, param_type=kind)
    assert (answer.get_type(), answer.param_index) == ("PARAM_VALUE", index)
    after = network.parameters.value(index)
    assert answer.param_value == f32(after)
    taken = kind == 9 and ALL[index].admits(value)
    assert f32(after) == (value if taken else f32(before))
