"""Experiments: sweeps that can be stopped, Allan deviation, and what is left behind."""

import csv
import json
import math
import os
import re
import signal
import subprocess
import sys
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from command import call
from msgspec import Struct

from risaf_link.errors import ConfigError, RisafError
from risaf_link.experiments import drives
from risaf_link.experiments.allan import allan_deviation, coefficients
from risaf_link.experiments.case import Case
from risaf_link.experiments.cost import Timing, exponent
from risaf_link.experiments.report import Section, Setting, page, rmses, spread
from risaf_link.experiments.run import EXPERIMENTS
from risaf_link.sweep import Sweep


def cases(seeds=3):
    return [
        Case("circle", seed, ("mean", "ours"), ((2.0, 4.0),), duration=4.0, sensors=5)
        for seed in range(seeds)
    ]


class Endless(Struct, frozen=True):
    """A case that says that it runs, and never ends."""

    key: str = "endless"

    def run(self):
        print("running", flush=True)
        signal.pause()


class Deadly(Struct, frozen=True):
    """A case that kills its worker."""

    key: str = "deadly"

    def run(self):
        os._exit(1)


def test_numbers_do_not_depend_on_the_number_of_workers(tmp_path):
    one = Sweep(tmp_path / "one", workers=1).run(cases(), "")
    two = Sweep(tmp_path / "two", workers=2).run(cases(), "")
    assert one == two
    assert one == [case.run() for case in cases()]


def test_what_is_done_is_not_done_again(tmp_path):
    sweep = Sweep(tmp_path, workers=1)
    first = sweep.run(cases(2), "")
    for path in tmp_path.glob("circle-0-*.json"):
        path.write_text('{"from": "disk"}')
    second = sweep.run(cases(2), "")
    assert second == [{"from": "disk"}, first[1]]


def test_other_parameters_are_another_case():
    keys = {
        Case("circle", 1, ("mean",), ()).key,
        Case("circle", 2, ("mean",), ()).key,
        Case("circle", 1, ("ours",), ()).key,
        Case("circle", 1, ("mean",), (), spikes=0.1).key,
        Case("circle", 1, ("mean",), (), own=(("a", "x = 1"),)).key,
        Case("circle", 1, ("mean",), (), own=(("a", "x = 2"),)).key,
    }
    assert len(keys) == 6


def test_workers_end_with_a_sweep_that_is_killed(tmp_path):
    code = (
        "import sys; from pathlib import Path; from test_experiments import Endless; "
        "from risaf_link.sweep import Sweep; Sweep(Path(sys.argv[1]), 1).run([Endless()], '')"
    )
    here = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", code, str(tmp_path)]
    with subprocess.Popen(command, env=here, stdout=subprocess.PIPE, text=True) as sweep:
        assert sweep.stdout.readline() == "running\n"
        sweep.kill()
        assert not sweep.stdout.read()  # the worker had the pipe open as well


@pytest.mark.parametrize("workers", [1, 2])
def test_a_case_that_kills_its_workers_is_told_and_costs_only_itself(tmp_path, workers):
    work = [Deadly(), *cases(3)]

    def told(case, error):
        return {"key": case.key, "error": str(error)}

    lost, *others = Sweep(tmp_path, workers).run(work, "", failed=told)
    assert lost["key"] == "deadly"
    assert "every worker process that ran it died" in lost["error"]
    assert others == [case.run() for case in cases(3)]
    with pytest.raises(RisafError, match="deadly: every worker process that ran it died"):
        Sweep(tmp_path, workers).run(work, "")
    assert len(list(tmp_path.glob("*.json"))) == 3


def test_white_noise_is_read_off_as_angle_random_walk():
    noise = np.random.default_rng(0).standard_normal((100_000, 4))
    times, deviations = allan_deviation(0.1 * noise, 0.01)
    np.testing.assert_allclose(deviations[:10].mean(axis=1) * np.sqrt(times[:10]), 0.01, rtol=0.03)
    found = coefficients(times, deviations.mean(axis=1))
    assert found.arw == pytest.approx(0.01, rel=0.03)


def test_a_rate_that_walks_is_read_off_as_such():
    walk = np.cumsum(np.random.default_rng(0).standard_normal((100_000, 4)), axis=0) * 0.1
    times, deviations = allan_deviation(walk, 0.01)
    one = np.searchsorted(times, 10.0)
    expected = np.sqrt(times[one] / 3.0)
    assert deviations[one].mean() == pytest.approx(expected, rel=0.1)
    found = coefficients(times, np.sqrt((deviations**2).mean(axis=1)))
    assert found.rate_random_walk == pytest.approx(1.0, rel=0.1)


def test_coefficients_of_a_perfect_curve_are_exact():
    times = np.geomspace(0.01, 1000, 30)
    variance = 4e-4 / times + 2 * math.log(2) / math.pi * 9e-4 + 1e-6 * times / 3
    found = coefficients(times, np.sqrt(variance))
    np.testing.assert_allclose(found, (2e-2, 3e-2, 1e-3), rtol=1e-6)
    white = coefficients(times, np.sqrt(4e-4 / times))
    assert white.arw == pytest.approx(2e-2)
    for other in white[1:]:
        assert math.isnan(other) or other < 1e-8


def test_an_exponent_is_that_of_the_growth():
    sensors = np.array([3.0, 10.0, 30.0, 100.0, 300.0, 1000.0])
    cubic = 1e-9 * sensors**3
    assert exponent(sensors, cubic) == pytest.approx(3.0, abs=0.01)
    assert exponent(sensors, 1e-4 + 1e-6 * sensors) == pytest.approx(1.0, abs=0.03)
    held_up = np.array([5e-4, *(1e-4 + 1e-6 * sensors[1:])])  # by something else, at the smallest
    assert exponent(sensors, held_up) == pytest.approx(1.0, abs=0.05)
    assert math.isnan(exponent(sensors, np.full(6, 1e-4)))


def test_a_method_that_is_too_slow_is_stopped():
    row = Timing("mean", (3, 10, 30), limit=0.0, spent=0.0).run()
    assert row["sensors"] == [3]
    assert len(row["seconds"]) == 1


def test_a_run_without_a_heading_is_the_worst():
    assert spread([1.0, math.nan, 2.0, 3.0, 4.0])[0] == 3.0
    result = {"methods": {"a": {"outages": [{"truth": None}]}}}
    assert math.isnan(rmses([result], "a")[0])


def test_the_page_shows_figures_numbers_and_what_the_paper_says(tmp_path):
    section = Section(
        "drive1", "Drive I", "We drove.", "2.6 times.", ["method", "deg"], [("a", math.nan)], {}
    )
    text = page(Setting(tmp_path, Sweep(tmp_path)), [section]).read_text()
    assert "![Drive I](drive1.png)" in text
    assert "*The paper:* 2.6 times." in text
    assert "| a |  |" in text
    assert "[drive1.csv](drive1.csv)" in text


@pytest.fixture
def tiny(monkeypatch):
    """Experiments at their smallest, without processes."""
    short = replace(drives.DRIVES["circle"], quick=(8.0, (4.0, 8.0)))
    monkeypatch.setitem(drives.DRIVES, "circle", short)
    monkeypatch.setattr("risaf_link.experiments.drives.QUICK_SENSORS", 4)
    monkeypatch.setattr("risaf_link.sweep._on_cores", in_process)


def in_process(cases, _):
    return ((case, msgspec.json.encode(case.run())) for case in cases)


@pytest.mark.usefixtures("tiny")
def test_a_drive_leaves_figure_numbers_seeds_and_parameters(tmp_path):
    own = tmp_path / "held.py"
    own.write_text(
        "from risaf_link.experiments.gyro_filters import MeanEkf\nclass Held(MeanEkf): pass\n"
    )
    result = call("experiment", "circle", "--quick", "--out", tmp_path, "--method", own)
    assert result.exit_code == 0, result.output
    assert (tmp_path / "circle.png").read_bytes().startswith(b"\x89PNG")
    told = json.loads((tmp_path / "circle.json").read_text())
    assert told["parameters"]["seeds"] == [0, 1]
    assert told["parameters"]["case"]["duration"] == 8.0
    assert told["rmse_deg"]["held"] == told["rmse_deg"]["mean"]
    with (tmp_path / "circle.csv").open() as file:
        rows = list(csv.reader(file))
    assert [row[0] for row in rows][-1] == "held"
    assert len(rows) == 15


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("drive3",), "'drive3', expected one of sensors"),
        (("drive1", "--method", "nowhere.py"), "nowhere.py: No such file"),
    ],
)
def test_a_mistake_is_told_in_one_line(tmp_path, arguments, told):
    result = call("experiment", *arguments, "--out", tmp_path)
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert told in result.stderr


def test_without_matplotlib_one_line_says_which_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    result = call("experiment", "drive1", "--out", tmp_path)
    assert result.exit_code == 2
    assert "install risaf-link with the extra `plot`" in result.stderr


def test_without_dask_one_line_says_which_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigError, match="the extra `cluster`"):
        Sweep(tmp_path, cluster="tcp://127.0.0.1:1").run(cases(1), "")


def test_help_names_every_experiment():
    told = call("experiment", "--help").stdout
    assert not {name for name in EXPERIMENTS if not re.search(rf"`{name}`", told)}
