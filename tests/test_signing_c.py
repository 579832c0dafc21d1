"""Signing, held against the C library that autopilots and ground stations are built with."""

import shutil
import subprocess
from pathlib import Path

import pymavlink
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.generator import mavgen, mavparse
from streams import KEY, parsed
from test_signing import MINUTE, OTHER_KEY, link, signed

from risaf_link.mavlink.frame import Frame
from risaf_link.mavlink.signing import SigningKey, SigningState
from risaf_link.mavlink.telemetry import ComponentState, Emitter

SOURCE = Path(__file__).parent / "clients" / "c_library.c"
COMPILER = shutil.which("cc")
OK, BAD_SIGNATURE = 1, 3

pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """Run the program on some input."""
    directory = tmp_path_factory.mktemp("c_library")
    definitions = Path(pymavlink.__file__).parent / "dialects" / "v20" / "minimal.xml"
    options = mavgen.Opts(
        str(directory), wire_protocol=mavparse.PROTOCOL_2_0, language="C", validate=False
    )
    mavgen.mavgen(options, [str(definitions)])
    program = directory / "program"
    silence = ["-w", "-I", str(directory)]
    subprocess.run([COMPILER, *silence, "-o", str(program), str(SOURCE)], check=True)

    def run(*arguments: object, data: bytes = b"") -> bytes:
        command = [str(program), KEY.hex(), *map(str, arguments)]
        return subprocess.run(command, input=data, capture_output=True, check=True).stdout

    return run


def verdicts(library, frames: list[Frame]) -> list[tuple[int, int]]:
    """What the library says of each frame, and its clock then."""
    lines = library("read", data=b"".join(frame.raw for frame in frames)).decode().splitlines()
    return [(int(verdict), int(ticks)) for verdict, ticks in map(str.split, lines)]


def test_the_c_library_takes_what_we_sign(library):
    ticks = 10 * MINUTE
    emitter = Emitter({}, 1, 191, link(SigningKey(KEY, SigningState(ticks)), link_id=5))
    raws = [emitter.heartbeat(ComponentState.ACTIVE) for _ in range(20)]
    found, _ = parsed(raws)
    assert verdicts(library, found) == [(OK, ticks + k) for k in range(1, 21)]


def test_we_take_what_the_c_library_signs(library):
    found, parser = parsed([library("write", 6, 10 * MINUTE, 20)])
    assert (len(found), parser.skipped) == (20, 0)
    verifier = link()
    assert all(verifier.accepts(each) for each in found)
    assert {each.signature[0] for each in found} == {6}
    assert verifier.key.ticks >= 10 * MINUTE + 19


ARRIVALS = st.lists(
    st.tuples(
        st.tuples(st.integers(0, 2), st.integers(1, 3), st.just(1)),
        st.integers(5 * MINUTE, 8 * MINUTE),
        st.sampled_from([KEY, KEY, KEY, OTHER_KEY]),
    ),
    min_size=1,
    max_size=40,
)


@settings(max_examples=50)
@given(ARRIVALS)
def test_frames_are_judged_as_the_c_library_judges_them(library, arrivals):
    frames = [signed(ticks, stream, key) for stream, ticks, key in arrivals]
    verifier = link()
    taken = ((verifier.accepts(frame), verifier.key.ticks) for frame in frames)
    ours = [(OK if is_taken else BAD_SIGNATURE, ticks) for is_taken, ticks in taken]
    assert ours == verdicts(library, frames)
