"""What is installed can be undone, and what the user has changed is the user's."""

import shutil
import subprocess
from pathlib import Path

import pytest
from click.testing import CliRunner

from risaf_link.cli import main
from risaf_link.config import load
from risaf_link.install import CONFIGURATION, NOTED, RULES, SCRIPT, UNIT, WANTED

PROGRAM = "/opt/risaf_link/bin/risaf-link"
PACKAGING = Path(__file__).parents[1] / "packaging"
INITS = {"systemd": {UNIT, WANTED}, "script": {SCRIPT}}
EVERYWHERE = {RULES, CONFIGURATION, NOTED}


def ask(command, root, *options):
    result = CliRunner().invoke(main, [command, "--root", str(root), *options])
    return result.exit_code, result.output


def install(root, init="systemd", program=PROGRAM):
    return ask("install", root, "--init", init, "--program", program)


def files(root):
    found = [path for path in root.rglob("*") if path.is_symlink() or path.is_file()]
    return {path.relative_to(root): path.is_symlink() or path.read_bytes() for path in found}


@pytest.mark.parametrize("init", INITS)
def test_it_is_installed_again_without_a_change_and_undone_without_a_trace(init, tmp_path):
    (tmp_path / "etc").mkdir()
    assert install(tmp_path, init)[0] == 0
    first = files(tmp_path)
    assert set(first) == INITS[init] | EVERYWHERE
    assert install(tmp_path, init)[0] == 0
    assert files(tmp_path) == first
    assert ask("uninstall", tmp_path)[0] == 0
    assert files(tmp_path) == {}
    assert ask("uninstall", tmp_path) == (0, "")


def test_a_changed_file_is_neither_replaced_nor_removed(tmp_path):
    install(tmp_path)
    (tmp_path / CONFIGURATION).write_text("links: []\n")
    _, said = install(tmp_path)
    assert f"kept {tmp_path / CONFIGURATION}: it has been changed" in said
    _, said = ask("uninstall", tmp_path)
    assert f"kept {tmp_path / CONFIGURATION}: it has been changed" in said
    assert files(tmp_path) == {CONFIGURATION: b"links: []\n"}


def test_a_file_that_was_there_before_is_the_user_s(tmp_path):
    (tmp_path / CONFIGURATION).parent.mkdir(parents=True)
    (tmp_path / CONFIGURATION).write_text("links: []\n")
    install(tmp_path)
    ask("uninstall", tmp_path)
    assert files(tmp_path) == {CONFIGURATION: b"links: []\n"}


def test_what_is_unchanged_is_brought_up_to_date(tmp_path):
    install(tmp_path)
    _, said = install(tmp_path, program="/opt/new/bin/risaf-link")
    assert f"replaced {tmp_path / UNIT}" in said
    assert "ExecStart=/opt/new/bin/risaf-link run" in (tmp_path / UNIT).read_text()


def test_what_the_vehicle_has_learnt_is_kept(tmp_path):
    install(tmp_path)
    state = tmp_path / "var/lib/risaf_link/state.json"
    state.parent.mkdir(parents=True)
    state.write_text("{}")
    _, said = ask("uninstall", tmp_path)
    assert f"kept {state.parent}" in said
    assert state.exists()


def test_systemd_is_found_in_an_image(tmp_path):
    ask("install", tmp_path, "--program", PROGRAM)
    assert (tmp_path / SCRIPT).exists()
    ask("uninstall", tmp_path)
    (tmp_path / "usr/lib/systemd").mkdir(parents=True)
    (tmp_path / "usr/lib/systemd/systemd").touch()
    ask("install", tmp_path, "--program", PROGRAM)
    assert (tmp_path / UNIT).exists()
    assert (tmp_path / WANTED).readlink() == Path("/", UNIT)


@pytest.mark.parametrize("program", ["/home/pilot/venv/bin/risaf-link", "/root/bin/risaf-link"])
def test_a_program_that_services_do_not_see_is_refused(program, tmp_path):
    status, said = install(tmp_path, program=program)
    assert status == 2
    assert said.startswith(f"risaf-link: {program}: found a program in a place")
    assert files(tmp_path) == {}


def test_a_place_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "etc").write_text("not a directory")
    status, said = install(tmp_path)
    assert (status, said.count("\n")) == (2, 1)


def test_the_configuration_that_is_installed_can_be_loaded(tmp_path):
    install(tmp_path)
    assert load(tmp_path / CONFIGURATION).state.file == "/var/lib/risaf_link/state.json"


def test_the_script_is_one_that_a_shell_reads(tmp_path):
    install(tmp_path, "script")
    script = tmp_path / SCRIPT
    assert script.stat().st_mode & 0o777 == 0o755
    assert PROGRAM in script.read_text()
    subprocess.run(["/bin/sh", "-n", script], check=True)


def test_systemd_finds_no_fault_in_the_unit_and_little_exposure(tmp_path):
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        pytest.skip("no systemd-analyze: apt-get install systemd")
    unit = tmp_path / UNIT.name
    text = (PACKAGING / "risaf-link.service").read_text()
    unit.write_text(text.replace("@RISAF_LINK@", shutil.which("true")))
    verified = subprocess.run([analyze, "verify", unit], capture_output=True, text=True, check=True)
    assert verified.stderr == ""
    security = [analyze, "security", "--offline=true", "--threshold=15", unit]
    subprocess.run(security, capture_output=True, check=True)
