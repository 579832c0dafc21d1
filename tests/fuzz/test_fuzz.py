"""What must hold for any bytes: of the inputs that are kept, and of what hypothesis writes.

Longer runs, by atheris: see README.md.
"""

import logging
from pathlib import Path

import pytest
from fuzz_script import HEAD, LONGEST, NAMES, line, mended, messages
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from targets import TARGETS

from risaf_link.mavlink.frame import FrameParser

CORPUS = Path(__file__).parent / "corpus"
FRAMED = ["stream", "tlog", "replay"]
SCRIPTED = ["ingest", "component", "service", "signing", "page"]
WRITTEN = ["config", "kept", "calibration", "state"]
EXAMPLES = {"stream": 400, "tlog": 200, "replay": 40}  # else 100


@pytest.fixture(autouse=True)
def quiet(caplog):
    """Say nothing of what is found wrong, thousands of times."""
    caplog.set_level(logging.CRITICAL, "risaf_link")


def kept(name: str) -> list[bytes]:
    return [path.read_bytes() for path in sorted((CORPUS / name).iterdir())]


def limited(name: str):
    return settings(
        max_examples=EXAMPLES.get(name, 100),
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )


@st.composite
def spoiled(draw: st.DrawFn, contents: list[bytes]) -> bytes:
    """Something that is kept, with bytes changed, taken out, put in or doubled."""
    data = bytearray(draw(st.sampled_from(contents)))
    for _ in range(draw(st.integers(0, 6))):
        at = draw(st.integers(0, len(data)))
        end = at + draw(st.integers(0, 30))
        data[at:end] = draw(
            st.binary(max_size=12)
            | st.just(bytes(data[at:end]) * 2)
            | st.sampled_from([b"\xff" * 8, b"\0" * 8, b"\xfd", b"\xfe", b"{", b'"', b": ", b"\n"])
        )
    return bytes(data)


@st.composite
def scripts(draw: st.DrawFn) -> bytes:
    """Lines of a script, most of which lay little over a sensible message."""
    byte = st.integers(0, 255)
    usual = st.sampled_from([0, 0, 0x11, 0x44, 0x10])
    lines = st.builds(
        lambda name, overlay, offset, steps, who, repeat: line(
            name, overlay, offset=offset, steps=steps, who=who, repeat=repeat
        ),
        st.sampled_from(NAMES) | st.sampled_from(["GYRO_ARRAY", "ACCEL_ARRAY", "GPS_RAW_INT"]),
        st.just(b"") | st.binary(max_size=12),
        byte,
        usual | byte,
        st.just(0) | byte,
        byte,
    )
    return draw(st.binary(min_size=1, max_size=1)) + b"".join(draw(st.lists(lines, max_size=12)))


@pytest.mark.parametrize("name", TARGETS)
def test_what_is_kept_shows_no_fault(name):
    for content in kept(name):
        TARGETS[name](content)


@pytest.mark.parametrize("name", FRAMED)
def test_streams_and_logs_that_are_spoiled(name):
    @limited(name)
    @given(spoiled(kept(name)), st.booleans())
    def check(data: bytes, is_mended: bool) -> None:
        TARGETS[name](mended(data) if is_mended else data)

    check()


@pytest.mark.parametrize("name", SCRIPTED)
def test_messages_that_nobody_would_send(name):
    @limited(name)
    @given(scripts() | spoiled(kept(name)))
    def check(data: bytes) -> None:
        TARGETS[name](data)

    check()


@pytest.mark.parametrize("name", WRITTEN)
def test_files_that_are_spoiled(name):
    @limited(name)
    @given(spoiled(kept(name)) | st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
    def check(data: bytes) -> None:
        TARGETS[name](data)

    check()


@given(st.binary(max_size=500))
def test_any_bytes_are_a_script_whose_frames_are_whole(data):
    sent = list(messages(data))
    parser = FrameParser()
    frames = [frame for each in sent for frame in parser.receive_data(each.raw)]
    assert [frame.raw for frame in frames] == [each.raw for each in sent]
    assert len(sent) <= LONGEST
    assert sent or len(data) < HEAD.size
