"""The command: a log in, a file out, and what the file does to another log."""

import json

import mimu4444
import numpy as np
import pytest
from command import call

from risaf_link.config import load, load_calibration
from risaf_link.core.array import Calibration
from risaf_link.core.calibration import calibrate
from risaf_link.core.mounting import Readings
from risaf_link.core.rotation import matrix_from_quaternion

NONE = np.zeros((0, 3))
HALF = 1875  # epochs


def turned(seconds=12.0, amplitude=(60.0, 60.0, 60.0), sensors=6, seed=1):
    """Counts of an array that rests for five seconds and is then turned about, (k, n, 3)."""
    random = np.random.default_rng(seed)
    time_s = np.arange(0, 5 + seconds, mimu4444.PERIOD_US / 1e6)
    moving_s = np.maximum(time_s - 5.0, 0.0)
    swing = [np.sin(2 * np.pi * f * moving_s) for f in (0.4, 0.7, 1.1)]
    rate = np.radians(amplitude) * np.stack(swing, axis=1)
    backward = np.linalg.inv(np.eye(3) + 0.01 * random.standard_normal((sensors, 3, 3)))
    bias = np.radians(random.standard_normal((sensors, 3)))
    noise = np.radians(0.1) * random.standard_normal((len(time_s), sensors, 3))
    read = np.einsum("nij,kj->kni", backward, rate) + bias + noise
    return np.rint(read / mimu4444.SCALE).astype(int)


def corrected(path, rates_s):
    """Readings of another log as the pipeline would correct them, (k, n, 3)."""
    config = load(None, [f"array.calibration={path}"])
    calibration = Calibration(load_calibration(config))
    return np.array([calibration.apply(epoch, NONE)[0] for epoch in rates_s])


def apart(rates_b):
    """Standard deviation between sensors, rad/s, where all are valid.

    Of all axes; across the direction in which those of an epoch differ most; and that of the
    typical epoch.
    """
    rates_b = rates_b[np.isfinite(rates_b).all(axis=(1, 2))]
    residual = rates_b - rates_b.mean(axis=1, keepdims=True)
    n = residual.shape[1]
    squares = np.linalg.svd(residual, compute_uv=False)[:, 1:] ** 2
    across = squares.sum(axis=1) / (2 * (n - 2))
    plain = (residual**2).sum() / (3 * (n - 1) * len(residual))
    return np.sqrt(plain), np.sqrt(across.mean()), np.sqrt(np.median(across))


def test_the_file_makes_the_sensors_agree_on_another_log(tmp_path):
    log = mimu4444.write_log(tmp_path / "turned.tlog", turned())
    result = call("calibrate", log, "--out", tmp_path / "array.yaml", "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["calibrated"] == found["sensors"] == 6
    assert found["rest_s"] == pytest.approx(5.0, abs=1.0)
    raw = turned() * mimu4444.SCALE  # the same array
    before, after = apart(raw)[0], apart(corrected(tmp_path / "array.yaml", raw))[0]
    assert np.degrees(before) > 1.0
    assert np.degrees(after) == pytest.approx(0.1, rel=0.1)
    assert np.degrees(after) == pytest.approx(found["disagreement_dps"]["after"], rel=0.1)


def test_replay_takes_the_file(tmp_path):
    log = mimu4444.write_log(tmp_path / "turned.tlog", turned())
    assert call("calibrate", log, "--out", tmp_path / "array.yaml").exit_code == 0
    result = call("replay", log, "--set", f"array.calibration={tmp_path / 'array.yaml'}", "--json")
    assert json.loads(result.stdout)["epochs"] == len(turned())


def test_it_says_what_was_found_of_every_sensor(tmp_path):
    log = mimu4444.write_log(tmp_path / "turned.tlog", turned())
    result = call("calibrate", log, "--out", tmp_path / "array.yaml")
    rows = [line.split() for line in result.stdout.splitlines()]
    assert [row[0] for row in rows if row and row[0].isdecimal()][:6] == list("012345")
    assert "6 of 6 calibrated" in result.stdout
    assert "name: mimu4444" in (tmp_path / "array.yaml").read_text()


@pytest.mark.parametrize("axis", range(3))
def test_a_log_that_excites_too_little_is_refused_by_its_axis(tmp_path, axis):
    amplitude = [60.0, 60.0, 60.0]
    amplitude[axis] = 0.0
    log = mimu4444.write_log(tmp_path / "flat.tlog", turned(amplitude=amplitude))
    result = call("calibrate", log, "--out", tmp_path / "array.yaml")
    assert result.exit_code == 3
    assert result.stderr.count("\n") == 1
    assert f"not turned about enough: {'xyz'[axis]} by 0." in result.stderr
    assert not (tmp_path / "array.yaml").exists()


def test_a_log_without_samples_or_of_rest_alone_is_refused(tmp_path):
    empty = tmp_path / "empty.tlog"
    empty.write_bytes(b"")
    still = mimu4444.write_log(tmp_path / "still.tlog", turned(seconds=0.0))
    for log, reason in ((empty, "no gyro samples"), (still, "at rest throughout")):
        result = call("calibrate", log, "--out", tmp_path / "array.yaml")
        assert result.exit_code == 3
        assert reason in result.stderr


def test_a_file_that_cannot_be_written_is_said(tmp_path):
    log = mimu4444.write_log(tmp_path / "turned.tlog", turned())
    result = call("calibrate", log, "--out", tmp_path / "nowhere" / "array.yaml")
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == [log]


def test_mountings_of_a_calibration_that_is_there_are_kept(tmp_path):
    mountings = [f"  - {{mounting: {[0, 1, 0, 0] if i % 2 else [1, 0, 0, 0]}}}" for i in range(6)]
    (tmp_path / "known.yaml").write_text("\n".join(["gyros:", *mountings]))
    read = turned()
    read[:, 1::2] *= [1, -1, -1]
    log = mimu4444.write_log(tmp_path / "turned.tlog", read)
    known = f"array.calibration={tmp_path / 'known.yaml'}"
    result = call("calibrate", log, "--out", tmp_path / "new.yaml", "--set", known, "--json")
    assert result.exit_code == 0, result.output
    quaternions = np.array([gyro["mounting"] for gyro in json.loads(result.stdout)["gyros"]])
    assert np.abs(quaternions[1::2, 1]).min() > 0.999
    assert quaternions[::2, 0].min() > 0.999


def test_the_real_board_calibrated_on_half_of_its_motion_agrees_in_the_other(tmp_path):
    read = mimu4444.counts("exp_5_last")
    log = mimu4444.write_log(tmp_path / "first.tlog", read[:HALF])
    result = call("calibrate", log, "--out", tmp_path / "board.yaml", "--json")
    assert result.exit_code == 0, result.output
    others = mimu4444.rates("exp_5_last")[HALF:3600]  # without the rest at the end
    mounted = np.einsum("nij,knj->kni", mimu4444.NOMINAL, others)
    plain, across, typical = apart(mounted)
    after_plain, after_across, after_typical = apart(corrected(tmp_path / "board.yaml", others))
    assert 10.0 < np.degrees(plain) < 28.0
    # What clocks of their own make, up to half a millisecond at 50000 deg/s^2, no constant takes
    # off; the rest falls tenfold, but for epochs next to saturated ones in the mean square.
    assert after_typical < typical / 10
    assert after_across < across / 8
    assert after_plain < 0.8 * plain
    found = [gyro["mounting"] for gyro in json.loads(result.stdout)["gyros"]]
    rotations = matrix_from_quaternion(np.array(found))
    assert np.abs(rotations - mimu4444.NOMINAL).max() < 0.02


def test_two_recordings_of_the_board_tell_the_same_scale():
    violent = calibrate(Readings(np.arange(3750) / 62.5, mimu4444.rates("exp_5_last")))
    gentle = calibrate(Readings(np.arange(3750) / 62.5, mimu4444.rates("exp_6_first")))
    assert gentle.rest == pytest.approx(57.0, abs=1.0)
    error = (gentle.scale - violent.scale) / np.hypot(gentle.scale_std, violent.scale_std)
    assert np.sqrt(np.mean(error**2)) < 1.8  # 24 numbers, at 30 and at 900 deg/s
    assert np.abs(gentle.scale - violent.scale).max() < 0.01
