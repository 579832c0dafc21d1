"""What docs/threats.md says of listening and of reading, held against the code."""

import ast
from pathlib import Path

import click
import pytest
import yaml

from risaf_link.cli import main
from risaf_link.config import Config, load
from risaf_link.mavlink.allowance import Allowance

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "risaf_link").rglob("*.py"))
LISTENING = ("udpin://", "tcpin://")


@pytest.mark.parametrize("file", [None, "config/risaf_link.yaml", "packaging/vehicle.yaml"])
def test_what_nobody_configured_is_reached_from_this_computer_alone(file):
    config = load(ROOT / file) if file else Config()
    places = [link.url for link in config.links if link.url.startswith(LISTENING)]
    assert places
    assert all(place.split("://")[1].startswith("127.0.0.1:") for place in places)
    assert (config.metrics.listen, config.mqtt.url) == ("", "")


def test_pages_are_served_to_this_computer_by_default():
    defaults = {
        name: option.default
        for name, command in main.commands.items()
        for option in command.params
        if isinstance(option, click.Option) and option.name == "listen"
    }
    assert defaults == dict.fromkeys(["monitor", "demo"], "127.0.0.1:8765")


def test_a_link_that_listens_says_where():
    for url in ("udpin://:14550", "udpin://14550", "tcpin://:5760"):
        with pytest.raises(Exception, match="expected"):
            load(None, [f"links=[{yaml.safe_dump({'name': 'a', 'url': url}).strip()}]"])


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_nothing_is_read_that_can_run(path):
    tree = ast.parse(path.read_text())
    imported = {
        alias.name for n in ast.walk(tree) if isinstance(n, ast.Import) for alias in n.names
    }
    imported |= {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.module}
    assert not imported & {"pickle", "marshal", "shelve", "dill", "cloudpickle"}
    called = {
        ast.unparse(node.func)
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute | ast.Name)
    }
    assert not called & {"eval", "yaml.load", "yaml.unsafe_load", "yaml.full_load", "np.load"}


def test_an_allowance_gives_so_much_at_once_and_so_much_a_second():
    allowance = Allowance(rate=10.0, most=3.0)
    assert [allowance.takes(1.0, 5.0) for _ in range(4)] == [True, True, True, False]
    assert allowance.takes(1.0, 5.125)
    assert not allowance.takes(1.0, 5.15)
    assert not allowance.takes(1.0, 4.0)  # a clock that goes back gives nothing
    assert [allowance.takes(1.0, 60.0) for _ in range(4)] == [True, True, True, False]


def test_what_is_charged_beyond_an_allowance_has_to_be_waited_for():
    allowance = Allowance(rate=10.0, most=5.0)
    assert allowance.charge(5.0, 1.0) == 0.0
    assert allowance.charge(2.0, 1.0) == pytest.approx(0.2)
    assert allowance.charge(0.0, 1.1) == pytest.approx(0.1)
    assert allowance.charge(0.0, 1.3) == 0.0
