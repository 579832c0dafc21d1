"""Every fault does what its name says, to whom it should, and disturbs nothing else."""

import math
from dataclasses import replace

import numpy as np
import pytest

from risaf_link.errors import ConfigError
from risaf_link.sim.disturbances import Ramps, Scale, Shocks, Spikes, Steps, Thermal
from risaf_link.sim.failures import Dropouts, Frozen, Invalid, Saturated
from risaf_link.sim.faults import FAULTS, OF_CHIPS
from risaf_link.sim.pace import Pace, SpeedChange
from risaf_link.sim.readings import readings, strikes
from risaf_link.sim.receiver import fixes
from risaf_link.sim.receiver_faults import RECEIVER_FAULTS, CourseError
from risaf_link.sim.scenario import CONSUMER_GYROS, scenario
from risaf_link.sim.sensors import TriadArray, TriadErrors
from risaf_link.sim.target import Target
from risaf_link.sim.trajectory import Truth

PERFECT = TriadErrors(0.0, 0.0, 0.0, math.inf)
NOISY = replace(PERFECT, noise_density=1e-3)


class StopAndGo:
    """10 m/s for 50 s, 30 s of rest, 10 m/s again; nothing else is asked of it."""

    pace = Pace(10.0, (SpeedChange(50.0, 1.0, -10.0), SpeedChange(80.0, 1.0, 10.0)))

    def __call__(self, time_s):
        ride = self.pace(time_s)
        velocity_n = ride.speed[:, None] * [1.0, 0.0, 0.0]
        return Truth(time_s, *[None] * 3, velocity_n, *[None] * 5)


def target(sensors=100, duration=100.0, seed=1, first=0):
    when, how_much, order = np.random.default_rng(seed).spawn(3)
    return Target(sensors, StopAndGo(), duration, order.permutation(sensors), first, when, how_much)


def struck(fault, samples=10_000, rate=100.0, errors=PERFECT, truth=(0.0, 0.0, 0.0), **options):
    """Readings of an array with one fault, shape (samples, sensors, 3)."""
    aim = target(**options)
    array = TriadArray(errors, aim.sensors, rate, np.random.default_rng(2), [fault.strike(aim)])
    return array.read(np.tile(truth, (samples, 1)))


def on_a_circle(name, duration, **options):
    """A scenario's array and faults on a way that is quick to compute."""
    circle = scenario("circle", 1).trajectory
    return replace(scenario(name, 4, duration, **options), trajectory=circle)


def gyros(chosen):
    """What the gyros of a scenario read while they turn by 0.1 rad/s, shape (k, sensors, 3)."""
    faults = strikes(chosen, FAULTS)
    generator = chosen.generator("gyros")
    array = TriadArray(chosen.gyros, chosen.sensors, chosen.rate, generator, faults)
    return array.read(np.full((round(chosen.duration * chosen.rate), 3), 0.1))


def victims(values):
    """Sensors of which something differs from zero."""
    return np.nonzero((values != 0).any(axis=(0, 2)))[0]


def test_spikes_come_as_often_and_as_large_as_told_to_both_sides():
    spikes = struck(Spikes(0.02, 0.5), samples=1000)
    hits = spikes[spikes != 0]
    expected = 0.02 * spikes.size
    assert abs(len(hits) - expected) < 5 * math.sqrt(expected)
    assert abs((hits > 0).mean() - 0.5) < 2.5 / math.sqrt(len(hits))
    sizes = abs(hits)
    assert sizes.min() >= 0.25
    assert sizes.max() <= 0.75
    assert abs(sizes.mean() - 0.5) < 5 * 0.5 / math.sqrt(12 * len(hits))
    assert (spikes != 0).mean(axis=(0, 1)) == pytest.approx(0.02, abs=5 * math.sqrt(0.02 / 1e5))


def test_shocks_are_one_sided_bursts_of_some_sensors_that_decay_and_need_motion():
    bursts = struck(Shocks(share=0.3, spacing=20.0, peak=1.0, decay=0.2))
    assert len(victims(bursts)) == 30
    for axis in range(3):
        values = bursts[:, victims(bursts), axis]
        assert (values >= 0).all() or (values <= 0).all()
    size = abs(bursts[:, victims(bursts)])
    jumps = np.diff(size, axis=0) > 1e-9
    assert (jumps.any(axis=(1, 2)) == jumps.all(axis=(1, 2))).mean() > 0.999  # all at once
    hits = np.nonzero(jumps.any(axis=(1, 2)))[0] / 100
    assert abs(len(hits) - 700 / 20) < 5 * math.sqrt(700 / 20)
    assert not ((hits > 51.0) & (hits < 80.0)).any()
    assert size[7900].max() < 1e-3
    calm = ~jumps.any(axis=(1, 2)) & (size[:-1] > 1e-6).all(axis=(1, 2))
    assert np.allclose(size[1:][calm], size[:-1][calm] * math.exp(-0.01 / 0.2), atol=1e-7)
    # Peak, times duration of a burst, times bursts a second.
    assert size[:5000].mean() == pytest.approx(1.0 * 0.2 * 10.0 / 20.0, rel=0.5)


def test_bumps_come_as_often_as_the_road_has_them():
    passed = [len(target(seed=seed).waypoints(10.0)) for seed in range(30)]
    assert np.mean(passed) == pytest.approx(70.0, abs=5 * math.sqrt(70 / 30))
    assert np.var(passed) == pytest.approx(70.0, rel=5 * math.sqrt(2 / 30))


def test_a_scale_error_is_a_share_of_the_truth():
    truth = (1.0, -2.0, 0.0)
    off = struck(Scale(0.01), samples=2, sensors=1000, truth=truth) - truth
    assert (off[0] == off[1]).all()
    assert (off[..., 2] == 0.0).all()
    errors = off[0, :, :2] / truth[:2]
    assert errors.std() == pytest.approx(0.01, rel=5 / math.sqrt(2 * 2000))


def test_thermal_drift_approaches_its_end_and_is_partly_common():
    drift = struck(Thermal(common=1.0, own=0.01, time_constant=10.0))
    assert (drift[0] == 0.0).all()
    assert drift[1000] == pytest.approx(drift[-1] * (1 - math.exp(-1.0)), rel=1e-3)
    assert drift[-1].std(axis=0) == pytest.approx(0.01, rel=5 / math.sqrt(200))
    assert abs(drift[-1].mean(axis=0)).max() > 0.05


def test_a_step_comes_once_and_stays():
    steps = struck(Steps(share=0.1, size=0.5, onset=(20.0, 60.0)))
    who = victims(steps)
    assert len(who) == 10
    assert (abs(steps[-1, who]) >= 0.25).all()
    assert (abs(steps[-1, who]) <= 0.75).all()
    assert (np.count_nonzero(np.diff(steps[:, who], axis=0), axis=0) == 1).all()
    onset = np.argmax(steps[:, who, 0] != 0, axis=0) / 100
    assert (onset >= 20.0).all()
    assert (onset <= 60.01).all()
    assert np.ptp(onset) > 10.0


def test_a_ramp_grows_evenly_from_its_onset():
    ramps = struck(Ramps(share=0.1, slope=0.5, onset=(20.0, 60.0)))
    who = victims(ramps)
    assert len(who) == 10
    slope = np.diff(ramps[:, who], axis=0) * 100
    late = slope[6001:]
    assert np.allclose(late, late[0], rtol=1e-6)
    assert abs(late).min() >= 0.25 - 1e-9
    assert abs(late).max() <= 0.75 + 1e-9
    assert (ramps[:2000] == 0.0).all()


def test_a_frozen_sensor_repeats_its_last_reading():
    frozen = struck(Frozen(share=0.1, onset=(20.0, 60.0)), errors=NOISY)
    still = (np.diff(frozen, axis=0) == 0).all(axis=2)
    who = np.nonzero(still[-1])[0]
    assert len(who) == 10
    begin = np.argmax(still[:, who], axis=0)
    for sensor, first in zip(who, begin, strict=True):
        assert 2000 <= first <= 6001
        assert still[first:, sensor].all()
        assert not still[:first, sensor].any()
    sound = struck(Frozen(share=0.1, onset=(200.0, 300.0)), errors=NOISY)
    assert (frozen[begin, who] == sound[begin, who]).all()


def test_a_saturated_sensor_is_stuck_at_full_scale():
    errors = replace(NOISY, full_scale=2.0)
    stuck = struck(Saturated(share=0.02, onset=(20.0, 60.0)), errors=errors)
    full = (abs(stuck) == 2.0).all(axis=2)
    who = np.nonzero(full.any(axis=0))[0]
    assert len(who) == 2
    assert full[6001:, who].all()
    assert not full[:2000].any()
    assert (np.diff(stuck[6001:, who], axis=0) == 0).all()


def test_invalid_readings_come_in_spells():
    invalid = np.isnan(struck(Invalid(share=0.5, every=2.0, length=0.5)))
    assert (invalid.all(axis=2) == invalid.any(axis=2)).all()
    gone = invalid[..., 0]
    who = gone.any(axis=0)
    assert who.sum() == 50
    begins = np.count_nonzero(np.diff(gone[:, who].astype(int), axis=0) == 1)
    assert begins / 50 == pytest.approx(100 / 2.5, rel=0.1)
    assert gone[:, who].mean() == pytest.approx(0.2, rel=0.1)


def test_of_the_sensors_that_drop_out_some_return():
    fault = Dropouts(share=0.4, returning=0.5, absence=10.0, onset=(5.0, 20.0))
    gone = np.isnan(struck(fault, sensors=200))[..., 0]
    who = gone.any(axis=0)
    assert who.sum() == 80
    assert not gone[:500].any()
    edges = np.abs(np.diff(gone[:, who].astype(int), axis=0)).sum(axis=0)
    assert set(edges) == {1, 2}
    assert gone[-1, who].sum() == pytest.approx(40, abs=5 * math.sqrt(20))
    returned = edges == 2
    assert gone[:, who][:, returned].sum(axis=0).mean() / 100 == pytest.approx(10.0, rel=0.5)


@pytest.mark.parametrize("name", FAULTS)
def test_readings_do_not_depend_on_how_time_is_cut(name):
    truth = np.random.default_rng(3).normal(size=(6000, 3))
    whole, cut = (
        TriadArray(
            CONSUMER_GYROS, 9, 100.0, np.random.default_rng(5), [FAULTS[name].strike(target(9))]
        )
        for _ in range(2)
    )
    blocks = [cut.read(block) for block in np.split(truth, [1, 2, 200, 4100, 5999])]
    assert np.array_equal(np.concatenate(blocks), whole.read(truth), equal_nan=True)


@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_can_be_switched_on_alone_and_off_again(name):
    def read(faults):
        return gyros(on_a_circle("drive2", duration=510.0, sensors=20, rate=1.0, faults=faults))

    sound, alone, default = read(["none"]), read([name]), read(["default"])
    hit = (alone != sound).any(axis=(0, 2))
    assert hit.any()
    more = read(["default", name])
    also = (default != sound).any(axis=(0, 2))
    assert np.array_equal(more[:, ~hit], default[:, ~hit])
    assert np.array_equal(more[:, ~also], alone[:, ~also], equal_nan=True)


def test_a_third_of_the_array_of_drive2_is_shocked_and_three_sensors_die():
    def read(faults):
        return gyros(on_a_circle("drive2", duration=510.0, rate=1.0, faults=faults))

    spoilt, sound = read(None), read(["none"])
    assert (spoilt != sound).any(axis=(0, 2)).sum() == 30 + 2 + 1
    dead = (np.diff(spoilt[-5:], axis=0) == 0).all(axis=(0, 2))
    assert dead.sum() == 3


def test_nothing_is_shocked_before_the_vehicle_moves():
    sound, spoilt = (
        next(readings(scenario("drive2", 4, 1.0, faults=faults))) for faults in ([], None)
    )
    assert (sound.rates_b == spoilt.rates_b).all()


def test_a_shorter_run_is_the_beginning_of_a_longer_one():
    def read(duration):
        chosen = on_a_circle("drive2", duration, sensors=20, rate=5.0, faults=FAULTS)
        return np.concatenate([block.rates_b for block in readings(chosen)])

    short = read(60.0)
    assert np.array_equal(short, read(220.0)[: len(short)], equal_nan=True)


@pytest.mark.parametrize("name", sorted(OF_CHIPS))
def test_the_gyro_and_the_accelerometer_of_a_chip_fail_together(name):
    chosen = on_a_circle("drive2", duration=505.0, sensors=50, rate=2.0, faults=[name])
    blocks = list(readings(chosen))

    def failed(values):
        stuck = np.zeros(values.shape[:2], dtype=bool)
        stuck[1:] = (np.diff(values, axis=0) == 0).all(axis=2)
        return np.isnan(values).any(axis=2) | stuck

    gyros = failed(np.concatenate([block.rates_b for block in blocks]))
    accelerometers = failed(np.concatenate([block.forces_b for block in blocks]))
    assert gyros.any()
    assert (gyros == accelerometers).all()


def test_faults_strike_different_sensors():
    few = ["steps", "ramps", "frozen", "saturated"]
    hit = []
    for name in few:
        chosen = scenario("circle", 4, duration=201.0, rate=1.0, faults=[name])
        hit.append(set(victims(gyros(chosen) - gyros(replace(chosen, faults={})))))
    assert sum(map(len, hit)) == len(set.union(*hit)) == 5 + 5 + 2 + 1


def test_an_array_of_one_sensor_can_fail():
    chosen = on_a_circle("ekf2", duration=201.0, rate=1.0, faults=["dropouts"])
    assert np.isnan(gyros(chosen)).any()


@pytest.mark.parametrize("names", [["spiks"], ["default", "spiks"], [""]])
def test_an_unknown_fault_is_refused_and_the_known_ones_are_named(names):
    with pytest.raises(ConfigError) as error:
        scenario("circle", 1, faults=names)
    assert str(error.value) == (
        f"faults: {names[-1]!r}, expected one of spikes, shocks, scale, thermal, steps, ramps, "
        "frozen, saturated, invalid, dropouts, gps_jump, gps_drift, gps_spoofed, gps_position, "
        "gps_frozen, none, default"
    )


def test_a_scenario_keeps_its_own_parameters_of_a_fault():
    chosen = scenario("drive2", 1, faults=["shocks", "spikes"])
    assert list(chosen.faults) == ["spikes", "shocks"]
    assert chosen.faults["shocks"] == scenario("drive2", 1).faults["shocks"]
    assert scenario("drive2", 1, faults=["none"]).faults == {}
    assert list(scenario("drive2", 1).faults) == ["shocks", "frozen", "saturated"]


# The receiver's


def reports(name, duration=60.0):
    """What a receiver reports with a fault from 50 s on, and without."""
    chosen = scenario("circle", 4, duration)
    sound = fixes(chosen.trajectory, duration, chosen.receiver, chosen.generator("receiver"))
    return RECEIVER_FAULTS[name].spoil(sound), sound


def course_errors(name):
    spoilt, sound = reports(name)
    errors = np.degrees(np.remainder(spoilt.course - sound.course + math.pi, math.tau) - math.pi)
    assert np.abs(errors[sound.time_s < 50.0]).max() < 1e-9
    return errors, sound.time_s - 50.0


def test_a_course_can_jump_or_drift():
    jump, since = course_errors("gps_jump")
    assert jump[since >= 0.0] == pytest.approx(45.0)
    for name in ("gps_drift", "gps_spoofed"):
        drift, since = course_errors(name)
        assert drift[since >= 0.0] == pytest.approx(0.5 * since[since >= 0.0], abs=1e-9)


def test_a_course_can_be_off_again_and_again():
    _, sound = reports("gps_jump", duration=100.0)
    fault = CourseError(size=1.0, begin=20.0, length=5.0, every=30.0)
    off = np.abs(fault.spoil(sound).course - sound.course) > 1e-6
    times_s = sound.time_s
    expected = ((times_s >= 20) & (times_s < 25)) | ((times_s >= 50) & (times_s < 55))
    assert np.array_equal(off, expected | ((times_s >= 80) & (times_s < 85)))


def test_a_spoofed_way_is_that_of_its_velocity_and_a_drifting_course_is_not():
    for name, agrees in (("gps_spoofed", True), ("gps_drift", False)):
        spoilt, sound = reports(name)
        off = np.radians(0.5) * np.maximum(sound.time_s - 50.0, 0.0)
        moved = (spoilt.latitude[-1] - sound.latitude[-1]) * 6.37e6
        expected = float(np.sum(sound.speed * (np.cos(sound.course + off) - np.cos(sound.course))))
        assert bool(abs(moved - expected * 0.2) < 0.2) is agrees


def test_a_frozen_receiver_repeats_its_report_with_new_times_and_comes_back():
    spoilt, sound = reports("gps_frozen", duration=100.0)
    during = (sound.time_s >= 50.0) & (sound.time_s < 90.0)
    for values in (spoilt.latitude, spoilt.longitude, spoilt.speed, spoilt.course):
        assert len(np.unique(values[during])) == 1
    assert np.array_equal(spoilt.time_s, sound.time_s)
    assert np.array_equal(spoilt.course[~during], sound.course[~during])


def test_a_position_jumps_and_its_velocity_does_not():
    spoilt, sound = reports("gps_position")
    north = (spoilt.latitude - sound.latitude) * 6.36e6
    assert north[sound.time_s >= 50.0] == pytest.approx(300.0, rel=0.01)
    assert np.array_equal(spoilt.course, sound.course)


def test_faults_of_sensors_and_of_the_receiver_are_chosen_alike():
    chosen = scenario("drive2", 1, faults=["gps_frozen", "default"])
    assert chosen.faults == scenario("drive2", 1).faults
    assert chosen.receiver_faults == {"gps_frozen": RECEIVER_FAULTS["gps_frozen"]}
    assert scenario("drive2", 1).receiver_faults == {}


def test_the_receivers_faults_of_a_scenario_are_on_unless_others_are_chosen():
    own = scenario("demo", 1).receiver_faults
    assert own["gps_jump"] != RECEIVER_FAULTS["gps_jump"]
    assert scenario("demo", 1, faults=["default"]).receiver_faults == own
    assert scenario("demo", 1, faults=["gps_jump"]).receiver_faults == own
    assert scenario("demo", 1, faults=["spikes"]).receiver_faults == {}
