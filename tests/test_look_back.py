"""What is told of a run afterwards: the page, the MCAP, the pictures."""

import csv
import json
import math
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import call
from logs import simulated
from matplotlib.colors import to_rgb
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation
from vehicle import SCALE, Vehicle

from risaf_link.config import Config, load
from risaf_link.core.health import Reason, SensorState
from risaf_link.judgement import heading_verdict, sensor_rows
from risaf_link.mavlink.dialect import name_of
from risaf_link.mavlink.frame import Frame, FrameParser, encode
from risaf_link.mavlink.tlog import TlogReader, record
from risaf_link.publish import plot
from risaf_link.publish.album import Album
from risaf_link.publish.course import Course
from risaf_link.publish.mcap_schemas import SCHEMAS
from risaf_link.replay import Replay, Selection
from risaf_link.report import page, shaded

HOSTILE = "<script>alert(1)</script>"
START_US = 1_800_000_000_000_000
PICTURES = ("heading", "errors", "innovations", "biases", "rates", "tilt", "health", "array")


class Page(HTMLParser):
    """What a browser would show, and what it would run."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.rows: list[list[str]] = []
        self.words = ""
        self._skips = self._in_cell = False
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        self._skips = tag in {"style", "script"}
        if tag == "tr":
            self.rows.append([])
        if tag in {"td", "th"}:
            self.rows[-1].append("")
            self._in_cell = True

    def handle_endtag(self, tag):
        self._skips = False
        self._in_cell &= tag not in {"td", "th"}

    def handle_data(self, data):
        if self._skips:
            return
        self.words += data
        if self._in_cell:
            self.rows[-1][-1] += data

    @property
    def text(self) -> str:
        return " ".join(self.words.split())


def reported(log: Path, directory: Path, *options: object) -> tuple[dict[str, Any], Page]:
    """The summary as JSON, and the page on the same replay."""
    result = call("replay", log, "--json", "--report", directory, *options)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout), Page((directory / "report.html").read_text())


def followed(log: Path, selection: Selection | None = None, singly: bool = False) -> Any:
    """A replay that has ended, and its course."""
    replay, course = Replay(Config(), log, selection or Selection()), Course()
    replay.scorer.listeners.append(course.take_errors)
    for block in replay.blocks(singly=singly):
        course.take(block)
    course.finish()
    return replay, course


def written(path: Path, frames: list[tuple[int, Frame]]) -> Path:
    path.write_bytes(b"".join(record(START_US + time_us, frame.raw) for time_us, frame in frames))
    return path


def epochs(vehicle: Vehicle, start_s: float, end_s: float, rates: Any) -> list[tuple[int, Frame]]:
    """Epochs at 100 Hz, with noise; `rates` makes of a noise (sensors, 3) what is read."""
    generator = np.random.default_rng(round(10 * start_s))
    found = []
    for k in range(round(100 * start_s), round(100 * end_s)):
        noise = 20 * SCALE * generator.standard_normal((vehicle.sensors, 3))
        if k % 100 == 0:
            found.append((10_000 * k, vehicle.info()))
        found.append((10_000 * k, vehicle.epoch(10_000 * (k + 1), rates(noise))))
    return found


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("look") / "drive.tlog", duration=16.0)


@pytest.fixture(scope="module")
def without_truth(drive, tmp_path_factory):
    return dropping(drive, tmp_path_factory.mktemp("look") / "real.tlog", {"HIL_STATE_QUATERNION"})


def dropping(log: Path, path: Path, names: set[str]) -> Path:
    """The same log without some messages."""
    records = TlogReader([log.read_bytes()])
    kept = ((t, f) for t, f in records if name_of(f.message_id) not in names)
    path.write_bytes(b"".join(record(t, f.raw) for t, f in kept))
    return path


# The page


def test_the_numbers_of_the_page_are_those_of_the_json(drive, tmp_path):
    summary, page = reported(drive, tmp_path / "r", "--outage", "8:14")
    assert [row["reference"] for row in summary["outages"]] == ["truth", "gps"]
    for row, reference in zip(summary["outages"], ("truth", "withheld GPS"), strict=True):
        numbers = [row[f"{name}_deg"] for name in ("rmse", "final", "max")]
        drift = row["drift_deg_per_min"]
        shown = [f"{number:.2f}" for number in (*numbers, drift)]
        assert ["8.0", "14.0", reference, *shown] in page.rows
    heading = summary["heading"]
    said = f"{heading['fused']} GPS headings were fused and {heading['rejected']} rejected."
    assert said in page.text
    assert f"it is off by {summary['truth']['rmse_deg']:.2f} deg RMS" in page.text
    assert f"{summary['epochs']} epochs, {summary['epochs_incomplete']} of them" in page.text
    assert f"{summary['frames']} frames were read, none dropped" in page.text


def test_the_page_is_one_file_that_runs_nothing_and_loads_nothing(drive, tmp_path):
    _, page = reported(drive, tmp_path / "r")
    assert [path.name for path in (tmp_path / "r").iterdir()] == ["report.html"]
    tags = [tag for tag, _ in page.tags]
    assert not {"script", "link", "iframe", "object"} & set(tags)
    urls = [a[name] for _, a in page.tags for name in ("src", "srcset", "href") if name in a]
    assert len(urls) == 2 * len(PICTURES)
    assert all(url.startswith("data:image/png;base64,") for url in urls)


def test_hostile_names_are_shown_as_they_are(drive, tmp_path):
    log = tmp_path / "<img src=x onerror=alert(1)>$x^{.tlog"
    log.write_bytes(drive.read_bytes())
    _, found = reported(log, tmp_path / "r", "--plot", tmp_path / "p.png")
    assert log.name in found.text
    assert not [a for tag, a in found.tags if tag == "img" and a.get("src") == "x"]
    replay, course = followed(drive)
    shown = page(log, Config(), replay.summary(), course, HOSTILE)
    assert HOSTILE not in shown
    assert f"of the array “{HOSTILE}”" in Page(shown).text


@pytest.mark.parametrize("name", PICTURES)
def test_every_picture_is_shaded_where_the_json_has_an_outage(drive, name):
    replay, course = followed(drive, Selection(outages=((6.0, 8.0), (11.0, 14.0))))
    outages = shaded(replay.summary())
    assert outages == [(6.0, 8.0), (11.0, 14.0)]
    with plot.styled():
        figure = getattr(Album(course, outages), name)()
    for axes in figure.axes:
        assert spans(axes, plot.ORANGE) == outages


def spans(axes: Any, colour: str) -> list[tuple[float, float]]:
    """Stretches of time that are shaded."""
    found = []
    for patch in axes.patches:
        if to_rgb(patch.get_facecolor()) == to_rgb(colour):
            across = patch.get_path().transformed(patch.get_patch_transform()).vertices[:, 0]
            found.append((across.min(), across.max()))
    return found


def test_without_truth_the_page_claims_no_error(without_truth, tmp_path):
    summary, page = reported(without_truth, tmp_path / "r")
    assert summary["truth"]["rmse_deg"] is None
    assert "The log has nothing to compare it with." in page.text
    assert "off truth" not in page.text
    assert "Innovations, squared and over their variance" in page.text


def test_without_gps_the_page_says_that_there_is_no_heading(drive, tmp_path):
    log = dropping(drive, tmp_path / "blind.tlog", {"GPS_RAW_INT"})
    summary, page = reported(log, tmp_path / "r")
    assert summary["heading"] == {"fused": 0, "rejected": 0}
    assert "There is no heading. Yaw was never known: no GPS heading came." in page.text
    assert "Innovations" not in page.text
    assert "Roll and pitch" in page.text


def test_an_outage_without_a_reference_has_a_row_without_numbers(without_truth, tmp_path):
    log = dropping(without_truth, tmp_path / "lost.tlog", set())
    records = list(TlogReader([log.read_bytes()]))
    begun_us = records[0].time_us
    kept = [r for r in records if r.frame.message_id != 24 or r.time_us < begun_us + 6_000_000]
    log.write_bytes(b"".join(record(t, f.raw) for t, f in kept))
    summary, page = reported(log, tmp_path / "r")
    (outage,) = summary["outages"]
    ends = [f"{outage['start_s']:.1f}", f"{outage['end_s']:.1f}"]
    assert [*ends, "nothing to compare with", *["–"] * 4] in page.rows  # noqa: RUF001


def test_a_calibration_of_another_array_leaves_one_line_and_no_page(drive, tmp_path):
    calibration = tmp_path / "other.yaml"
    calibration.write_text("name: other\ngyros:\n" + "  - {}\n" * 20)
    setting = f"array.calibration={calibration}"
    result = call("replay", drive, "--set", setting, "--report", tmp_path / "r")
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert "the calibration is for array 'other', this is 'sim-circle'" in result.stderr
    assert not (tmp_path / "r").exists()


def test_an_array_that_is_exchanged_on_the_way_is_told(tmp_path):
    vehicle = Vehicle(sensors=3)
    frames = epochs(vehicle, 0.0, 2.0, lambda noise: noise)
    other = vehicle.info().payload.replace(b"bench", b"spare")
    exchanged = [
        (t, f if f.message_id != vehicle.info().message_id else _with(f, other))
        for t, f in epochs(vehicle, 2.0, 4.0, lambda noise: noise)
    ]
    log = written(tmp_path / "exchanged.tlog", frames + exchanged)
    calibration = tmp_path / "bench.yaml"
    calibration.write_text("name: bench\ngyros:\n" + "  - {}\n" * 3)
    summary, page = reported(log, tmp_path / "r", "--set", f"array.calibration={calibration}")
    assert summary["mismatch"] == "the calibration is for array 'bench', this is 'spare'"
    assert summary["duration_s"] == pytest.approx(2.0, abs=0.1)
    assert f"From some epochs there are no estimates: {summary['mismatch']}" in page.text


def _with(frame: Frame, payload: bytes) -> Frame:
    raw = encode(frame.message_id, payload, frame.sequence, frame.system, frame.component)
    (made,) = FrameParser().receive_data(raw)
    return made


def test_a_sensor_that_falls_silent_is_named_with_its_time(tmp_path):
    vehicle = Vehicle(sensors=8)

    def silent(noise):
        noise[5] = np.nan
        return noise

    frames = epochs(vehicle, 0.0, 6.0, lambda noise: noise) + epochs(vehicle, 6.0, 12.0, silent)
    log = written(tmp_path / "silent.tlog", frames)
    replay, course = followed(log)
    (row,) = sensor_rows(course)
    assert (row.sensor, row.reason) == (5, "silent")
    assert row.first == pytest.approx(6.0, abs=1.5)  # a block is as long
    assert row.dead == pytest.approx(5.0, abs=1.5)
    assert course.health.values[-1, 5] == 8 * SensorState.DEAD + Reason.SILENT
    assert (course.health.values[:, :5] == 0).all()  # no moment is left out
    shown = Page(page(log, Config(), replay.summary(), course, replay.array_name))
    assert "Healthy throughout: 7 of 8. Dead for some time: 5 (silent)." in shown.text


def test_a_gap_in_the_samples_is_told_and_shaded(tmp_path):
    vehicle = Vehicle()
    parts = [epochs(vehicle, *span, lambda noise: noise) for span in ((0.0, 4.0), (7.0, 10.0))]
    log = written(tmp_path / "gap.tlog", parts[0] + parts[1])
    replay, course = followed(log)
    (gap,) = course.gaps
    assert gap == pytest.approx((3.99, 7.0), abs=0.05)
    assert [event.text for event in course.events] == ["no samples for 3.0 s"]
    with plot.styled():
        for name in PICTURES[:2]:
            (axes,) = getattr(Album(course, []), name)().axes
            assert spans(axes, "#BDBDBD") == [gap]
    assert (
        "No samples from 4.0 to 7.0 s."
        in Page(page(log, Config(), replay.summary(), course, "")).text
    )


def test_epoch_by_epoch_the_course_is_the_same(drive):
    _, course = followed(drive, Selection(end=8.0))
    _, single = followed(drive, Selection(end=8.0), singly=True)
    assert single.most.values == pytest.approx(course.most.values, nan_ok=True)
    assert single.innovations.rows == pytest.approx(course.innovations.rows)
    assert single.epochs.values.sum() == course.epochs.values.sum() > 390


def test_a_heading_that_is_off_by_more_than_stated_is_to_be_used_with_care(drive):
    replay, course = followed(drive)
    summary = replay.summary()
    sure = heading_verdict(summary, course)
    course.errors["truth"].within[:] = 0
    doubtful = heading_verdict(summary, course)
    assert (sure.trust, doubtful.trust) == ("good", "care")
    assert doubtful.sentences[0] == "It is off by more than stated too often, against truth."


def test_withheld_gps_is_no_judge_of_what_the_heading_states(drive):
    replay, course = followed(drive, Selection(outages=((8.0, 14.0),)))
    course.errors["gps"].within[:] = 0
    verdict = heading_verdict(replay.summary(), course)
    assert verdict.trust == "good"
    assert any("0 % within three; GPS errs as well." in said for said in verdict.sentences)


def test_many_rejected_headings_are_told_first(drive):
    replay, course = followed(drive)
    summary = replay.summary()
    summary["heading"] = {"fused": 80, "rejected": 20}
    verdict = heading_verdict(summary, course)
    assert (verdict.trust, verdict.sentences[0]) == (
        "care",
        "20 % of the GPS headings were rejected.",
    )


def test_the_share_of_errors_within_what_is_stated_is_counted(drive):
    replay, course = Replay(Config(), drive, Selection()), Course()
    ratios = []
    replay.scorer.listeners += [
        course.take_errors,
        lambda errors: ratios.extend(np.abs(errors.error) / errors.std),
    ]
    for block in replay.blocks():
        course.take(block)
    course.finish()
    expected = [int((np.array(ratios) <= factor).sum()) for factor in (1, 2, 3)]
    assert course.errors["truth"].within.tolist() == expected


def test_the_deviation_of_the_bias_starts_as_configured_and_shrinks(without_truth):
    for form in ("eskf", "paper"):
        config = load(None, [f"attitude.filter={form}", "attitude.initial_bias_std=0.02"])
        blocks = Replay(config, without_truth, Selection()).blocks()
        std = [estimate.attitude.bias_std for block in blocks for estimate in block]
        assert std[0] == pytest.approx(np.full(3, 0.02), rel=0.05)
        assert std[-1][2] < 0.5 * std[0][2]


def test_a_report_goes_into_a_directory_only(drive, tmp_path):
    (tmp_path / "file").write_text("")
    result = call("replay", drive, "--report", tmp_path / "file")
    assert result.exit_code == 2
    assert "found a file, expected a directory" in result.stderr


@pytest.mark.parametrize(
    ("option", "package", "extra"),
    [("--report", "jinja2", "plot"), ("--plot", "matplotlib", "plot"), ("--mcap", "mcap", "mcap")],
)
def test_without_a_package_one_line_says_which_extra(
    drive, tmp_path, monkeypatch, option, package, extra
):
    monkeypatch.setitem(sys.modules, package, None)
    result = call("replay", drive, option, tmp_path / "x")
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
    assert f"install risaf-link with the extra `{extra}`" in result.stderr
    assert not (tmp_path / "x").exists()


# MCAP


def messages(path: Path) -> dict[str, list[tuple[Any, dict[str, Any]]]]:
    """Of each topic, its messages: as recorded, and what they say."""
    found: dict[str, list[tuple[Any, dict[str, Any]]]] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            found.setdefault(channel.topic, []).append((message, json.loads(message.data)))
    return found


@pytest.fixture(scope="module")
def written_twice(drive, tmp_path_factory):
    """One replay as JSON, CSV and MCAP."""
    directory = tmp_path_factory.mktemp("mcap")
    out, table = directory / "d.mcap", directory / "d.csv"
    options = ("--mcap", out, "--csv", table, "--outage", "8:14", "--json")
    result = call("replay", drive, *options)
    assert result.exit_code == 0, result.output
    with table.open() as file:
        return json.loads(result.stdout), list(csv.DictReader(file)), messages(out), out


def test_mcap_and_csv_of_one_replay_have_equal_values(written_twice):
    _, rows, found, _ = written_twice
    assert len(found["/attitude"]) == len(found["/fused_rate"]) == len(rows)
    names = [f"{part}_{axis}" for part in ("fused", "fused_var", "active") for axis in "xyz"]
    for row, (_, attitude), (_, rate) in zip(
        rows, found["/attitude"], found["/fused_rate"], strict=True
    ):
        for said in (attitude, rate):
            assert said["time_us"] == int(row["time_us"])
        for name in ("q_w", "q_x", "q_y", "q_z"):
            assert attitude[name] == float(row[name])
        for name in ("roll", "pitch", "yaw"):
            for part in (name, f"{name}_std"):
                assert attitude[f"{part}_deg"] == pytest.approx(math.degrees(float(row[part])))
        for name in names:
            assert rate[name] == float(row[name])
    by_time = {int(row["time_us"]): row for row in rows}
    for _, bias in found["/bias"]:
        row = by_time[bias["time_us"]]
        assert all(bias[f"bias_{axis}"] == float(row[f"bias_{axis}"]) for axis in "xyz")
    for _, heading in found["/heading"]:
        row = by_time[heading["time_us"]]
        assert heading["heading_state"] == row["heading_state"]
        assert heading["yaw_std_deg"] == pytest.approx(math.degrees(float(row["yaw_std"])))


def test_innovations_and_errors_in_the_mcap_are_those_of_the_json(written_twice):
    summary, _, found, _ = written_twice
    fused = [said["fused"] for _, said in found["/innovation"]]
    assert fused.count(True) == summary["heading"]["fused"]
    assert fused.count(False) == summary["heading"]["rejected"]
    for _, said in found["/innovation"]:
        ratio = abs(said["innovation_deg"]) / (said["gate"] * said["std_deg"])
        assert said["test_ratio"] == pytest.approx(ratio)
    errors = [m["error_deg"] for _, m in found["/heading_error"] if m["reference"] == "truth"]
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(
        summary["truth"]["rmse_deg"], abs=1e-4
    )


def test_messages_are_logged_when_they_were_received_and_published_by_the_vehicles_clock(
    written_twice, drive
):
    _, _, found, _ = written_twice
    received_ns = {1000 * r.time_us for r in TlogReader([drive.read_bytes()])}
    for message, said in found["/attitude"]:
        assert message.log_time in received_ns
        assert message.publish_time == 1000 * said["time_us"]  # one clock in this log
    truth = found["/truth"]
    assert len(truth) > 100
    assert all(message.publish_time == 1000 * said["time_us"] for message, said in truth)


def test_every_message_is_as_its_schema_says(written_twice):
    *_, found, out = written_twice
    kinds = {"number": (int, float), "integer": int, "string": str, "boolean": bool}

    def check(value: Any, schema: dict[str, Any]) -> None:
        if schema["type"] == "object":
            assert set(value) <= set(schema["properties"])
            for name, each in value.items():
                check(each, schema["properties"][name])
        elif schema["type"] == "array":
            for each in value:
                check(each, schema["items"])
        else:
            assert isinstance(value, kinds[schema["type"]])

    with out.open("rb") as file:
        summary = make_reader(file).get_summary()
    schemas = {c.topic: summary.schemas[c.schema_id] for c in summary.channels.values()}
    assert set(schemas) == set(SCHEMAS) == set(found)
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
    for topic, said in found.items():
        schema = json.loads(schemas[topic].data)
        assert schemas[topic].encoding == "jsonschema"
        assert schema["title"] in schemas[topic].name
        for _, message in said:
            check(message, schema)


def test_the_poses_turn_body_to_ned_to_east_north_up(written_twice):
    *_, found, _ = written_twice
    attitudes = {message.log_time: said for message, said in found["/attitude"]}

    def matrix(q: dict[str, float]) -> np.ndarray:
        return Rotation.from_quat([q["x"], q["y"], q["z"], q["w"]]).as_matrix()

    assert len(found["/tf"]) > 300
    for message, said in found["/tf"][::20]:
        enu, body = said["transforms"]
        assert (enu["parent_frame_id"], enu["child_frame_id"]) == ("enu", "ned")
        assert (body["parent_frame_id"], body["child_frame_id"]) == ("ned", "body")
        ahead = matrix(enu["rotation"]) @ matrix(body["rotation"]) @ np.array([1.0, 0.0, 0.0])
        attitude = attitudes[message.log_time]
        yaw, pitch = (math.radians(attitude[f"{name}_deg"]) for name in ("yaw", "pitch"))
        flat = math.cos(pitch)
        expected = [flat * math.sin(yaw), flat * math.cos(yaw), math.sin(pitch)]
        assert ahead == pytest.approx(expected, abs=1e-9)


def test_what_happens_is_in_the_mcap(written_twice):
    *_, found, _ = written_twice
    texts = [said["message"] for _, said in found["/events"]]
    assert any(text.startswith("heading aligned") for text in texts)
    assert "GPS lost: heading by dead reckoning" in texts
