"""What arrays, clocks and places do to a drive: the heading stays within what is claimed of it."""

import math
import struct
from dataclasses import dataclass, replace

import numpy as np
import pytest
from drives import FAULT, RATE, SENSORS, drive, followed_by, rewritten, run, silent

from risaf_link.core.heading import HeadingState
from risaf_link.core.health import Reason, SensorState
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.notices import Notices
from risaf_link.sim.drive import Drive
from risaf_link.sim.faults import FAULTS
from risaf_link.sim.stream import frames
from risaf_link.sim.trajectory import Place

HONEST = 3.0  # standard deviations
WITH_GPS = pytest.mark.parametrize("gps", [True, False], ids=["gps", "no gps"])


@dataclass(frozen=True)
class AllFrozen:
    """Every sensor repeats its reading at one time, until another."""

    begin: float  # s
    end: float  # s

    def strike(self, _):
        held = []

        def spoil(time_s, _, readings):
            for k in np.flatnonzero((time_s >= self.begin) & (time_s < self.end)):
                held.append(readings[k].copy())
                readings[k] = held[0]

        return spoil


@dataclass(frozen=True)
class AllSaturated:
    """Every sensor is at the end of its range, as in a fall or a hard turn."""

    begin: float  # s
    end: float  # s

    def strike(self, _):
        def spoil(time_s, _, readings):
            readings[(time_s >= self.begin) & (time_s < self.end)] = math.inf

        return spoil


@WITH_GPS
@pytest.mark.parametrize("length", [8.0, math.inf])
def test_a_whole_array_that_freezes_is_not_believed(gps, length):
    fault = AllFrozen(FAULT, FAULT + length)
    outcome = run(drive(gps=gps, faults={"frozen": fault}))
    assert outcome.worst < HONEST
    health = outcome.estimates[-1].array.health
    if length == math.inf:
        assert health.count(SensorState.DEAD) == SENSORS
        assert (health.reason == Reason.FROZEN).all()
        notices = Notices()
        notices.observe(outcome.estimates[-1])
        told = [
            notice.text for notice in notices.due(0, has_stalled=False, trouble="", complaints={})
        ]
        assert f"{SENSORS} of {SENSORS} sensors dead" in told
    elif gps:
        assert outcome.std[-1] < 0.02
    else:
        assert outcome.std[-1] > 1.0


@pytest.mark.parametrize("seed", [1, 2])
def test_a_gyro_that_is_alone_and_freezes_on_the_move_is_not_believed(seed):
    fault = AllFrozen(FAULT, FAULT + 10.0)
    outcome = run(drive(seed, duration=75.0, sensors=1, faults={"frozen": fault}))
    frozen = (outcome.time_s > FAULT + 2.0) & (outcome.time_s < FAULT + 10.0)
    assert outcome.std[frozen].min() > 2.5
    assert outcome.worst < HONEST
    assert outcome.std[-1] < 0.02


@pytest.mark.parametrize("name", FAULTS)
def test_sensors_that_fail_alone_cost_no_honesty(name):
    """GPS goes with them: nothing else tells what they do to yaw."""
    fault = FAULTS[name]
    if hasattr(fault, "onset"):
        fault = replace(fault, onset=(FAULT - 5.0, FAULT + 5.0))
    if hasattr(fault, "share"):
        fault = replace(fault, share=max(fault.share, 1 / SENSORS))
    assert run(drive(gps=False, faults={name: fault})).worst < HONEST


@WITH_GPS
def test_a_whole_array_that_saturates_is_not_believed(gps):
    outcome = run(drive(gps=gps, faults={"saturated": AllSaturated(FAULT, FAULT + 4.0)}))
    assert outcome.worst < HONEST
    assert outcome.pipeline.ingest.counts["saturated"] == 3 * 2 * SENSORS * round(4.0 * RATE)


@WITH_GPS
@pytest.mark.parametrize("length", [0.2, 0.8, 12.0])
def test_an_array_that_stops_and_goes_on_costs_what_it_could_not_see(gps, length):
    outcome = run(drive(gps=gps), silent(FAULT, FAULT + length))
    assert outcome.worst < HONEST
    assert outcome.counts["samples_lost"] == SENSORS * round(length * RATE)
    if gps:
        assert outcome.std[-1] < 0.02


@WITH_GPS
@pytest.mark.parametrize("rate", [RATE / 2.5, 2 * RATE, 8 * RATE])
def test_an_array_may_change_its_rate_on_the_way(gps, rate):
    chosen = drive(gps=gps)
    outcome = run(chosen, followed_by(replace(chosen, rate=rate)))
    assert outcome.worst < HONEST
    later = outcome.after(FAULT + 5.0)
    assert len(outcome.estimates[later]) == pytest.approx(19.7 * rate, abs=3)
    assert max(outcome.error[later]) < math.radians(1.0)


@WITH_GPS
@pytest.mark.parametrize("sensors", [6, 60])
def test_an_array_may_change_its_size_on_the_way(gps, sensors):
    chosen = drive(gps=gps)
    outcome = run(chosen, followed_by(replace(chosen, sensors=sensors)))
    assert outcome.worst < HONEST
    assert outcome.counts["size_changes"] == 1
    assert outcome.estimates[-1].array.sensors == sensors
    assert outcome.counts["epochs"] == 60 * RATE


@WITH_GPS
def test_an_array_may_number_its_epochs_anew(gps):
    outcome = run(drive(gps=gps), rewritten(lambda stamp, number: (stamp, number + 31_000)))
    assert outcome.worst < HONEST
    assert outcome.counts["epochs"] == 60 * RATE
    assert outcome.counts["samples_lost"] == 0


@WITH_GPS
@pytest.mark.parametrize("jump", [-30.0, -0.4, 0.04, 0.4, 86400.0])
def test_the_arrays_clock_may_jump_either_way(gps, jump):
    def set_clock(stamp, number):
        return stamp + round(jump * 1e6), number

    outcome = run(drive(gps=gps), rewritten(set_clock))
    assert outcome.worst < HONEST
    assert outcome.counts["epochs"] >= 60 * RATE - 2
    elapsed = outcome.estimates[-1].elapsed - outcome.estimates[0].elapsed
    assert elapsed == pytest.approx(60.0 - 1 / RATE, abs=0.1)


@pytest.mark.parametrize("jump", [-3600.0, 0.4, 1e9])
def test_the_hosts_clock_may_jump_either_way(jump):
    def clock(time_us):
        late = (time_us - 1_000_000) / 1e6 >= FAULT
        return 1_700_000_000_000_000 + time_us + late * round(jump * 1e6)

    chosen = drive(gps=True)
    as_usual, jumped = run(chosen), run(chosen, clock=clock)
    assert [e.heading.yaw for e in jumped.estimates] == [e.heading.yaw for e in as_usual.estimates]
    assert [e.boot_us for e in jumped.estimates] == [e.boot_us for e in as_usual.estimates]


def fixes_of(chosen):
    """Latitude and longitude of all fixes, 1e-7 deg, as they are sent."""
    gps = IDS["GPS_RAW_INT"].to_bytes(3, "little")
    payloads = [raw[10:] for _, raw in frames(chosen) if raw[7:10] == gps]
    return [struct.unpack_from("<ii", payload, 8) for payload in payloads]


def driven_from(latitude, longitude, **options):
    chosen = drive(**options)
    road, pace = chosen.trajectory._road, chosen.trajectory._pace
    start = Place(math.radians(latitude), math.radians(longitude), 100.0)
    return replace(chosen, trajectory=Drive(start, road, pace))


@pytest.mark.parametrize("latitude", [0.0, -65.0])
def test_the_date_line_is_a_line_like_any_other(latitude):
    chosen = driven_from(latitude, -179.9995)  # westwards
    told = [fix[1] for fix in fixes_of(chosen)]
    assert {longitude > 0 for longitude in told} == {False, True}
    outcome = run(chosen)
    assert outcome.worst < 2.0
    assert outcome.estimates[-1].heading.rejected_count <= 2


@WITH_GPS
@pytest.mark.parametrize("latitude", [87.9, 89.0, -89.98, 89.9999])
def test_near_a_pole_no_heading_is_claimed(gps, latitude):
    outcome = run(driven_from(latitude, 10.0, gps=gps))
    assert outcome.worst < HONEST
    if abs(latitude) > 88.0:
        assert outcome.std[outcome.after(1.0)].min() > 3.0
        assert outcome.estimates[-1].heading.state is not HeadingState.FUSING
