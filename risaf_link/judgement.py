"""What a run's course says of it, in words: whether its heading can be trusted, and which sensors.

Every sentence follows from numbers that stand in the report as well.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from risaf_link.core.health import Reason
from risaf_link.core.outage import Reference
from risaf_link.core.rotation import Floats
from risaf_link.publish import course as columns
from risaf_link.publish.course import Course
from risaf_link.words import REFERENCES

LEAST_WITHIN_TWO = 0.90  # of errors within two stated deviations; Gaussian ones would be 0.954
MOST_NIS = 2.0  # mean of the innovations' squares over their variances; 1 is as stated
MOST_REJECTED = 0.10  # of GPS headings
UNSURE = 10.0  # deg that a stated deviation may reach
SETTLING = 30.0  # s after the first heading for which it may be more
MOST_NAMED = 10  # sensors in one breath
REASONS = {
    Reason.SETTLING: "settling",
    Reason.WANDERING: "wandering",
    Reason.OUTLYING: "outlying",
    Reason.FROZEN: "frozen",
    Reason.SILENT: "silent",
}

Trust = Literal["good", "care", "none"]


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether the heading can be trusted."""

    trust: Trust
    headline: str
    sentences: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class SensorRow:
    """When and why one sensor was not healthy."""

    sensor: int
    suspect: float  # s
    dead: float  # s
    first: float  # s from the first sample: when it began
    last: float  # s: when it ended
    reason: str  # for most of the time, settling apart
    rejected: float  # largest share of its readings


def heading_verdict(summary: dict[str, Any], course: Course) -> Verdict:
    """Judge the heading of a whole run.

    Parameters
    ----------
    summary : dict
        `Replay.summary`.
    course : Course
        Of the same run.
    """
    heading = summary["heading"]
    if course.aligned_s is None:
        count = heading["fused"] + heading["rejected"]
        why = f"{count} GPS headings did not set it" if count else "no GPS heading came"
        said = f"Yaw was never known: {why}. Roll, pitch and rates are there."
        return Verdict("none", "There is no heading.", (said, *_by_mismatch(summary)))
    known = f"Yaw is known from {course.aligned_s:.1f} s on."
    sentences: list[str] = []
    doubts: list[str] = []
    for judged in (_by_errors(summary, course), _by_innovations(heading, course)):
        sentences += judged[0]
        doubts += judged[1]
    doubts += [*_by_deviation(course), *_by_mismatch(summary)]
    sentences = [*doubts, known, *sentences]
    if doubts:
        return Verdict("care", "The heading is to be used with care.", tuple(sentences))
    return Verdict(
        "good", "The heading can be trusted, within what it states of itself.", tuple(sentences)
    )


def sensor_rows(course: Course) -> list[SensorRow]:
    """Sensors that were not healthy at some time, the worst first."""
    s = course.standing
    order = np.lexsort((-s.suspect, -s.dead))
    return [
        SensorRow(
            i,
            float(s.suspect[i]),
            float(s.dead[i]),
            float(s.first[i]),
            float(s.last[i]),
            REASONS[_main_reason(s.reasons[i])],
            float(s.rejected[i]),
        )
        for i in order.tolist()
        if s.suspect[i] + s.dead[i] > 0.0
    ]


def sensor_sentences(course: Course) -> list[str]:
    """Which sensors misbehaved."""
    rows = sensor_rows(course)
    n = len(course.standing.dead)
    ill = [row for row in rows if row.dead]
    suspect = [row.sensor for row in rows if not row.dead]
    sentences = [f"Healthy throughout: {n - len(rows)} of {n}."]
    if ill:
        kinds = [
            f"{_names([row.sensor for row in ill if row.reason == reason])} ({reason})"
            for reason in dict.fromkeys(row.reason for row in ill)
        ]
        sentences.append(f"Dead for some time: {'; '.join(kinds)}.")
    if suspect:
        sentences.append(f"Suspect for some time, and not used meanwhile: {_names(suspect)}.")
    return sentences


def _main_reason(seconds: Floats) -> Reason:
    """Why a sensor was not healthy for most of the time; what it had to settle after, if any."""
    causes = seconds[Reason.WANDERING :]
    return Reason(Reason.WANDERING + int(causes.argmax())) if causes.any() else Reason.SETTLING


def _names(sensors: list[int]) -> str:
    more = len(sensors) - MOST_NAMED
    named = ", ".join(map(str, sorted(sensors)[:MOST_NAMED]))
    return f"{named} and {more} more" if more > 0 else named


def _by_errors(summary: dict[str, Any], course: Course) -> tuple[list[str], list[str]]:
    """What a comparison with the truth, or with withheld GPS, says; and doubts."""
    sentences, doubts = [], []
    truth = summary["truth"]
    if truth["rmse_deg"] is not None:
        sentences.append(
            f"Against truth, with GPS or without, it is off by {truth['rmse_deg']:.2f} deg RMS and "
            f"by {truth['max_deg']:.2f} deg at most."
        )
    references: tuple[Reference, ...] = ("truth", "gps")
    for reference in references:
        found = course.errors.get(reference)
        if found is None:
            continue
        shares = found.within / found.count
        against_truth = reference == "truth"
        usual = "Gaussian ones would be 68, 95 and 99.7 %" if against_truth else "GPS errs as well"
        sentences.append(
            f"Of the errors against {REFERENCES[reference]}, {100 * shares[0]:.0f} % lie within "
            f"one deviation as stated, {100 * shares[1]:.0f} % within two, "
            f"{100 * shares[2]:.0f} % within three; {usual}."
        )
        if against_truth and shares[1] < LEAST_WITHIN_TWO:
            doubts.append("It is off by more than stated too often, against truth.")
    if not course.errors:
        sentences.append("The log has nothing to compare it with.")
    return sentences, doubts


def _by_innovations(heading: dict[str, int], course: Course) -> tuple[list[str], list[str]]:
    fused, rejected = heading["fused"], heading["rejected"]
    sentences = [f"{fused} GPS headings were fused and {rejected} rejected."]
    doubts = []
    if rejected > MOST_REJECTED * (fused + rejected):
        share = 100 * rejected / (fused + rejected)
        doubts.append(f"{share:.0f} % of the GPS headings were rejected.")
    if course.fused:
        sentences.append(
            f"Innovations, squared and over their variance, are {course.nis:.2f} on average; 1 is "
            "as stated."
        )
        if course.nis > MOST_NIS:
            doubts.append("GPS headings differ from it by more than stated.")
    return sentences, doubts


def _by_deviation(course: Course) -> list[str]:
    settled = course.most.times > (course.aligned_s or 0.0) + SETTLING
    stated = np.degrees(course.most.values[settled, columns.YAW_STD])
    largest = float(np.nanmax(stated)) if np.isfinite(stated).any() else 0.0
    return [f"Its stated deviation grows to {largest:.0f} deg."] if largest > UNSURE else []


def _by_mismatch(summary: dict[str, Any]) -> list[str]:
    why = summary["mismatch"]
    return [f"From some epochs there are no estimates: {why}."] if why else []
