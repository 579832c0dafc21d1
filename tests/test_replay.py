"""Logs through the pipeline: what comes out, and how it is scored."""

import csv
import io
import math
from pathlib import Path

import numpy as np
import pytest
from logs import simulated
from vehicle import Vehicle
from wire import frame

from risaf_link.config import Config, load
from risaf_link.core.outage import Errors
from risaf_link.core.rotation import wrap
from risaf_link.mavlink.component import Component
from risaf_link.mavlink.dialect import IDS, pack
from risaf_link.mavlink.frame import Frame, encode
from risaf_link.mavlink.identity import Identity
from risaf_link.mavlink.parameters import Parameters
from risaf_link.mavlink.tlog import TlogReader, record
from risaf_link.pipeline import Pipeline
from risaf_link.publish.rows import COLUMNS, RowWriter
from risaf_link.replay import OutputLog, Replay, Selection

FIXTURES = Path(__file__).parents[1] / "sitl_fixtures"
GRID = 0.25  # rad/s: coarse readings make ties


def rows_of(log: Path, config: Config) -> list[dict[str, str]]:
    file = io.StringIO()
    rows = RowWriter(file)
    for block in Replay(config, log, Selection()).blocks():
        rows.write(block)
    file.seek(0)
    return list(csv.DictReader(file))


def debug_log(path: Path, readings: np.ndarray) -> Path:
    """A log of DEBUG_FLOAT_ARRAY, nineteen sensors a message; readings (epochs, sensors, 3)."""
    log = b""
    for k, epoch in enumerate(readings):
        for first in range(0, len(epoch), 19):
            data = np.full(58, np.nan, np.float32)
            chunk = epoch[first : first + 19].astype(np.float32).ravel()
            data[: len(chunk)] = chunk
            fields = {"name": b"gyro", "array_id": first, "data": data.tolist()}
            message = IDS["DEBUG_FLOAT_ARRAY"], _packed("DEBUG_FLOAT_ARRAY", 10_000 * k, fields)
            log += record(10_000 * k, encode(*message, k % 256, 1, 158))
    path.write_bytes(log)
    return path


def _packed(name: str, time_us: int, fields: dict[str, object]) -> bytes:
    return pack(name, time_usec=time_us + 1_000_000, **fields)[1]


def paper(readings: np.ndarray, alpha: float = 0.995) -> list[tuple[np.ndarray, ...]]:
    """Eq. 5 to 8 of the paper, channel by channel, as a reader would write them down."""
    bias = np.zeros(readings.shape[1:])
    results = []
    for epoch in readings.astype(np.float32).astype(float):
        rate, variance, active = np.zeros(3), np.zeros(3), np.zeros(3, int)
        for axis in range(3):
            u = epoch[:, axis]
            mean = math.fsum(u) / len(u)
            for i in range(len(u)):
                bias[i, axis] = alpha * bias[i, axis] + (1 - alpha) * (u[i] - mean)
            corrected = u - bias[:, axis]
            lower, upper = np.quantile(corrected, [0.2, 0.8])
            chosen = [c for c in corrected if lower <= c <= upper]
            rate[axis] = math.fsum(chosen) / len(chosen)
            squares = math.fsum((c - rate[axis]) ** 2 for c in chosen)
            variance[axis] = squares / (len(chosen) - 1)
            active[axis] = len(chosen)
        results.append((rate, variance, active))
    return results


def test_fused_rates_are_those_of_the_paper_from_wire_to_csv_ties_included(tmp_path):
    generator = np.random.default_rng(5)
    readings = generator.normal(0.0, 1.0, (150, 45, 3))
    readings[:, ::2] = np.round(readings[:, ::2] / GRID) * GRID
    log = debug_log(tmp_path / "debug.tlog", readings)
    rows = rows_of(log, load(None, ["fusion.method=risaf"]))
    assert len(rows) == len(readings)
    for row, (rate, variance, active) in zip(rows, paper(readings), strict=True):
        for axis, letter in enumerate("xyz"):
            assert float(row[f"fused_{letter}"]) == pytest.approx(rate[axis], abs=1e-9)
            assert float(row[f"fused_var_{letter}"]) == pytest.approx(variance[axis], abs=1e-9)
            assert int(row[f"active_{letter}"]) == active[axis]


def test_rows_have_the_columns_and_the_precision_that_were_promised(tmp_path):
    rows = rows_of(simulated(tmp_path / "drive.tlog", duration=2), Config())
    assert tuple(rows[0]) == COLUMNS
    assert [int(row["time_us"]) for row in rows] == [1_000_000 + 20_000 * k for k in range(100)]
    q_nb = np.array([[float(row[f"q_{c}"]) for c in "wxyz"] for row in rows])
    assert np.linalg.norm(q_nb, axis=1) == pytest.approx(1.0, abs=1e-12)
    assert rows[0]["heading_state"] == "NO_FIX"
    assert rows[-1]["heading_state"] == "FUSING"


def test_an_outage_is_scored_against_truth_and_against_what_was_withheld(tmp_path):
    log = simulated(tmp_path / "drive.tlog")
    replay = Replay(Config(), log, Selection(outages=((6.0, 11.0),)))
    trace: list[Errors] = []
    replay.scorer.listeners.append(trace.append)
    states = [(e.elapsed, e.heading.state.name) for block in replay.blocks() for e in block]
    assert {state for t, state in states if 8.5 < t < 11.0} == {"DEAD_RECKONING"}
    assert [row["reference"] for row in replay.summary()["outages"]] == ["truth", "gps"]
    for row in replay.summary()["outages"]:
        errors = [
            math.degrees(e)
            for errors in trace
            for t, e in zip(errors.elapsed, errors.error, strict=True)
            if errors.reference == row["reference"] and 6.0 <= t <= 11.0
        ]
        assert len(errors) > 20
        assert (row["start_s"], row["end_s"]) == (6.0, 11.0)
        assert row["rmse_deg"] == pytest.approx(np.sqrt(np.mean(np.square(errors))), abs=1e-3)
        assert row["final_deg"] == pytest.approx(abs(errors[-1]), abs=1e-3)
        assert row["max_deg"] == pytest.approx(np.max(np.abs(errors)), abs=1e-3)
        assert row["rmse_deg"] < 3.0


def test_gps_that_is_withheld_does_not_reach_the_filter(tmp_path):
    log = simulated(tmp_path / "drive.tlog")

    def fused(*outages: tuple[float, float]) -> int:
        replay = Replay(Config(), log, Selection(outages=outages))
        list(replay.blocks())
        return int(replay.summary()["heading"]["fused"])

    assert fused() - fused((4.0, 8.0)) == 20  # at 5 Hz


def test_start_and_end_cut_the_log(tmp_path):
    log = simulated(tmp_path / "drive.tlog")
    replay = Replay(Config(), log, Selection(start=2.0, end=5.0))
    times = [estimate.time_us for block in replay.blocks() for estimate in block]
    assert (times[0], times[-1]) == pytest.approx((3_000_000, 6_000_000), abs=20_000)
    assert replay.summary()["duration_s"] == pytest.approx(3.0, abs=0.05)


def test_the_output_log_has_messages_at_their_rates_and_a_heartbeat(tmp_path):
    config = load(None, ["emit={ATTITUDE_QUATERNION: 10, ARRAY_STATUS: 1}"])
    file = io.BytesIO()
    output = OutputLog(config, file)
    replay = Replay(config, simulated(tmp_path / "d.tlog"), Selection())
    for block in replay.blocks(singly=True):
        output.write(block)
    ids = [logged.frame.message_id for logged in TlogReader([file.getvalue()])]
    counts = {name: ids.count(IDS[name]) for name in ("ATTITUDE_QUATERNION", "ARRAY_STATUS")}
    assert counts == {"ATTITUDE_QUATERNION": 120, "ARRAY_STATUS": 12}
    assert ids.count(IDS["HEARTBEAT"]) in {12, 13}


def test_a_calibration_that_is_not_the_arrays_gives_no_estimates_and_says_why(tmp_path):
    path = tmp_path / "calibration.yaml"
    path.write_text("gyros: [{}, {}]")
    config = load(None, [f"array.calibration={path}"])
    replay = Replay(config, simulated(tmp_path / "drive.tlog", duration=1), Selection())
    with pytest.raises(Exception, match=r"array\.calibration: .* for 2 sensors, the array has 20"):
        list(replay.blocks())


def test_a_calibration_is_applied_to_raw_readings(tmp_path):
    log = simulated(tmp_path / "drive.tlog", duration=1, sensors=3)
    path = tmp_path / "calibration.yaml"
    upside_down = "{mounting: [0, 1, 0, 0], bias: [0.5, 0, 0]}"
    path.write_text(f"gyros: [{', '.join([upside_down] * 3)}]")
    plain = rows_of(log, load(None, ["fusion.method=mean"]))
    turned = rows_of(log, load(None, ["fusion.method=mean", f"array.calibration={path}"]))
    for before, after in zip(plain, turned, strict=True):
        assert float(after["fused_x"]) == pytest.approx(float(before["fused_x"]) - 0.5)
        assert float(after["fused_y"]) == pytest.approx(-float(before["fused_y"]))
        assert float(after["fused_z"]) == pytest.approx(-float(before["fused_z"]))


class TestRecordings:
    @pytest.mark.parametrize("log", sorted(FIXTURES.glob("*.tlog")), ids=lambda path: path.stem)
    def test_an_autopilots_gyros_make_a_small_array(self, log):
        replay = Replay(Config(), log, Selection(end=30.0))
        estimates = [estimate for block in replay.blocks() for estimate in block]
        summary = replay.summary()
        assert (summary["sensors"], summary["dropped"]) == (3, {})
        q_nb = np.array([estimate.attitude.q_nb for estimate in estimates])
        assert np.linalg.norm(q_nb, axis=1) == pytest.approx(1.0, abs=1e-12)
        assert all(-math.pi <= wrap(e.heading.yaw) <= math.pi for e in estimates)

    def test_the_unplugged_receiver_is_found_and_scored_against_the_truth(self):
        replay = Replay(Config(), FIXTURES / "rover_sitl_gps_unplugged.tlog", Selection())
        list(replay.blocks())
        (outage,) = replay.summary()["outages"]
        assert outage["reference"] == "truth"
        assert (outage["start_s"], outage["end_s"]) == pytest.approx((73.3, 229.4), abs=0.2)
        assert 0 < outage["rmse_deg"] < 2.04  # that of EKF3 with its compass

    @pytest.mark.parametrize("log", sorted(FIXTURES.glob("*.tlog")), ids=lambda path: path.stem)
    def test_the_stated_deviation_of_yaw_is_honest(self, log):
        replay = Replay(Config(), log, Selection())
        trace: list[Errors] = []
        replay.scorer.listeners.append(trace.append)
        blocks = list(replay.blocks())
        elapsed = np.concatenate([block.elapsed for block in blocks])
        stds = np.concatenate([block.track.yaw_std for block in blocks])
        _, times, errors, _ = zip(*trace, strict=True)
        times, errors = np.concatenate(times), np.concatenate(errors)
        ratios = np.abs(errors) / np.interp(times, elapsed, stds)
        assert np.mean(ratios < 3.0) > 0.997
        assert np.sqrt(np.mean(ratios**2)) < 1.5


def a_log(path: Path, *orders: Frame, system: int = 1) -> Path:
    """Six seconds of an array and an autopilot; a ground station's orders after two."""
    vehicle = Vehicle(3)
    sent = [(1_000_000, vehicle.info())]
    for k in range(600):
        time_us = 1_000_000 + 10_000 * k
        if k % 100 == 0:
            sent.append((time_us, frame("HEARTBEAT", (system, 1), type=10, autopilot=3)))
        if k == 200:
            sent += [(time_us, order) for order in orders]
        sent.append((time_us, vehicle.epoch(time_us, (0.0, 0.0, 0.001 * k))))
    path.write_bytes(b"".join(record(time_us, one.raw) for time_us, one in sent))
    return path


def order(name: str, value: float) -> Frame:
    told = {"param_id": name.encode(), "param_value": value, "param_type": 9}
    return frame("PARAM_SET", (255, 190), target_system=1, target_component=191, **told)


def test_the_output_speaks_under_the_id_of_the_one_autopilot(tmp_path):
    replay = Replay(Config(), a_log(tmp_path / "d.tlog", system=7), Selection())
    file = io.BytesIO()
    output = OutputLog(Config(), file, replay.identity)
    for block in replay.blocks(singly=True):
        output.write(block)
    systems = [logged.frame.system for logged in TlogReader([file.getvalue()])]
    assert (systems[0], systems[-1], set(systems)) == (1, 7, {1, 7})


def test_what_a_ground_station_set_holds_but_for_what_is_chosen_now(tmp_path):
    ordered = a_log(tmp_path / "ordered.tlog", order("ATT_NOISE", 0.5))

    def final_std(log: Path, fixed: tuple[str, ...] = ()) -> float:
        *_, last = Replay(Config(), log, Selection(fixed=fixed)).blocks()
        return last.at(len(last) - 1).attitude.roll_std

    alone = final_std(a_log(tmp_path / "alone.tlog"))
    assert final_std(ordered) > 2 * alone
    assert final_std(ordered, fixed=("ATT_NOISE",)) == alone


@pytest.mark.parametrize("singly", [False, True])
def test_a_calibration_that_a_ground_station_ordered_is_done_again_to_the_bit(tmp_path, singly):
    told = {"target_system": 1, "target_component": 191, "command": 241, "param1": 1}
    calibrate = frame("COMMAND_LONG", (255, 190), **told)
    vehicle, noise = Vehicle(3), np.random.default_rng(1).normal(0, 0.005, (800, 3))
    sent = [vehicle.info()]
    sent += [vehicle.epoch(1_000_000 + 10_000 * k, noise[k]) for k in range(800)]
    sent.insert(60, calibrate)

    def replayed(frames: list[Frame]) -> np.ndarray:
        log = tmp_path / "d.tlog"
        log.write_bytes(b"".join(record(4 * k, one.raw) for k, one in enumerate(frames, 10**9)))
        blocks = Replay(Config(), log, Selection()).blocks(singly=singly)
        return np.array([estimate.attitude.q_nb for block in blocks for estimate in block])

    pipeline = Pipeline(Config(), Config().own)
    component = Component(Parameters(Config()), pipeline, Identity(1, 191, adopts=True))
    live = []
    for k, one in enumerate(sent, 10**9):
        component.receive(one, ("array", ""), 4 * k)
        for estimate in pipeline.step(one, 4 * k):
            component.observe(estimate)
            live.append(estimate.attitude.q_nb)
    assert (replayed(sent) == np.array(live)).all()
    differs = (replayed([one for one in sent if one is not calibrate]) != live).any(axis=1)
    assert int(differs.argmax()) in range(550, 570)
