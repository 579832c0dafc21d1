"""Every test that docs/faults.md names is there, and every fault has one."""

import ast
import re
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
PAGE = TESTS.parent / "docs" / "faults.md"
NAME = re.compile(r"`(test_\w+)::((?:Test\w+::)?test_\w+)`")
ROWS = [line for line in PAGE.read_text().splitlines() if re.match(r"\| (?!fault \|)", line)]


def names_in(file: str) -> set[str]:
    """Names of the tests of a file, as the page writes them."""
    found = set()
    for node in ast.parse((TESTS / f"{file}.py").read_text()).body:
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}::{part.name}" for part in node.body if hasattr(part, "name")}
        elif hasattr(node, "name"):
            found.add(node.name)
    return found


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[2:40])
def test_a_fault_is_proven_by_tests_that_are_there(row):
    _, fault, does, seen, proof, _ = map(str.strip, re.split(r"(?<!\\)\|", row))
    assert fault
    assert does
    assert seen
    named = NAME.findall(proof)
    assert named
    assert ", ".join(f"`{file}::{test}`" for file, test in named) == proof
    for file, test in named:
        assert test in names_in(file)


def test_the_table_is_read():
    assert len(ROWS) > 50
