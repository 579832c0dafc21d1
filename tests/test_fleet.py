"""Many logs at once: what comes out is what each gives alone."""

import json
import os
from pathlib import Path

import pytest
from command import call
from logs import simulated, timeless

from risaf_link.config import Config, load
from risaf_link.errors import ConfigError
from risaf_link.fleet import names, replay_all
from risaf_link.publish.rows import RowWriter
from risaf_link.replay import Selection
from risaf_link.sweep import execute
from risaf_link.words import fleet_text

SELECTION = Selection(outages=((3.0, 6.0),))


@pytest.fixture
def logs(tmp_path):
    """Two vehicles' logs of the same name, and one of another."""
    small = {"duration": 6.0, "sensors": 5}
    paths = tmp_path / "a" / "drive.tlog", tmp_path / "b" / "drive.tlog", tmp_path / "other.tlog"
    return [simulated(path, seed=seed, **small) for seed, path in enumerate(paths)]


@pytest.fixture
def ran(monkeypatch):
    """Replay in this process; the names of the logs that were replayed, in their order."""
    names = []

    def on_cores(cases, _):
        for case in cases:
            names.append(case.name)
            yield case, execute(case)

    monkeypatch.setattr("risaf_link.sweep._on_cores", on_cores)
    return names


@pytest.mark.parametrize("workers", [1, 2])
def test_every_log_gives_what_it_gives_alone(tmp_path, logs, workers):
    tables = tmp_path / "tables"
    options = "--outage", "3:6", "--json", "--set", "fusion.method=risaf"
    told = call("replay", *logs, *options, "--csv", tables, "--workers", workers)
    assert told.exit_code == 0, told.output
    rows = json.loads(told.stdout)
    assert [row["log"] for row in rows] == [str(log) for log in logs]
    for row, log, name in zip(rows, logs, ("a_drive", "b_drive", "other"), strict=True):
        alone = call("replay", log, *options, "--csv", tmp_path / "alone.csv")
        assert timeless([row]) == timeless([{"log": str(log), **json.loads(alone.stdout)}])
        assert (tables / f"{name}.csv").read_bytes() == (tmp_path / "alone.csv").read_bytes()


@pytest.mark.usefixtures("ran")
def test_a_log_that_cannot_be_used_costs_only_itself(tmp_path, logs):
    zeros = tmp_path / "zeros.tlog"
    zeros.write_bytes(bytes(10_000))
    given = [logs[0], zeros, tmp_path / "none.tlog", tmp_path, logs[1]]
    result = call("replay", *given)
    assert result.exit_code == 3
    assert result.stderr == "risaf-link: 3 of 5 logs gave nothing\n"
    _, first, *unusable, last, _ = result.stdout.splitlines()
    whys = "found no MAVLink frame, expected a tlog", "No such file or directory", "Is a directory"
    for line, log, why in zip(unusable, given[1:4], whys, strict=True):
        assert line.split(maxsplit=1) == [str(log), why]
    assert (first.split()[0], last.split()[0]) == (str(logs[0]), str(logs[1]))
    rows = json.loads(call("replay", *given, "--json").stdout)
    assert ["error" in row for row in rows] == [False, True, True, True, False]


@pytest.mark.usefixtures("ran")
def test_a_fault_of_the_program_costs_only_its_log(tmp_path, logs, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError("in row\n1")

    monkeypatch.setattr(RowWriter, "write", fail)
    rows = replay_all(logs[:1], Config(), SELECTION, csv=tmp_path / "out")
    assert rows == [{"log": str(logs[0]), "error": "ZeroDivisionError: in row 1"}]
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["cases"]


@pytest.mark.usefixtures("ran")
def test_a_log_that_is_given_twice_is_replayed_once(logs, monkeypatch, ran):
    monkeypatch.chdir(logs[0].parent)
    rows = replay_all([Path("drive.tlog"), logs[0]], Config(), SELECTION)
    assert [row.pop("log") for row in rows] == ["drive.tlog", str(logs[0])]
    assert rows[0] == rows[1]
    assert ran == ["drive"]


def test_what_is_finished_is_not_done_again_until_something_changes(tmp_path, logs, ran):
    out = tmp_path / "out"

    def again(*settings, selection=SELECTION):
        ran.clear()
        rows = replay_all(logs, load(None, settings), selection, csv=out)
        return rows, set(ran)

    first, done = again()
    everything = {"a_drive", "b_drive", "other"}
    assert done == everything
    assert again() == (first, set())
    os.utime(logs[0], ns=(0, 1))
    assert again()[1] == {"a_drive"}
    (out / "other.csv").unlink()
    assert again()[1] == {"other"}
    assert again("fusion.method=mean")[1] == everything
    rows, done = again()
    assert (timeless(rows), done) == (timeless(first), everything)
    assert again(selection=Selection())[1] == everything
    assert len(list((out / "cases").iterdir())) == len(logs)


def test_a_calibration_that_changes_is_another_one(tmp_path, logs, monkeypatch, ran):
    monkeypatch.chdir(tmp_path)
    config = load(None, ["array.calibration=calibration.yaml"])
    for bias in (0.0, 0.1):
        Path("calibration.yaml").write_text(
            f"gyros: [{{bias: [{bias}, 0, 0]}}, {{}}, {{}}, {{}}, {{}}]"
        )
        replay_all(logs, config, SELECTION, csv=Path("out"))
    assert len(ran) == 2 * len(logs)


def test_a_result_of_another_configuration_does_not_stay_when_a_log_is_gone(tmp_path, logs, ran):
    out = tmp_path / "out"
    replay_all(logs, Config(), SELECTION, csv=out)
    logs[0].unlink()
    replay_all(logs, Config(), SELECTION, csv=out)
    assert not (out / "a_drive.csv").exists()
    assert (out / "b_drive.csv").exists()
    assert ran[3:] == ["a_drive"]


def test_the_largest_log_is_the_first_to_start(tmp_path, ran):
    sizes = {"short": 2.0, "long": 6.0, "middle": 4.0}
    for name, duration in sizes.items():
        simulated(tmp_path / f"{name}.tlog", duration, sensors=3)
    logs = [tmp_path / f"{name}.tlog" for name in sizes]
    rows = replay_all(logs, Config(), Selection())
    assert ran == ["long", "middle", "short"]
    assert [row["log"] for row in rows] == [str(log) for log in logs]


def test_names_take_as_many_directories_as_tell_logs_apart():
    given = ["/n/a/1/x.tlog", "/n/b/1/x.tlog", "/n/b/2/x.tlog", "/n/b/y.tlog", "/n/z.tlog.raw"]
    assert names([Path(log) for log in given]) == ["a_1_x", "b_1_x", "2_x", "y", "z.tlog"]


def test_names_are_different_whatever_the_logs_are_called():
    given = ["/x.tlog", "/x.raw", "/a_b.tlog", "/a/b.tlog", "/c/b.tlog", "/"]
    found = names([Path(log) for log in given])
    assert len(set(found)) == len(given)
    assert found[4] == "c_b"


@pytest.mark.parametrize(
    "option",
    [
        ("--speed", "2"),
        ("--out", "x.tlog"),
        ("--plot", "x.png"),
        ("--report", "x"),
        ("--mcap", "x"),
    ],
)
def test_what_is_for_one_log_is_refused_for_many(logs, option):
    result = call("replay", *logs, *option)
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
    assert f"{option[0]}: only for one log" in result.stderr


def test_the_directory_of_tables_cannot_be_a_file(tmp_path, logs):
    (tmp_path / "out.csv").write_text("")
    with pytest.raises(ConfigError, match="found a file, expected a directory"):
        replay_all(logs, Config(), SELECTION, csv=tmp_path / "out.csv")


def test_a_calibration_that_cannot_be_read_is_told_before_anything_is_replayed(logs):
    result = call("replay", *logs, "--set", "array.calibration=none.yaml")
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
    assert "none.yaml: No such file" in result.stderr


def test_a_line_shows_each_outage_against_truth_or_else_against_gps():
    def outage(start, reference, rmse):
        return {"start_s": start, "end_s": start + 5, "reference": reference, "rmse_deg": rmse}

    row = {
        "log": "a.tlog",
        "duration_s": 60.0,
        "epochs": 600,
        "sensors": 3,
        "heading": {"fused": 5, "rejected": 1},
        "realtime_factor": 99.6,
        "truth": {"rmse_deg": None},
        "outages": [outage(0, "gps", 1.0), outage(0, "truth", 2.0), outage(9, "gps", 3.0)],
    }
    row["outages"] += [outage(20, None, None), outage(30, "gps", 4.0)]
    line = fleet_text([row]).splitlines()[1]
    expected = "a.tlog 60.0 600 3 5 1 100 - 2.00, 3.00 (GPS), - and 1 more"
    assert line.split() == expected.split()
