"""What is released: one version, a changelog that tells of it, a pinned environment."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import risaf_link

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CHANGELOG = (ROOT / "CHANGELOG.md").read_text()
PINS = (ROOT / "packaging" / "requirements.txt").read_text().replace("\\\n", "")
PINNED_EXTRAS = ("fast", "mcap", "metrics", "monitor", "plot")
SECTIONS = ["Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"]
RELEASE = re.compile(r"## \[(\d+\.\d+\.\d+)\] - (Unreleased|\d{4}-\d\d-\d\d)")


def test_the_version_stands_in_the_package_alone():
    assert "version" not in PROJECT
    assert PROJECT["dynamic"] == ["version"]


def test_the_changelog_tells_of_this_version_first():
    headings = [line for line in CHANGELOG.splitlines() if line.startswith("## ")]
    releases = [RELEASE.fullmatch(heading) for heading in headings]
    assert all(releases), f"found {headings}, expected keepachangelog.com's form"
    assert releases[0][1] == risaf_link.__version__
    versions = [Version(release[1]) for release in releases]
    assert versions == sorted(set(versions), reverse=True)
    assert "Unreleased" not in [release[2] for release in releases[1:]]


def test_the_changelog_has_the_sections_that_tools_know():
    for release in re.split(r"(?m)^## ", CHANGELOG)[1:]:
        sections = re.findall(r"(?m)^### (.*)$", release)
        assert sections == [section for section in SECTIONS if section in sections]
        assert release.splitlines()[2].startswith("### ")


def pins() -> list[tuple[Requirement, str]]:
    lines = [line.strip() for line in PINS.splitlines() if not line.startswith("#")]
    return [(Requirement(line.partition("--hash")[0]), line) for line in lines if line]


def test_every_pin_is_one_version_with_its_hashes():
    for pin, line in pins():
        assert re.fullmatch(r"==[0-9.]+", str(pin.specifier)), line
        hashes = re.findall(r"--hash=sha256:[0-9a-f]{64}(?= |$)", line)
        assert len(hashes) == line.count("--hash") >= 1


@pytest.mark.parametrize("python", ["3.11", "3.12", "3.13", "3.14"])
def test_what_the_package_needs_is_pinned_within_its_bounds(python):
    there = {"python_full_version": f"{python}.0", "python_version": python}
    found = {
        canonicalize_name(pin.name): str(pin.specifier).removeprefix("==")
        for pin, _ in pins()
        if pin.marker is None or pin.marker.evaluate(there)
    }
    extras = PROJECT["optional-dependencies"]
    needed = [*PROJECT["dependencies"], *(line for name in PINNED_EXTRAS for line in extras[name])]
    for requirement in map(Requirement, needed):
        assert requirement.specifier.contains(found[canonicalize_name(requirement.name)])
