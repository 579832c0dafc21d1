"""What methods are compared on is what the frames of the same simulation carry."""

import math
from dataclasses import replace

import numpy as np
import pytest

from risaf_link.config import load
from risaf_link.core.heading import HeadingParameters
from risaf_link.core.rotation import wrap, yaw_of
from risaf_link.experiments.case import Case, run, scenario_of
from risaf_link.experiments.catalogue import make
from risaf_link.experiments.inputs import array_model, instants
from risaf_link.mavlink.epoch import ArrayParameters, EpochAssembler, GyroChunk
from risaf_link.mavlink.frame import FrameParser
from risaf_link.mavlink.ingest import GpsParameters, Ingest
from risaf_link.mavlink.truth import truth_of
from risaf_link.pipeline import Pipeline
from risaf_link.sim.scenario import scenario
from risaf_link.sim.stream import frames

FAULTS = ("spikes", "shocks", "saturated", "invalid", "dropouts")


def chosen(name="drive2", **changes):
    usual = {"duration": 12.0, "sensors": 45, "faults": FAULTS} | changes
    made = scenario(name, 3, **usual)
    return replace(made, outages=((8.0, math.inf),))


def parsed(made):
    parser = FrameParser()
    for time_us, raw in frames(made):
        for frame in parser.receive_data(raw):
            yield time_us, frame


def test_epochs_are_those_of_the_frames():
    made = chosen()
    ingest = Ingest(ArrayParameters(), GpsParameters(), (1, 2))
    assembler = EpochAssembler(ArrayParameters())
    epochs = []
    for time_us, frame in parsed(made):
        datum = ingest.decode(frame, time_us)
        if isinstance(datum, GyroChunk):
            epochs += assembler.add(datum)
    epochs += assembler.flush()
    given = [instant.epoch for instant in instants(made, HeadingParameters())]
    assert len(epochs) == len(given) == 1200
    assert np.isnan(given[-1].rates_b).any()
    for ours, theirs in zip(given, epochs, strict=True):
        assert (ours.time_us, ours.dt) == (theirs.time_us, theirs.dt)
        np.testing.assert_array_equal(ours.rates_b, theirs.rates_b)
    for ours, theirs in zip(given[1:], epochs[1:], strict=True):  # the first does not wait
        np.testing.assert_array_equal(ours.forces_b, theirs.forces_b)


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("ours", ()),
        ("robust", ("attitude.filter=paper",)),
        ("risaf", ("fusion.method=risaf", "attitude.filter=paper")),
        ("mean", ("fusion.method=mean", "attitude.filter=paper")),
    ],
)
def test_a_method_of_the_service_says_what_the_service_says(name, settings):
    made = chosen("drive1")
    config = load(None, settings)
    pipeline = Pipeline(config, config.own)
    served = {}
    for time_us, frame in parsed(made):
        for estimate in pipeline.step(frame, time_us):
            served[estimate.time_us] = estimate.attitude
    method = make(name, array_model(made), {})
    differences = []
    for number, instant in enumerate(instants(made, HeadingParameters())):
        forces = instant.epoch.forces_b[: 45 if number else 0]  # the first does not wait for them
        method.step(replace(instant.epoch, forces_b=forces))
        expected = served.get(instant.epoch.time_us)
        said = method.estimate()
        if expected is not None and expected.aligned:
            differences.append(wrap(said.yaw - expected.euler[2]))
        for fix in instant.fixes:
            method.correct(fix)
    assert len(differences) > 1100
    assert np.abs(differences).max() < 1e-12


def test_truth_is_that_of_the_frames():
    made = chosen()
    truths = {t.time_us: yaw_of(t.q_nb) for _, f in parsed(made) if (t := truth_of(f))}
    yaws = {i.epoch.time_us: i.yaw for i in instants(made, HeadingParameters())}
    assert len(truths) == 120
    for time_us, yaw in truths.items():
        assert wrap(yaws[time_us] - yaw) == pytest.approx(0, abs=1e-6)


def test_all_methods_together_say_what_each_says_alone():
    case = Case("circle", 2, ("mean", "risaf"), ((5.0, 9.0),), duration=10.0, sensors=20)
    together = run(case)["methods"]
    for name in case.methods:
        alone = Case("circle", 2, (name,), ((5.0, 9.0),), duration=10.0, sensors=20)
        assert run(alone)["methods"][name] == together[name]


def test_withheld_gps_judges_as_the_truth_does_but_for_its_noise():
    """Course noise is 0.1 m/s across 10 m/s: 0.57 deg."""
    case = Case("circle", 2, ("robust",), ((20.0, 80.0),), duration=80.0, sensors=10)
    outage = run(case)["methods"]["robust"]["outages"][0]
    truth, gps = outage["truth"]["rmse_deg"], outage["gps"]["rmse_deg"]
    assert outage["gps"]["samples"] == 300
    assert math.sqrt(truth**2 + 0.573**2) == pytest.approx(gps, rel=0.15)


def test_the_probability_of_spikes_can_be_chosen():
    case = Case("circle", 1, (), (), duration=2.0, sensors=50, spikes=0.2)
    rates = np.array([i.epoch.rates_b for i in instants(scenario_of(case), HeadingParameters())])
    assert np.mean(np.abs(rates[:, :, 0]) > math.radians(5)) == pytest.approx(0.2, abs=0.01)
