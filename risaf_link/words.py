"""Findings in words, for a terminal."""

import io
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from risaf_link.core.rotation import Floats
from risaf_link.survey import MessageCount, Survey, paces, verdict

MOST_GAPS = 20
PARTS, WIDE = 32, 500  # of a log's time, in a line of a table and of a picture
BARS = " ▁▂▃▄▅▆▇█"
FULL_BAR = 6  # that of the median rate: there is room above
MOST_OUTAGES = 3  # in a line of a table
MARKS = {"truth": "", "gps": " (GPS)"}
FLEET = (
    *("log", "duration s", "epochs", "sensors", "fused", "rejected"),
    *("x real time", "RMS deg", "without GPS"),
)
REFERENCES = {"truth": "truth", "gps": "withheld GPS", None: "nothing to compare with"}


def summary_text(log: Path, summary: dict[str, Any]) -> str:
    """What a replay found."""
    heading, truth = summary["heading"], summary["truth"]
    lines = [
        f"{log}: {summary['frames']} frames, {_count(sum(summary['dropped'].values()))} dropped",
        f"{summary['epochs']} epochs of {summary['sensors']} sensors in "
        f"{summary['duration_s']:.1f} s, {summary['epochs_incomplete']} incomplete, "
        f"{summary['samples_lost']} samples lost; {summary['realtime_factor']:.0f} x real time",
        f"GPS headings: {heading['fused']} fused, {heading['rejected']} rejected",
    ]
    if truth["rmse_deg"] is not None:
        lines.append(
            f"heading against truth, GPS or not: {truth['rmse_deg']:.2f} deg RMS, "
            f"{truth['max_deg']:.2f} deg at most"
        )
    if not summary["outages"]:
        lines.append("no outage of GPS")
    lines += map(_outage_line, summary["outages"])
    if summary["mismatch"]:
        lines.append(f"no estimates from some epochs: {summary['mismatch']}")
    return "\n".join(lines)


def _outage_line(outage: dict[str, Any]) -> str:
    line = f"without GPS from {outage['start_s']:.1f} to {outage['end_s']:.1f} s, against "
    line += REFERENCES[outage["reference"]]
    if outage["rmse_deg"] is not None:
        line += (
            f": {outage['rmse_deg']:.2f} deg RMS, {outage['final_deg']:.2f} deg at the end, "
            f"{outage['max_deg']:.2f} deg at most, {outage['drift_deg_per_min']:.2f} deg/min"
        )
    return line


def fleet_text(rows: list[dict[str, Any]]) -> str:
    """What replays of many logs found, or why there is nothing: a line each."""
    lines = [FLEET, *map(_fleet_line, rows)]
    whole = [line for line in lines if len(line) == len(FLEET)]
    widths = [max(map(len, column)) for column in zip(*whole, strict=True)]
    name = max(len(line[0]) for line in lines)
    texts = [
        "  ".join([line[0].ljust(name), *map(str.rjust, line[1:], widths[1:])])
        if len(line) == len(FLEET)
        else f"{line[0].ljust(name)}  {line[1]}"
        for line in lines
    ]
    explained = (
        "RMS deg: of heading, against truth; without GPS: the same in each outage, (GPS) against "
        "what was withheld"
    )
    return "\n".join([*texts, explained])


def _fleet_line(row: dict[str, Any]) -> tuple[str, ...]:
    if "error" in row:
        return row["log"], row["error"]
    rmse = row["truth"]["rmse_deg"]
    return (
        row["log"],
        f"{row['duration_s']:.1f}",
        *(str(row[name]) for name in ("epochs", "sensors")),
        *(str(row["heading"][name]) for name in ("fused", "rejected")),
        f"{row['realtime_factor']:.0f}",
        "-" if rmse is None else f"{rmse:.2f}",
        _outages(row["outages"]),
    )


def _outages(rows: list[dict[str, Any]]) -> str:
    """RMSE of each outage, deg: against truth where there is one."""
    best: dict[tuple[float, float], dict[str, Any]] = {}
    for row in sorted(rows, key=lambda row: row["reference"] != "truth"):
        best.setdefault((row["start_s"], row["end_s"]), row)
    texts = [
        "-" if row["rmse_deg"] is None else f"{row['rmse_deg']:.2f}{MARKS[row['reference']]}"
        for _, row in sorted(best.items())
    ]
    more = len(texts) - MOST_OUTAGES
    return (", ".join(texts[:MOST_OUTAGES]) or "-") + (f" and {more} more" if more > 0 else "")


def survey_text(log: Path, found: Survey) -> str:
    """What is in a log."""
    names = ("system", "component", "message", "count", "Hz", "over time")
    table = Table(*names, box=None, header_style="bold")
    for column in table.columns[3:5]:
        column.justify = "right"
    for (system, component, name), message in sorted(found.messages.items()):
        rate = f"{message.rate:.1f}" if message.rate else ""
        bars = _bars(message, found.duration)
        table.add_row(str(system), str(component), name, str(message.count), rate, bars)
    lost = ", ".join(f"{n} of {s}/{c}" for (s, c), n in sorted(found.frames_lost.items()) if n)
    assembly = found.assembly
    gps = found.gps
    lines = [
        f"{log}: {found.duration:.1f} s, {sum(m.count for m in found.messages.values())} frames",
        f"dropped: {_reasons(found.dropped)}; {found.bytes_skipped} bytes outside of frames; "
        f"{found.stamps_replaced} stamps not believed",
        f"missing by sequence number: {lost or 'none'}",
        _text(table),
        f"array: {found.sensors} sensors from {found.encoding or 'nothing'}, "
        f"{assembly['epochs']} epochs at {found.epoch_rate:.1f} Hz, "
        f"{assembly['incomplete']} incomplete, {assembly['samples_lost']} samples lost",
        *(f"gap of {length:.1f} s at {start:.1f} s" for start, length in found.gaps[:MOST_GAPS]),
        *([f"and {len(found.gaps) - MOST_GAPS} gaps more"] if len(found.gaps) > MOST_GAPS else []),
        f"GPS: {gps.fixes} fixes, {gps.with_course} with course, {gps.with_yaw} with yaw, "
        f"up to {gps.fastest:.1f} m/s",
        f"not used: {_reasons(found.unused)}",
        verdict(found),
    ]
    return "\n".join(lines)


def calibration_text(log: Path, found: dict[str, Any]) -> str:
    """What a calibration found: of each sensor, the axis that is farthest off."""
    table = Table(box=None, header_style="bold")
    for column in ("sensor", "bias deg/s", "scale off %", "misaligned deg", "before", "after"):
        table.add_column(column, justify="right")
    for i, row in enumerate(found["gyros"]):
        apart = [_or_dash(row["before_dps"]), _or_dash(row["after_dps"])]
        bias = _worst(row["bias_dps"], row["bias_std_dps"])
        if row["calibrated"]:
            scale = [100 * (value - 1) for value in row["scale"]]
            scale_std = [100 * value for value in row["scale_std"]]
            turned = _worst(row["misalignment_deg"], row["misalignment_std_deg"])
            table.add_row(str(i), bias, _worst(scale, scale_std), turned, *apart)
        else:
            share = f"{100 * row['used']:.0f} % usable"
            table.add_row(str(i), bias, "not calibrated", share, *apart)
    apart = found["disagreement_dps"]
    rest = found["rest_s"]
    lines = [
        f"{log}: {found['sensors']} gyros, {found['moving_s']:.1f} s in motion, "
        + (f"{rest:.1f} s at rest" if rest else "no rest: biases are relative, their mean is zero"),
        _text(table),
        "before, after: RMS from the array's mean in motion, deg/s, judged on motion not used to "
        "calibrate",
        f"{found['calibrated']} of {found['sensors']} calibrated; sensors differ by "
        f"{apart['before']:.3f} deg/s RMS before and {apart['after']:.3f} after, "
        f"{apart['before_untimed']:.3f} and {apart['after_untimed']:.3f} without what differences "
        "of sampling time make",
    ]
    return "\n".join(lines)


def pace_rows(found: Survey) -> list[tuple[str, Floats]]:
    """Every message, and its rate over time, for a picture."""
    return [
        (
            f"{name} {system}/{component} {message.rate:7.1f} Hz",
            paces(message, found.duration, WIDE),
        )
        for (system, component, name), message in sorted(found.messages.items())
        if message.history is not None
    ]


def _bars(message: MessageCount, duration: float) -> str:
    """A message's rate over time; a blank where it did not come."""
    if message.history is None or not duration:
        return ""
    shares = paces(message, duration, PARTS)
    heights = np.clip(np.round(FULL_BAR * shares), shares > 0.0, len(BARS) - 1).astype(int)
    return "".join(BARS[height] for height in heights)


def _worst(values: list[float], deviations: list[float | None]) -> str:
    """The value farthest from zero, with its deviation."""
    worst = max(range(len(values)), key=lambda i: abs(values[i]))
    return f"{values[worst]:+.3f} ± {_or_dash(deviations[worst])}"


def _or_dash(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _count(number: int) -> str:
    return str(number) if number else "none"


def _reasons(counts: dict[str, int]) -> str:
    return ", ".join(f"{n} {reason}" for reason, n in sorted(counts.items()) if n) or "none"


def _text(table: Table) -> str:
    console = Console(file=io.StringIO(), width=100)
    with console.capture() as captured:
        console.print(table)
    return captured.get().rstrip()
