"""One simulated drive through several methods: the unit of work of every sweep."""

import hashlib
import math
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

from risaf_link.core.heading import HeadingParameters
from risaf_link.core.rotation import wrap
from risaf_link.core.scoring import ErrorAccount, YawTrack
from risaf_link.experiments.catalogue import make
from risaf_link.experiments.inputs import Instant, array_model, instants, with_gps_throughout
from risaf_link.experiments.method import Gps, Method
from risaf_link.sim.disturbances import Spikes
from risaf_link.sim.faults import FAULTS
from risaf_link.sim.scenario import Scenario
from risaf_link.sim.scenario import scenario as choose
from risaf_link.sweep import Row, program

SCORED = 0.1  # s, from one comparison to the next
TRACED = 0.5  # s, from one point of a figure to the next

PARTS = ("core", "sim", "mavlink", "experiments", "pipeline.py")  # what a result depends on


class Case(Struct, frozen=True, forbid_unknown_fields=True):
    """What a result depends on, besides the program itself."""

    scenario: str
    seed: int
    methods: tuple[str, ...]
    outages: tuple[tuple[float, float], ...]
    """s from the first epoch: GPS is withheld, and judges."""
    duration: float | None = None
    sensors: int | None = None
    faults: tuple[str, ...] | None = None
    spikes: float | None = None
    """Probability of a spike, of each reading; None: the scenario's."""
    traced: bool = False
    """Whether the course of everything is kept, for a figure."""
    own: tuple[tuple[str, str], ...] = ()
    """Methods of the user's own: name and source text."""

    @property
    def key(self) -> str:
        """Name of this case and of the program that runs it."""
        content = msgspec.json.encode(self) + program(*PARTS).encode()
        return f"{self.scenario}-{self.seed}-{hashlib.sha256(content).hexdigest()[:16]}"

    def parameters(self) -> Row:
        """What it says, but for its seed and sources."""
        told = {name: getattr(self, name) for name in self.__struct_fields__}
        return {key: value for key, value in told.items() if key not in {"seed", "own", "traced"}}

    def run(self) -> Row:
        """Run the case."""
        return run(self)


def scenario_of(case: Case) -> Scenario:
    """Choose the scenario of a case; its receiver is never silent."""
    chosen = choose(case.scenario, case.seed, case.duration, case.sensors, faults=case.faults)
    if case.spikes is not None:
        usual = FAULTS["spikes"]
        assert isinstance(usual, Spikes)  # noqa: S101 it is
        spikes = replace(usual, probability=case.spikes)
        chosen = replace(chosen, faults={**chosen.faults, "spikes": spikes})
    return with_gps_throughout(chosen)


@dataclass
class _Run:
    """A method, its scores, and its course."""

    method: Method
    outages: tuple[tuple[float, float], ...]
    yaws: YawTrack = field(default_factory=YawTrack)
    truth: list[ErrorAccount] = field(default_factory=list)
    gps: list[ErrorAccount] = field(default_factory=list)
    aided: ErrorAccount = field(default_factory=ErrorAccount)
    course: list[tuple[float, float, float]] = field(default_factory=list)
    relative_bias: list[list[float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.truth = [ErrorAccount() for _ in self.outages]
        self.gps = [ErrorAccount() for _ in self.outages]

    def compare(self, instant: Instant) -> None:
        """Hold the estimate against the truth."""
        estimate = self.method.estimate()
        if not math.isfinite(estimate.yaw):
            return
        self.yaws.add(instant.epoch.time_us, estimate.yaw)
        error = wrap(estimate.yaw - instant.yaw)
        now = instant.elapsed
        inside = [start <= now < end for start, end in self.outages]
        for account, is_in in zip(self.truth, inside, strict=True):
            if is_in:
                account.add(now, error)
        if not any(inside):
            self.aided.add(now, error)

    def compare_withheld(self, instant: Instant, gps: Gps) -> None:
        """Hold the estimate of its own time against a heading that was withheld."""
        heading = gps.motion.heading
        if heading is None:
            return
        age_us = round(1e6 * (gps.delay + heading.age))
        # It came at the epoch or just after; fixes describe whole tenths of a second.
        valid_us = round((instant.epoch.time_us - age_us) / 1e5) * 100_000
        yaw = self.yaws.at(valid_us)
        for account, (start, end) in zip(self.gps, self.outages, strict=True):
            if yaw is not None and start <= instant.elapsed < end:
                account.add(instant.elapsed, wrap(yaw - heading.heading))

    def trace(self) -> None:
        """Keep the course."""
        self.course.append(self.method.estimate())
        owner = getattr(self.method, "fusion", self.method)
        bias = getattr(owner, "relative_bias", None)
        if bias is not None:
            self.relative_bias.append(np.asarray(bias)[:, 2].round(7).tolist())

    def row(self, traced: bool) -> Row:
        """Scores, deg, and the course."""
        outages = [
            {"start_s": start, "end_s": end, "truth": _degrees(truth), "gps": _degrees(gps)}
            for (start, end), truth, gps in zip(self.outages, self.truth, self.gps, strict=True)
        ]
        row: Row = {"outages": outages, "aided": _degrees(self.aided)}
        if traced:
            yaw, std, bias = np.round(np.array(self.course).T, 7).tolist()
            row |= {"yaw": yaw, "yaw_std": std, "bias_z": bias, "relative_bias": self.relative_bias}
        return row


def run(case: Case) -> Row:
    """Run a case; all methods are given the same arrays.

    Returns
    -------
    dict
        `methods`: of each, its `outages` with the scores against `truth` and withheld `gps`, and
        that outside of outages, `aided`. Where it is traced, courses in rad every `TRACED` seconds.
    """
    scenario = scenario_of(case)
    array, own = array_model(scenario), dict(case.own)
    runs = {name: _Run(make(name, array, own), case.outages) for name in case.methods}
    every = max(1, round(SCORED * scenario.rate))
    trace = _Trace(scenario.sensors)
    for number, instant in enumerate(instants(scenario, HeadingParameters())):
        scored = number % every == 0
        withheld = any(start <= instant.elapsed < end for start, end in case.outages)
        for each in runs.values():
            each.method.step(instant.epoch)
            if scored:
                each.compare(instant)
            for gps in instant.fixes:
                if withheld:
                    each.compare_withheld(instant, gps)
                else:
                    each.method.correct(gps)
        if case.traced:
            trace.take(instant, withheld)
            if number % max(1, round(TRACED * scenario.rate)) == 0:
                trace.keep(instant)
                for each in runs.values():
                    each.trace()
    row: Row = {"methods": {name: runs[name].row(case.traced) for name in runs}}
    return row | ({"trace": trace.row()} if case.traced else {})


class _Trace:
    """The course of the truth, of GPS, and of every sensor integrated alone."""

    def __init__(self, sensors: int) -> None:
        self._integral = np.zeros(sensors)
        self._mean_error = 0.0
        self._columns: dict[str, list[Any]] = {
            name: []
            for name in ("time_s", "yaw", "sensors", "gps_time_s", "gps", "withheld", "bias_z")
        }

    def take(self, instant: Instant, withheld: bool) -> None:
        """Integrate about the body's down axis; the road is taken for level."""
        rates = instant.epoch.rates_b[:, 2]
        self._integral += np.nan_to_num(rates) * instant.epoch.dt
        self._mean_error += 0.01 * (
            float(np.nanmean(rates)) - float(instant.rate_b[2]) - self._mean_error
        )
        for gps in instant.fixes:
            if gps.motion.heading:
                self._columns["gps_time_s"].append(round(instant.elapsed, 3))
                self._columns["gps"].append(round(float(gps.motion.heading.heading), 6))
                self._columns["withheld"].append(withheld)

    def keep(self, instant: Instant) -> None:
        """Keep what is known now."""
        self._columns["time_s"].append(round(instant.elapsed, 3))
        self._columns["yaw"].append(round(instant.yaw, 7))
        self._columns["sensors"].append(self._integral.round(5).tolist())
        self._columns["bias_z"].append(round(self._mean_error, 7))

    def row(self) -> Row:
        """All columns; rad, rad/s."""
        return self._columns


def _degrees(account: ErrorAccount) -> Row | None:
    score = account.score()
    if score is None:
        return None
    return {
        "samples": score.samples,
        "rmse_deg": math.degrees(score.rmse),
        "final_deg": math.degrees(score.final),
        "max_deg": math.degrees(score.largest),
        "drift_deg_per_min": math.degrees(score.drift) * 60.0,
    }
