"""YAML from outside ends in plain values or in one line of error, soon and in little memory."""

import os
import tracemalloc
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from risaf_link.config import load, load_calibration
from risaf_link.document import DEEPEST, LARGEST, DocumentError, parse_document, read_document
from risaf_link.errors import ConfigError
from risaf_link.kept import kept_parameters

LETTERS = "abcdefghijkl"
BILLIONS = "a: &a [0, 0, 0, 0, 0, 0, 0, 0, 0]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n" for before, name in pairwise(LETTERS)
)
HARMFUL = {
    "aliases of aliases": (BILLIONS, "found more than 100000 values, expected fewer"),
    "itself": ("a: &a [*a]", "found values more than 32 deep in one another, expected fewer"),
    "deep": ("[" * 20_000, "found values more than 32 deep in one another, expected fewer"),
    "large": ("#" * LARGEST + "\n#", "found more than 1000000 bytes, expected YAML"),
    "long number": ("a: 0x" + "f" * 5000, "found a value of more than 2048 characters"),
    "no date": ("a: 2026-99-99", "line 1: found '2026-99-99', expected one of kind timestamp"),
    "code": ("a: !!python/object/apply:os.system [x]", "could not determine a constructor"),
    "no boolean": ("a: !!bool maybe", "line 1: found 'maybe', expected one of kind bool"),
    "unhashable key": ("? [1]\n: 2", "found unhashable key"),
}


@pytest.mark.parametrize(("text", "told"), HARMFUL.values(), ids=HARMFUL)
def test_a_harmful_configuration_is_one_line_of_error(tmp_path, text, told):
    path = tmp_path / "vehicle.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as refused:
        load(path)
    message = str(refused.value)
    assert message.startswith(f"{path}: ")
    assert told in message
    assert "\n" not in message
    assert len(message) < 500


def test_aliases_are_counted_before_they_are_written_out():
    tracemalloc.start()
    with pytest.raises(DocumentError):
        parse_document(BILLIONS)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 2_000_000


def test_an_alias_that_does_no_harm_is_taken():
    assert parse_document("a: &x {k: [1]}\nb: *x") == {"a": {"k": [1]}, "b": {"k": [1]}}
    assert parse_document("[" * DEEPEST + "]" * DEEPEST) is not None


def test_a_device_is_not_read_to_its_end():
    with pytest.raises(DocumentError, match="found more than"):
        read_document(Path("/dev/zero"))


def test_harmful_parameters_that_were_kept_are_left_out(tmp_path, caplog):
    (tmp_path / "vehicle.parameters.yaml").write_text(BILLIONS)
    (tmp_path / "vehicle.yaml").touch()
    config = load(tmp_path / "vehicle.yaml")
    assert kept_parameters(config, tmp_path / "vehicle.yaml").values == {}
    assert "found more than 100000 values, expected fewer; left out" in caplog.text


def test_a_calibration_of_the_largest_array_is_read(tmp_path):
    one = "  - {bias: [0.0123456, -0.0234567, 0.0], scale: [1.002, 0.998, 1.0], "
    one += "misalignment: [0.001, 0, 0, 0, 0, 0.002], mounting: [0.5, 0.5, 0.5, 0.5]}\n"
    path = tmp_path / "board.yaml"
    path.write_text("name: board-7\ngyros:\n" + one * 1024 + "accels:\n" + one * 1024)
    calibration = load_calibration(load(None, [f"array.calibration={path}"]))
    assert calibration is not None
    assert len(calibration.gyros) == 1024


@given(st.text(alphabet=st.sampled_from("abc01:-?,[]{}&*!|>'\"%@#<=~. \n\t"), max_size=60))
def test_any_text_is_a_document_or_a_typed_error(text):
    with suppress(DocumentError):
        parse_document(text)


def test_a_key_put_where_its_file_belongs_is_not_repeated():
    secret = os.urandom(32).hex()
    link = f"{{name: a, url: 'udpin://127.0.0.1:0', signing: {{key: {secret!r}}}}}"
    with pytest.raises(ConfigError) as refused:
        load(None, [f"links=[{link}]"])
    assert str(refused.value) == (
        "links.0.signing.key: found 64 hexadecimal digits, expected the name of a file with them"
    )
