"""Parameters that change while the estimator runs: in force from the next epoch, nothing lost."""

import numpy as np
import pytest
import yaml
from msgspec import structs
from vehicle import Vehicle

from risaf_link.config import Config, load
from risaf_link.core import fusion, kernel, robust
from risaf_link.core.attitude import AttitudeParameters
from risaf_link.core.estimator import Estimator
from risaf_link.core.fusion import Epoch, FusedRate, FusionParameters
from risaf_link.core.heading import HeadingParameters, HeadingState
from risaf_link.core.zeroing import Zeroed, Zeroing
from risaf_link.kept import kept_parameters
from risaf_link.pipeline import Pipeline

OWN = (1, 191)
OTHERS = FusionParameters(
    gate=2.5, bias_time=20.0, hold_time=0.5, resolution=1e-4, scale_error=0.01, alpha=0.9,
    lower_quantile=0.3, upper_quantile=0.6, gyro_noise=1e-3, bias_walk=1e-5,
)  # fmt: skip


def epochs(count: int, sensors: int = 12) -> list[Epoch]:
    generator = np.random.default_rng(3)
    bias = generator.normal(0, 0.01, (sensors, 3))
    rates = bias + generator.normal(0, 1e-3, (count, sensors, 3))
    rates[::7, 2] += 0.5  # a sensor that is shocked now and then
    return [
        Epoch(k * 10_000, 0.01 if k else 0.0, row, np.zeros((0, 3)), 0)
        for k, row in enumerate(rates)
    ]


def same(one: FusedRate, other: FusedRate) -> bool:
    return all(
        np.allclose(getattr(one, name), getattr(other, name), rtol=1e-9, atol=1e-15, equal_nan=True)
        for name in ("rate_b", "variance", "noise", "bias_walk", "active")
    )


@pytest.mark.parametrize(
    ("fast", "slow"), [(kernel.Robust, robust.Robust), (kernel.Risaf, fusion.Risaf)]
)
def test_the_kernel_takes_new_parameters_as_the_numpy_form_does(fast, slow):
    one, other, as_before = fast(FusionParameters()), slow(FusionParameters()), []
    rows = epochs(900)
    left_alone = fast(FusionParameters())
    for k, epoch in enumerate(rows):
        if k == 500:
            before = one.relative_bias.copy()
            one.configure(OTHERS)
            other.configure(OTHERS)
            assert (one.relative_bias == before).all()
        fused = one.fuse(epoch)
        assert same(fused, other.fuse(epoch))
        as_before.append(same(fused, left_alone.fuse(epoch)))
    assert all(as_before[:500])
    assert not any(as_before[501:])


@pytest.mark.parametrize("method", ["robust", "risaf", "median", "mean"])
def test_the_same_parameters_again_change_nothing(method):
    config = Config(fusion=FusionParameters(method=method))
    one, other = Pipeline(config, OWN), Pipeline(config, OWN)
    vehicle = Vehicle(5)
    for k in range(300):
        time_us = 1_000_000 + k * 10_000
        frame = vehicle.fix(time_us, 1.0) if k % 20 == 10 else vehicle.epoch(time_us, (0, 0, 0.1))
        for pipeline in (one, other):
            if k == 0:
                pipeline.step(vehicle.info(), 0)
        if k % 50 == 25:
            one.configure(config)
        pairs = zip(one.step(frame, 0), other.step(frame, 0), strict=True)
        assert all((a.attitude.q_nb == b.attitude.q_nb).all() for a, b in pairs)


class Run:
    """A pipeline and a vehicle that drives north at 10 m/s."""

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or Config()
        self.pipeline = Pipeline(self.config, OWN)
        self.vehicle = Vehicle(5)
        self.pipeline.step(self.vehicle.info(), 0)
        self.time_us = 1_000_000

    def go(self, seconds, course=0.0, rate=(0.0, 0.0, 0.0)):
        for _ in range(round(seconds * 100)):
            self.time_us += 10_000
            if self.time_us % 200_000 == 0:
                self.pipeline.step(self.vehicle.fix(self.time_us, course), 0)
            (self.estimate,) = self.pipeline.step(self.vehicle.epoch(self.time_us, rate), 0)
        return self.estimate

    def configure(self, **heading):
        heading = structs.replace(self.config.heading, **heading)
        self.pipeline.configure(structs.replace(self.config, heading=heading))


@pytest.mark.parametrize("filter_name", ["eskf", "paper"])
def test_a_gate_that_is_widened_lets_the_next_heading_in(filter_name):
    run = Run(Config(attitude=AttitudeParameters(filter=filter_name)))
    run.go(5)
    assert run.go(0.2, course=0.08).heading.state is HeadingState.REJECTING
    before = run.estimate.attitude
    run.configure(gate=30.0)
    after = run.go(0.01)
    assert after.attitude.q_nb == pytest.approx(before.q_nb, abs=1e-4)
    assert after.attitude.resets == 1
    assert run.go(0.2, course=0.08).heading.innovation.fused


def test_a_minimum_speed_that_is_raised_holds_from_the_next_fix_on():
    run = Run()
    assert run.go(3).heading.state is HeadingState.FUSING
    run.configure(min_speed=50.0)
    assert run.go(0.4).heading.state is HeadingState.TOO_SLOW


def test_another_method_of_fusion_leaves_the_attitude_as_it_is():
    run = Run()
    before = run.go(5).attitude
    run.pipeline.configure(structs.replace(run.config, fusion=FusionParameters(method="mean")))
    after = run.go(0.05)
    assert after.attitude.q_nb == pytest.approx(before.q_nb, abs=1e-4)
    assert after.attitude.aligned


def test_a_restart_forgets_the_attitude_not_the_array():
    run = Run()
    run.go(8)
    trusted = run.estimate.array.health.state.tolist()
    elapsed = run.estimate.elapsed
    run.pipeline.restart()
    estimate = run.go(0.01)
    assert not estimate.attitude.aligned
    assert estimate.array.health.state.tolist() == trusted == [0] * 5
    assert estimate.elapsed == pytest.approx(elapsed + 0.01)
    assert run.go(1).attitude.aligned


def test_what_is_said_of_the_start_holds_from_the_next_start():
    run = Run()
    before = run.go(3).attitude.roll_std
    attitude = AttitudeParameters(initial_tilt_std=0.5)
    run.pipeline.configure(structs.replace(run.config, attitude=attitude))
    assert run.go(0.01).attitude.roll_std == pytest.approx(before, rel=0.05)
    run.pipeline.restart()
    assert run.go(0.01).attitude.roll_std > 0.4


@pytest.mark.parametrize("filter_name", ["eskf", "paper"])
def test_a_bias_that_is_told_is_believed_whatever_it_was_held_to_be(filter_name):
    attitude = AttitudeParameters(filter=filter_name, initial_bias_std=1e-4)
    estimator = Estimator(FusionParameters(), attitude, HeadingParameters())
    rate = np.array([0.03, -0.04, 0.05])
    rates = rate + np.random.default_rng(1).normal(0, 1e-4, (101, 9, 3))
    forces = np.zeros((101, 0, 3))
    track, _ = estimator.advance(np.full(100, 0.01), rates[:100], forces[:100])
    before = track.attitude(-1, 0)
    estimator.set_bias(rate, np.full(3, 1e-8))
    track, _ = estimator.advance(np.full(1, 0.01), rates[100:], forces[100:])
    after = track.attitude(0, 0)
    assert np.abs(before.bias_b).max() < 1e-2
    assert after.bias_b == pytest.approx(rate, abs=1e-4)
    assert np.abs(after.rate_b).max() < 2e-4
    assert after.roll_std == pytest.approx(before.roll_std, rel=0.02)


class TestZeroing:
    def run(self, rates, speed=float("nan"), dt=0.01):
        zeroing = Zeroing()
        for k, rate in enumerate(rates):
            zeroing.take(rate, speed, k * dt)
        return zeroing

    def test_the_mean_is_that_of_the_rates_within_its_deviation(self):
        truth = np.array([0.01, -0.02, 0.1])
        errors = []
        for seed in range(20):
            noise = np.random.default_rng(seed).normal(0, 2e-3, (502, 3))
            zeroing = self.run(truth + noise)
            assert zeroing.state is Zeroed.DONE
            errors.append((zeroing.mean - truth) / np.sqrt(zeroing.variance))
        assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.3

    def test_turning_shaking_driving_and_steady_turns_are_no_rest(self):
        still = np.zeros((600, 3))
        turning = still + np.linspace(0, 0.05, 600)[:, None]
        shaking = np.random.default_rng(1).normal(0, 0.2, (600, 3))
        steady = still + 0.3
        for rates in (turning, shaking, steady):
            assert self.run(rates).state is Zeroed.MOVED
        assert self.run(still, speed=2.0).state is Zeroed.MOVED

    def test_too_few_rates_are_no_mean(self):
        assert self.run(np.full((1200, 3), np.nan)).state is Zeroed.STARVED
        assert self.run(np.zeros((6, 3)), dt=2.5).state is Zeroed.STARVED


class TestKeptFile:
    def kept(self, tmp_path, text, *settings, configured=""):
        path = tmp_path / "vehicle.yaml"
        path.write_text(configured)
        (tmp_path / "vehicle.parameters.yaml").write_text(text)
        return kept_parameters(load(path, settings), path, settings)

    def test_it_lies_beside_the_configuration_and_is_written_whole(self, tmp_path):
        kept = self.kept(tmp_path, "")
        assert kept.write({"FUS_GATE": 5.0}) == ""
        assert yaml.safe_load((tmp_path / "vehicle.parameters.yaml").read_text()) == {"FUS_GATE": 5}
        assert self.kept(tmp_path, "FUS_GATE: 5.0").values == {"FUS_GATE": 5.0}
        assert sorted(p.name for p in tmp_path.iterdir()) == [
            "vehicle.parameters.yaml",
            "vehicle.yaml",
        ]

    def test_the_command_line_goes_over_it(self, tmp_path):
        text = "{FUS_GATE: 5.0, HDG_ANT_X: 1, HDG_GATE: 2}"
        kept = self.kept(tmp_path, text, "fusion.gate=3", "heading.antenna=[2, 0, 0]")
        assert kept.values == {"HDG_GATE": 2.0}
        assert kept.overruled == {"FUS_GATE": 5.0, "HDG_ANT_X": 1.0}

    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ("FUS_GATE: 1", "FUS_GATE: found 1, expected 2 to 1000"),
            ("NONE: 1", "NONE: found 1, expected a known parameter"),
            ("FUS_GATE: yes", "found True"),
            ("1: 1", "expected a known parameter"),
            ("[1]", "found [1], expected names with values"),
            ("a: b: c", "mapping values are not allowed"),
            ("\xff", "left out"),
            (f"FUS_GATE: {10**400}", "expected 2 to 1000"),
            ("FUS_GATE: !!float x", "found 'x', expected one of kind float; left out"),
            ("FUS_GATE: 2026-13-45", "expected one of kind timestamp; left out"),
            ("[" * 2000, "found values more than 32 deep in one another, expected fewer; left out"),
        ],
    )
    def test_what_cannot_be_used_is_said_and_left_out(self, tmp_path, caplog, text, said):
        assert self.kept(tmp_path, text).values == {}
        assert said in caplog.text

    def test_a_place_can_be_named(self, tmp_path):
        named = tmp_path / "state" / "kept.yaml"
        kept = self.kept(tmp_path, "FUS_GATE: 5", configured=f"mavlink: {{parameters: '{named}'}}")
        assert (kept.path, kept.values) == (named, {})
        assert kept.write({}) == "kept.yaml: No such file or directory"

    def test_without_a_configuration_nothing_is_kept(self):
        assert kept_parameters(Config(), None).path is None

    def test_a_write_that_fails_leaves_the_old_one(self, tmp_path):
        kept = self.kept(tmp_path, "FUS_GATE: 5")
        (tmp_path / "vehicle.parameters.yaml.new").mkdir()
        assert kept.write({"FUS_GATE": 6.0}).startswith("vehicle.parameters.yaml: ")
        assert self.kept(tmp_path, "FUS_GATE: 5").values == {"FUS_GATE": 5.0}
