"""What the operator is told in words, STATUSTEXT: changes of state, and not too often."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from risaf_link.core.estimate import Estimate
from risaf_link.core.heading import HeadingState
from risaf_link.core.health import SensorState

LOOK_US = 500_000  # from one look at the estimate to the next: to judge all sensors takes long
LEAST_PAUSE_US = 5_000_000  # between two notices of one matter
REJECTED_FOR = 2.0  # s without a heading that was fused, until rejection is a state
CHUNK = 50  # characters


class Severity(IntEnum):
    """MAV_SEVERITY, as far as it is used here."""

    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


@dataclass(frozen=True, slots=True)
class Notice:
    """One line for the operator."""

    severity: Severity
    text: str


class Notices:
    """Finds what has changed since the operator was last told.

    Of each matter the state is told when it differs from the one told before, at most every five
    seconds; so what flickers is told now and then, and the last state always.
    """

    def __init__(self) -> None:
        self._told: dict[str, tuple[object, int]] = {}  # the state, and when
        self._estimate: Estimate | None = None
        self._clock_resets = 0
        self._rejecting = False
        self._next_look_us = 0  # at the estimate

    def observe(self, estimate: Estimate) -> None:
        """Take the next estimate."""
        before, self._estimate = self._estimate, estimate
        if before and estimate.time_us < before.time_us:
            self._clock_resets += 1

    def due(
        self, now_us: int, has_stalled: bool, trouble: str, complaints: Mapping[str, str]
    ) -> list[Notice]:
        """What is to be told now.

        Parameters
        ----------
        now_us : int
            Microseconds of a clock that does not jump.
        has_stalled : bool
            No epochs come, though they did.
        trouble : str
            Why there are no estimates; empty: there are, or nothing has come.
        complaints : mapping
            What else may be wrong to what is wrong with it; empty: nothing.
        """
        silent = has_stalled and not trouble
        notices = [self._of_samples(now_us, silent), self._of_trouble(now_us, trouble)]
        notices += [self._of_complaint(now_us, *each) for each in complaints.items()]
        if self._estimate and now_us >= self._next_look_us:
            self._next_look_us = now_us + LOOK_US
            notices += self._of_estimate(self._estimate, now_us)
        return [notice for notice in notices if notice]

    def _of_samples(self, now_us: int, silent: bool) -> Notice | None:
        if not self._changed("samples", silent, False, now_us):
            return None
        if silent:
            return Notice(Severity.CRITICAL, "no samples from the array: no estimates")
        return Notice(Severity.INFO, "samples are back")

    def _of_trouble(self, now_us: int, trouble: str) -> Notice | None:
        if not self._changed("trouble", trouble, "", now_us) or not trouble:
            return None
        return Notice(Severity.ERROR, f"no estimates: {trouble}")

    def _of_complaint(self, now_us: int, what: str, wrong: str) -> Notice | None:
        if not self._changed(f"complaint: {what}", wrong, "", now_us):
            return None
        if wrong:
            return Notice(Severity.WARNING, f"{what}: {wrong}")
        return Notice(Severity.INFO, f"{what}: in order again")

    def _of_estimate(self, estimate: Estimate, now_us: int) -> list[Notice | None]:
        attitude, health = estimate.attitude, estimate.array.health
        notices: list[Notice | None] = []
        if self._changed("clock", self._clock_resets, 0, now_us):
            notices.append(Notice(Severity.NOTICE, "the array's clock was reset"))
        was_aligned, _ = self._told.get("yaw", (0, 0))
        resets = attitude.resets if attitude.aligned else 0
        if self._changed("yaw", resets, 0, now_us) and resets:
            word = "set anew" if was_aligned else "aligned"
            degrees = math.degrees(attitude.euler[2]) % 360.0
            notices.append(Notice(Severity.INFO, f"heading {word}: {degrees:.0f} deg"))
        out = attitude.aligned and estimate.heading.state is HeadingState.DEAD_RECKONING
        if self._changed("gps", out, False, now_us):
            lost = Notice(Severity.WARNING, "GPS lost: heading by dead reckoning")
            notices.append(lost if out else Notice(Severity.INFO, "GPS is back"))
        heading = estimate.heading
        if heading.state is HeadingState.REJECTING:
            self._rejecting |= heading.time_since_fused > REJECTED_FOR
        elif heading.state is not HeadingState.TOO_SLOW:
            self._rejecting = False
        if self._changed("heading", self._rejecting, False, now_us):
            notices.append(self._of_rejection(estimate))
        dead = health.count(SensorState.DEAD)
        if self._changed("sensors", dead, 0, now_us):
            lost = Notice(Severity.WARNING, f"{dead} of {estimate.array.sensors} sensors dead")
            notices.append(lost if dead else Notice(Severity.INFO, "all sensors are back"))
        return notices

    def _of_rejection(self, estimate: Estimate) -> Notice:
        innovation = estimate.heading.innovation
        if not self._rejecting:
            return Notice(Severity.INFO, "GPS heading is used again")
        if (
            innovation is None or innovation.test_ratio <= 1.0
        ):  # others or positions speak against it
            return Notice(Severity.WARNING, "GPS heading rejected")
        ratio = f"test ratio {innovation.test_ratio:.1f}"
        return Notice(Severity.WARNING, f"GPS heading rejected, {ratio}")

    def _changed(self, matter: str, state: object, first: object, now_us: int) -> bool:
        told, when_us = self._told.get(matter, (first, -LEAST_PAUSE_US))
        if state == told or now_us - when_us < LEAST_PAUSE_US:
            return False
        self._told[matter] = state, now_us
        return True


def statustexts(notice: Notice, number: int) -> list[dict[str, Any]]:
    """Fields of the STATUSTEXT messages that carry a notice.

    Parameters
    ----------
    notice : Notice
    number : int
        Of those that take more than one message; receivers put together what has the same.
    """
    text = notice.text.encode("ascii", "replace")
    chunks = [text[i : i + CHUNK] for i in range(0, len(text), CHUNK)] or [b""]
    if len(chunks) > 1 and len(chunks[-1]) == CHUNK:
        chunks.append(b"")  # the last one must not be full
    return [
        {
            "severity": notice.severity,
            "text": chunk,
            "id": number % 65535 + 1 if len(chunks) > 1 else 0,
            "chunk_seq": i,
        }
        for i, chunk in enumerate(chunks)
    ]
