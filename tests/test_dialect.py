"""Message definitions, held against pymavlink's and against DESIGN.md."""

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as public_dialect
from pymavlink.dialects.v20 import ardupilotmega
from pymavlink.generator import mavgen, mavparse
from streams import CLASSES, OURS, ROOT, STOCK, codec, message, payloads

from risaf_link.mavlink import risaf
from risaf_link.mavlink.dialect import CRC_EXTRA, IDS, MESSAGES, name_of, pack, reader, writer
from risaf_link.mavlink.frame import encode

DEFINITION = ROOT / "risaf_link" / "mavlink" / "risaf.xml"

DESIGN = {  # id and size of each message, its fields: type, name, unit
    "IMU_ARRAY_INFO": (
        59610,
        47,
        "uint64_t time_usec us, float gyro_scale rad/s, float gyro_range rad/s, "
        "float accel_scale m/s/s, float accel_range m/s/s, float rate Hz, "
        "uint16_t sensor_count, uint8_t array_id, char[16] name",
    ),
    "GYRO_ARRAY": (
        59611,
        254,
        "uint64_t time_usec us, uint16_t epoch_seq, uint16_t first_sensor, int16_t[120] rates, "
        "uint8_t sensor_count, uint8_t array_id",
    ),
    "ACCEL_ARRAY": (
        59612,
        254,
        "uint64_t time_usec us, uint16_t epoch_seq, uint16_t first_sensor, int16_t[120] forces, "
        "uint8_t sensor_count, uint8_t array_id",
    ),
    "TEMPERATURE_ARRAY": (
        59613,
        252,
        "uint64_t time_usec us, uint16_t first_sensor, int16_t[120] temperatures cdegC, "
        "uint8_t sensor_count, uint8_t array_id",
    ),
    "GPS_HEADING_STATUS": (
        59614,
        54,
        "uint64_t time_usec us, float heading rad, float heading_std rad, float innovation rad, "
        "float innovation_std rad, float test_ratio, float yaw rad, float yaw_std rad, "
        "float speed m/s, float time_since_fused s, uint32_t fused_count, "
        "uint32_t rejected_count, uint8_t source, uint8_t state",
    ),
    "ARRAY_STATUS": (
        59615,
        61,
        "uint64_t time_usec us, float[3] rate rad/s, float[3] rate_std rad/s, uint32_t epochs, "
        "uint32_t epochs_incomplete, uint32_t samples_lost, uint16_t sensors_expected, "
        "uint16_t sensors_valid, uint16_t[3] active, uint16_t healthy, uint16_t suspect, "
        "uint16_t dead, uint8_t array_id",
    ),
    "ARRAY_SENSOR_HEALTH": (
        59616,
        252,
        "uint64_t time_usec us, uint16_t first_sensor, int16_t[90] relative_bias, "
        "uint8_t[30] rejected_percent %, uint8_t[30] state, uint8_t sensor_count, "
        "uint8_t array_id",
    ),
    "ARRAY_SENSOR_REASON": (
        59617,
        132,
        "uint64_t time_usec us, uint16_t first_sensor, uint8_t[120] reason, "
        "uint8_t sensor_count, uint8_t array_id",
    ),
}


def fields_of(kind):
    """Fields of a generated message as they are written above."""
    sizes = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    for name, type_name in zip(kind.fieldnames, kind.fieldtypes, strict=True):
        size = f"[{sizes[name]}]" if sizes[name] else ""
        yield f"{type_name}{size} {name} {kind.fieldunits_by_name.get(name, '')}".strip()


@pytest.mark.parametrize("name", OURS)
def test_our_messages_are_those_of_the_design(name):
    message_id, size, fields = DESIGN[name]
    kind = risaf.mavlink_map[message_id]
    assert (kind.msgname, kind.unpacker.size) == (name, size)
    assert ", ".join(fields_of(kind)) == fields


def test_our_dialect_holds_nothing_else_and_collides_with_no_other():
    assert [kind.msgname for _, kind in sorted(risaf.mavlink_map.items())] == list(DESIGN)
    assert not risaf.mavlink_map.keys() & public_dialect.mavlink_map.keys()
    theirs = {kind.msgname for kind in public_dialect.mavlink_map.values()}
    assert not theirs & DESIGN.keys()


def test_the_states_of_a_heading_are_numbered_as_in_the_design():
    prefix = "RISAF_HEADING_STATE_"
    states = ["NO_FIX", "TOO_SLOW", "ALIGNING", "FUSING", "REJECTING", "DEAD_RECKONING"]
    entries = risaf.enums["RISAF_HEADING_STATE"]
    assert [entries[i].name for i in range(6)] == [prefix + state for state in states]


def test_the_committed_module_is_what_mavgen_makes_of_the_definition(tmp_path, capsys):
    options = mavgen.Opts(
        str(tmp_path / "risaf"),
        wire_protocol=mavparse.PROTOCOL_2_0,
        language="Python3",
        validate=True,
        strict_units=True,
    )
    assert mavgen.mavgen(options, [str(DEFINITION)])
    assert "Validating" in capsys.readouterr().out
    committed = DEFINITION.with_suffix(".py").read_bytes()
    assert (tmp_path / "risaf.py").read_bytes() == committed


@pytest.mark.parametrize("name", STOCK + OURS)
def test_messages_are_known_by_number_and_name(name):
    kind = CLASSES[name]
    assert IDS[name] == kind.id
    assert name_of(kind.id) == name
    assert MESSAGES[kind.id].msgname == name
    assert CRC_EXTRA[kind.id] == kind.crc_extra


def test_all_of_ardupilots_messages_are_known_with_its_checksums():
    known = {i: CRC_EXTRA.get(i) for i in ardupilotmega.mavlink_map}
    assert known == {i: kind.crc_extra for i, kind in ardupilotmega.mavlink_map.items()}


def test_an_unknown_message_has_a_name_too():
    assert name_of(70_000) == "UNKNOWN_70000"


def values_of(received):
    """Fields of a message of pymavlink, an array as a tuple, a text as bytes."""
    for name, kind in zip(received.fieldnames, received.fieldtypes, strict=True):
        value = getattr(received, f"_{name}_raw" if kind == "char" else name)
        yield tuple(value) if isinstance(value, list) else value


@pytest.mark.parametrize("name", STOCK + OURS)
@settings(max_examples=15)
@given(st.data())
def test_every_field_reads_as_pymavlink_reads_it(name, data):
    payload = data.draw(payloads(name))
    extension = data.draw(st.binary(max_size=255 - len(payload)))
    (received,) = codec(name).parse_buffer(encode(IDS[name], payload, 1, 7, 9))
    read = reader(name, *CLASSES[name].fieldnames)
    for wire in (payload, payload.rstrip(b"\0"), payload + extension):
        values = [v.split(b"\0")[0] if isinstance(v, bytes) else v for v in read(wire)]
        assert repr(values) == repr(list(values_of(received)))  # NaN is not equal to itself


def test_fields_come_in_the_order_that_was_asked_for():
    payload = struct.pack("<QI", 5, 7)
    assert reader("SYSTEM_TIME", "time_boot_ms", "time_unix_usec")(payload) == (7, 5)
    assert reader("SYSTEM_TIME", "time_unix_usec", "time_boot_ms")(payload) == (5, 7)


@pytest.mark.parametrize("name", STOCK + OURS)
@settings(max_examples=15)
@given(st.data())
def test_a_message_is_laid_out_as_pymavlink_lays_it_out(name, data):
    payload = data.draw(payloads(name))
    sent = message(name, payload)
    fields = dict(zip(sent.fieldnames, values_of(sent), strict=True))
    assert pack(name, **fields) == (IDS[name], payload)


def test_a_message_of_one_field_is_laid_out_as_well():
    assert pack("MISSION_ITEM_REACHED", seq=7) == (IDS["MISSION_ITEM_REACHED"], b"\7\0")
    assert pack("AUTH_KEY", key="abc") == (IDS["AUTH_KEY"], b"abc".ljust(32, b"\0"))


def test_a_writer_lays_out_what_pack_lays_out():
    write = writer("ATTITUDE_QUATERNION", "time_boot_ms", "q1", "q2")
    zeros = dict.fromkeys(("q3", "q4", "rollspeed", "pitchspeed", "yawspeed"), 0.0)
    told = {"time_boot_ms": 7, "q1": 0.5, "q2": -0.25, "repr_offset_q": [0.0] * 4}
    assert write(7, 0.5, -0.25) == pack("ATTITUDE_QUATERNION", **told, **zeros)


def test_a_writer_takes_fields_in_the_order_of_the_wire_alone():
    with pytest.raises(ValueError, match=r"ATTITUDE_QUATERNION: fields .*, expected the first of"):
        writer("ATTITUDE_QUATERNION", "q1", "time_boot_ms")


def test_a_text_may_be_given_as_text():
    fields = dict.fromkeys(CLASSES["IMU_ARRAY_INFO"].fieldnames, 0)
    _, payload = pack("IMU_ARRAY_INFO", **{**fields, "name": "bench"})
    assert payload.endswith(b"bench".ljust(16, b"\0"))


@pytest.mark.parametrize(
    ("fields", "error"),
    [
        ({"time_unix_usec": 1}, TypeError),
        ({"time_unix_usec": 1, "time_boot_ms": 1, "time": 1}, TypeError),
        ({"time_unix_usec": 1, "time_boot_ms": -1}, struct.error),
        ({"time_unix_usec": 1, "time_boot_ms": 1 << 32}, struct.error),
        ({"time_unix_usec": 1, "time_boot_ms": [1, 2]}, struct.error),
    ],
)
def test_fields_that_do_not_fit_are_refused(fields, error):
    with pytest.raises(error):
        pack("SYSTEM_TIME", **fields)


def test_a_field_that_is_not_the_messages_is_refused():
    with pytest.raises(ValueError, match="time_usec"):
        reader("SYSTEM_TIME", "time_usec", "time_boot_ms")
