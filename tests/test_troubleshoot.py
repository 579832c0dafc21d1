"""The page by symptom explains every line that the service tells, and none that it does not."""

import ast
import re
from pathlib import Path

import pytest

from risaf_link.mavlink.peers import UNFED

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "troubleshoot.md").read_text()
SOURCES = [path for path in (ROOT / "risaf_link").rglob("*.py") if path.name != "risaf.py"]
TREES = [ast.parse(path.read_text()) for path in SOURCES]
CALLS = [node for tree in TREES for node in ast.walk(tree) if isinstance(node, ast.Call)]


def pattern(text: ast.expr) -> str:
    """What a literal may become: of an f-string's fields and of %s, anything."""
    if isinstance(text, ast.JoinedStr):
        return "".join(map(pattern, text.values))
    if isinstance(text, ast.Constant) and isinstance(text.value, str):
        return ".+".join(map(re.escape, re.split(r"%(?:\.\d+)?[srd]", text.value)))
    return ".+"


def told(*functions: str, argument: int = 0) -> set[str]:
    """Texts that calls of these functions, or methods, are given; all but those made elsewhere."""
    patterns = {
        pattern(call.args[argument])
        for call in CALLS
        if getattr(call.func, "attr", getattr(call.func, "id", "")) in functions
        and len(call.args) > argument
    }
    return {text for text in patterns if re.search(r"[a-z]{3}", text)}


STATUSTEXTS = told("Notice", argument=1)
WARNINGS = told("warning", "error", "exception") | told("log", argument=1)
RECALLED = {text for text in told("Verdict", "_give_up") if text.startswith("state")}
CALIBRATION = {f"gyro calibration {text}" for text in told("end")}
OTHERS = {  # put together
    *(r"gyro bias .+ deg/s", r"warm start: .+ ago", r"recording .+: .+ bytes are free"),
    re.escape(f"ODOMETRY: {UNFED}"),
}


def explained(section: str) -> list[str]:
    """Lines in the first column of a section's table."""
    text = PAGE.partition(f"\n## {section}\n")[2].partition("\n## ")[0]
    rows = text.partition("| line |")[2].splitlines()[2:]
    return [line for row in rows for line in re.findall(r"`([^`]+)`", row.split(" | ")[0])]


@pytest.mark.parametrize(
    ("section", "templates"),
    [
        ("What STATUSTEXT says", STATUSTEXTS | CALIBRATION),
        ("What the log says", WARNINGS),
        ("A restart began cold", RECALLED),
    ],
)
def test_every_line_that_is_told_is_explained(section, templates):
    lines = explained(section)
    assert len(templates) > 2
    unexplained = {t for t in templates if not any(re.fullmatch(t, line) for line in lines)}
    assert unexplained == set()


@pytest.mark.parametrize(
    "section", ["What STATUSTEXT says", "What the log says", "A restart began cold"]
)
def test_every_line_that_is_explained_is_told(section):
    templates = STATUSTEXTS | CALIBRATION | WARNINGS | RECALLED | OTHERS
    lines = explained(section)
    assert len(lines) > 5
    assert [line for line in lines if not any(re.fullmatch(t, line) for t in templates)] == []
