"""Imports point one way."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "risaf_link"
LAYERS = [
    {"errors", "document"},
    {"private", "parent", "address", "whole", "loop"},
    {"core"},
    {"mavlink"},
    {"pipeline"},
    {"links", "publish", "sim"},
    {"config", "sweep"},
    {"kept"},
    {"keys", "remembered", "supervisor", "install", "gibberish"},
    {"gate", "prompt"},
    {"service", "replay", "survey", "calibrate", "experiments", "monitor"},
    {"fleet", "words", "bench", "demo"},
    {"judgement"},
    {"report"},
    {"cli"},
]
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}
MODULES = [
    path for path in sorted(PACKAGE.rglob("*.py")) if path.parent != PACKAGE or path.stem in LEVEL
]


def imported(path: Path) -> set[str]:
    """First part below the package of everything that a module imports from it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module)
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return {name.split(".")[1] for name in names if name.startswith("risaf_link.")}


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_down(path):
    own = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    above = {n for n in imported(path) if n != own and LEVEL[n] >= LEVEL[own] and n != "__init__"}
    assert not above


@pytest.mark.parametrize(
    "path", sorted((PACKAGE / "core").glob("*.py")), ids=lambda path: path.stem
)
def test_core_reads_no_clock_and_no_file(path):
    tree = ast.parse(path.read_text())
    names = {alias.name for n in ast.walk(tree) if isinstance(n, ast.Import) for alias in n.names}
    names |= {n.module or "" for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    assert not names & {"time", "datetime", "logging", "asyncio", "pathlib", "os", "io", "socket"}
