"""The command line, as a user types it."""

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from command import call

from risaf_link import __version__
from risaf_link.core.kernel import BUILT
from risaf_link.mavlink.dialect import pack
from risaf_link.mavlink.frame import encode
from risaf_link.mavlink.tlog import record

ROOT = Path(__file__).parents[1]
DRIVE = ROOT / "sitl_fixtures" / "rover_sitl_fixture.tlog"


def assert_one_line(result: Result, status: int, *parts: str) -> None:
    assert result.exit_code == status, result.output
    assert result.stderr.count("\n") == 1
    for part in parts:
        assert part in result.stderr


def test_version():
    kernel = "kernel built" if BUILT else "no kernel, NumPy alone"
    assert call("--version").stdout == f"risaf-link, version {__version__} ({kernel})\n"


@pytest.mark.parametrize(
    "command",
    [
        *("run", "replay", "simulate", "inspect", "calibrate", "check-config", "bench"),
        *("monitor", "demo"),
    ],
)
def test_every_command_has_help_with_an_example(command):
    result = call(command, "--help")
    assert result.exit_code == 0
    assert f"  risaf-link {command}" in result.stdout


def test_replay_prints_one_json_object_with_what_was_promised():
    result = call("replay", DRIVE, "--json", "--outage", "20:30")
    summary = json.loads(result.stdout)
    assert set(summary) >= {
        *("frames", "dropped", "epochs", "epochs_incomplete", "samples_lost", "sensors"),
        *("duration_s", "realtime_factor", "heading", "outages"),
    }
    assert set(summary["heading"]) == {"fused", "rejected"}
    assert set(summary["outages"][0]) == {
        *("start_s", "end_s", "reference"),
        *("rmse_deg", "final_deg", "max_deg", "drift_deg_per_min"),
    }


def test_replay_leaves_a_tlog_a_csv_and_a_plot_behind(tmp_path):
    out, table, plot = (tmp_path / name for name in ("a.tlog", "a.csv", "a.png"))
    result = call("replay", DRIVE, "--out", out, "--csv", table, "--plot", plot)
    assert result.exit_code == 0
    assert "deg RMS" in result.stdout
    assert table.read_text().startswith("time_us,q_w,q_x,q_y,q_z,roll,pitch,yaw,fused_x")
    assert plot.read_bytes().startswith(b"\x89PNG")
    dump = subprocess.run(
        [sys.executable, "-m", "pymavlink.tools.mavlogdump", "--types", "ATTITUDE_QUATERNION", out],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "MAVLINK20": "1"},
    )
    assert len(re.findall(r"ATTITUDE_QUATERNION \{time_boot_ms", dump.stdout)) > 1000


def test_replay_goes_at_the_speed_that_was_asked_for():
    began = time.monotonic()
    call("replay", DRIVE, "--end", "8", "--speed", "10")
    assert time.monotonic() - began >= 0.7


def test_simulate_then_replay(tmp_path):
    log = tmp_path / "circle.tlog"
    options = ("--duration", 20, "--sensors", 12, "--rate", 50)
    assert call("simulate", "circle", "--seed", 1, "--out", log, *options).exit_code == 0
    summary = json.loads(call("replay", log, "--outage", "10:20", "--json").stdout)
    assert (summary["sensors"], summary["epochs"], summary["samples_lost"]) == (12, 1000, 0)
    assert {row["reference"] for row in summary["outages"]} == {"truth", "gps"}


def test_faults_of_the_sensors_can_be_switched(tmp_path):
    logs = {faults: tmp_path / f"{faults}.tlog" for faults in ("none", "default", "scale")}
    for faults, log in logs.items():
        options = ("--duration", 2, "--faults", faults, "--out", log)
        assert call("simulate", "circle", "--seed", 1, *options).exit_code == 0
    assert len({log.read_bytes() for log in logs.values()}) == 3


def test_inspect_says_what_is_there_and_what_can_be_done_with_it():
    text = call("inspect", DRIVE).stdout
    assert re.search(r"1 +1 +RAW_IMU +1537 +50\.0", text)
    assert "3 sensors from IMU" in text
    assert "truth from SIM_STATE" in text


def test_check_config_prints_the_whole_configuration():
    text = call("check-config", ROOT / "config" / "risaf_link.yaml").stdout
    assert "alpha: 0.995" in text


def mistakes() -> dict[str, bytes]:
    log = bytearray(DRIVE.read_bytes()[:200_000])
    generator = np.random.default_rng(1)
    flipped = bytearray(log)
    for place in generator.integers(0, len(log), 2000):
        flipped[place] ^= 1 << int(generator.integers(8))
    return {
        "empty": b"",
        "one_byte": b"\xfd",
        "random": generator.bytes(300_000),
        "text": b"this is no log\n" * 1000,
        "zeros": bytes(100_000),
        "truncated": bytes(log[:100_003]),
        "flipped": bytes(flipped),
        "headless": bytes(log[1234:]),
    }


@pytest.mark.parametrize("command", ["replay", "inspect"])
@pytest.mark.parametrize(
    ("kind", "status"),
    [
        *(("empty", 3), ("one_byte", 3), ("random", 3), ("text", 3), ("zeros", 3)),
        *(("truncated", 0), ("flipped", 0), ("headless", 0)),
    ],
)
def test_a_bad_log_gives_what_it_holds_or_one_line(tmp_path, command, kind, status):
    log = tmp_path / f"{kind}.tlog"
    log.write_bytes(mistakes()[kind])
    result = call(command, log)
    assert result.exit_code == status, result.output
    if status:
        assert_one_line(result, 3, str(log), "expected")
    else:
        assert "3 sensors" in result.stdout


@pytest.mark.parametrize("command", ["replay", "inspect", "monitor"])
def test_a_log_that_cannot_be_opened_gives_one_line(tmp_path, command):
    assert_one_line(call(command, tmp_path / "none.tlog"), 3, "none.tlog: No such file")
    assert_one_line(call(command, tmp_path), 3, "Is a directory")


def test_a_log_without_samples_says_what_would_do(tmp_path):
    system_time = pack("SYSTEM_TIME", time_unix_usec=0, time_boot_ms=5)
    log = tmp_path / "quiet.tlog"
    log.write_bytes(record(1_700_000_000_000_000, encode(*system_time, 0, 1, 1)))
    assert_one_line(call("replay", log), 3, "1 frames but no gyro samples", "DEBUG_FLOAT_ARRAY")


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["replay", DRIVE, "--set", "fusion.gaet=1"], ["fusion.gaet: unknown key; known: method"]),
        (["replay", DRIVE, "--config", "none.yaml"], ["none.yaml: No such file"]),
        (["replay", DRIVE, "--out", "/nowhere/out.tlog"], ["/nowhere/out.tlog: No such file"]),
        (
            ["simulate", "cricle", "--seed", 1, "--out", "x"],
            ["'cricle', expected one of circle, drive1"],
        ),
        (["simulate", "circle", "--seed", 1, "--live", "udp://x:1"], ["'udp://x:1' found"]),
        (["monitor", "udp://x:1"], ["URL: 'udp://x:1' found, one of"]),
        (["run", "--set", "links=[{name: a, url: x}]"], ["links.0.url: a: 'x' found, one of"]),
        (["check-config", "none.yaml"], ["none.yaml: No such file"]),
    ],
)
def test_the_users_mistake_gives_one_line_and_status_2(arguments, parts):
    assert_one_line(call(*arguments), 2, *parts)


@pytest.mark.parametrize(
    "arguments",
    [
        ["replay", DRIVE, "--outage", "9:3"],
        ["simulate", "circle"],
        ["monitor", DRIVE, "--listen", "here"],
        ["demo", "--listen", "127.0.0.1:99999"],
    ],
)
def test_wrong_arguments_give_status_2(arguments):
    assert call(*arguments).exit_code == 2
