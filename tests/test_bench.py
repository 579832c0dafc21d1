"""The benchmark, as short as it can be: that it measures, not how fast anything is."""

import json

import pytest
from click.testing import CliRunner
from rich.console import Console

from risaf_link import bench
from risaf_link.bench.extent import Extent
from risaf_link.bench.feed import bursts
from risaf_link.bench.figure import Figure, Spread
from risaf_link.bench.machine import machine
from risaf_link.bench.table import as_object, show
from risaf_link.cli import main
from risaf_link.cli.trials import GROUPS
from risaf_link.core.kernel import BUILT
from risaf_link.mavlink.frame import FrameParser
from risaf_link.pipeline import Pipeline, PipelineParameters
from risaf_link.sim.scenario import scenario

LEAST = Extent(
    repeats=1,
    runs=1,
    epoch_s=0.2,
    replay_s=2.0,
    rival_s=0.2,
    mixed_frames=200,
    rival_frames=20,
    live_s=0.3,
    fast_s=0.3,
    fast_rate=50.0,
)
KEYS = {
    "limits": {"limit_copy", "limit_checksum", "limit_sort_150", "limit_select_300"},
    "epoch": {
        *(f"epoch_{n}_{m}_inside" for n in (150, 300) for m in ("mean", "median", "risaf")),
        *("epoch_150_robust_inside", "epoch_300_robust_inside", "epoch_150_both_robust_inside"),
        *("filter_gyro", "filter_inside", "filter_called"),
    },
    "replay": {f"replay_{m}_{k}" for m in ("mean", "risaf", "robust") for k in ("inside", "whole")},
    "log": {"mixed_pymavlink", "mixed_fasttlogparser"},
    "live": {
        *("live_p50", "live_p99", "live_core", "live_lost", "live_memory", "live_uvloop_p99"),
        *("fast_lost", "fast_growth", "fast_core", "fast_p99", "limit_live_p50"),
    },
    "start": {"start", "help"},
}


@pytest.mark.parametrize("group", GROUPS)
def test_a_group_gives_all_its_figures_as_json_and_as_a_table(group):
    figures = list(bench.bench(LEAST, [group]))
    printed = json.loads(json.dumps(as_object(machine(), figures)))
    assert set(printed["figures"]) >= KEYS[group]
    assert len(printed["figures"]) == len(figures)
    for key in KEYS[group]:
        figure = printed["figures"][key]
        assert figure["ours"] is not None or figure["note"]
    lost = {k: f["ours"]["median"] for k, f in printed["figures"].items() if k.endswith("_lost")}
    assert not any(lost.values())
    console = Console(width=200, record=True, quiet=True)
    show(machine(), figures, console)


def test_a_scenario_that_starts_again_goes_on_in_time_and_number():
    parser = FrameParser()
    pipeline = Pipeline(PipelineParameters(), (1, 191))
    short = scenario("circle", 1, sensors=90, rate=100.0, duration=0.5)
    estimates = [
        estimate
        for burst in bursts(short, 1.8)
        for raw in burst.frames
        for frame in parser.receive_data(raw)
        for estimate in pipeline.step(frame, 0)
    ]
    counts = pipeline.assembler.counts
    assert (counts["epochs"], counts["incomplete"], counts["samples_lost"]) == (180, 0, 0)
    assert counts.keys() <= {"epochs", "incomplete", "samples_lost", "size_changes"}
    assert estimates[-1].elapsed == pytest.approx(1.79)
    assert not parser.dropped


def test_a_ratio_is_how_many_times_better():
    fast, slow = Spread(2.0, 1.0, 3.0), Spread(10.0, 9.0, 11.0)
    assert Figure("a", "time", "us", fast, "b", slow).ratio == 5.0
    assert Figure("a", "speed", "MB/s", slow, "b", fast, more_is_better=True).ratio == 5.0
    assert Figure("a", "time", "us", fast, "b").ratio is None


def test_a_goal_is_reached_on_its_side():
    value = Spread(2.0, 1.0, 3.0)
    assert Figure("a", "time", "us", value, goal=2.5).reached
    assert not Figure("a", "speed", "MB/s", value, goal=2.5, more_is_better=True).reached
    assert Figure("a", "time", "us", value).reached is None


def test_the_command_prints_one_json_object():
    result = CliRunner().invoke(main, ["bench", "--quick", "--only", "start", "--json"])
    printed = json.loads(result.stdout)
    assert printed["machine"]["kernel"] is BUILT
    assert set(printed["figures"]) == KEYS["start"]
