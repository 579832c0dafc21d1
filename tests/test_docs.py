"""What the pages name is there: files, headings, keys, commands with their options."""

import re
import shlex
from itertools import pairwise
from pathlib import Path

import msgspec
import pytest
import yaml

from risaf_link.cli import main
from risaf_link.config import Config, load

ROOT = Path(__file__).parents[1]
PAGES = sorted(ROOT.glob("docs/*.md"))
TEXTS = [*PAGES, *(ROOT / name for name in ("README.md", "benchmarks/README.md"))]
LINK = re.compile(r"\]\((?!\w+:)([^)#\s]*)(?:#([^)\s]+))?\)")
KEY = re.compile(
    r"`((?:array|gps|fusion|heading|attitude|mavlink|state|mqtt|metrics)\.(?!json|py)[a-z_]+)`"
)


def per_page(pages):
    return pytest.mark.parametrize("page", pages, ids=lambda page: str(page.relative_to(ROOT)))


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(), re.DOTALL | re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """Of a page's headings, as the forge makes them."""
    prose = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.*)$", prose, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", text.lower()).replace(" ", "-") for text in headings}


def leaves(tree: object) -> set[str]:
    """Paths of all keys in a tree."""
    if not isinstance(tree, dict):
        return set()
    return {
        name for key in tree for name in (key, *(f"{key}.{leaf}" for leaf in leaves(tree[key])))
    }


@per_page(TEXTS)
def test_every_link_leads_somewhere(page):
    for path, anchor in LINK.findall(page.read_text()):
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), path
        assert not anchor or anchor in anchors(target), f"{path}#{anchor}"


@per_page(PAGES)
def test_every_configuration_that_is_shown_loads(page, tmp_path):
    for text in blocks(page, "yaml"):
        content = yaml.safe_load(text)
        if isinstance(content, dict) and set(content) <= set(Config.__struct_fields__):
            shown = tmp_path / "shown.yaml"
            shown.write_text(text)
            load(shown)


@per_page(TEXTS)
def test_every_key_that_is_named_is_one(page):
    keys = leaves(msgspec.to_builtins(Config()))
    assert {key for key in KEY.findall(page.read_text()) if key not in keys} == set()


@per_page(TEXTS)
def test_every_command_that_is_shown_has_its_options(page):
    for line in "\n".join(blocks(page, "sh")).replace("\\\n", " ").splitlines():
        name, *words = shlex.split(line.removeprefix("sudo "), comments=True) or [""]
        if Path(name).name != "risaf-link" or not words or words[0].startswith("-"):
            continue
        options = {opt for param in main.commands[words[0]].params for opt in param.opts}
        assert {word for word in words if word.startswith("-")} <= options, line
        load(None, [value for option, value in pairwise(words) if option == "--set"])
