"""PREFLIGHT_CALIBRATION of the gyros: their bias, learnt at rest, with its progress told."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from risaf_link.core.estimate import Estimate
from risaf_link.core.rotation import Floats
from risaf_link.core.zeroing import Zeroed, Zeroing
from risaf_link.mavlink.commands import Order, Result
from risaf_link.mavlink.notices import Notice, Severity

PROGRESS_STEP = 0.1  # from one IN_PROGRESS to the next


@dataclass(frozen=True, slots=True)
class Report:
    """How a calibration stands, for the one who ordered it."""

    order: Order
    result: Result
    progress: int = 255  # percent; 255: not known
    notice: Notice | None = None


class GyroCalibration:
    """Carries the order out, one at a time.

    Parameters
    ----------
    set_bias : callable
        Takes the mean rate, rad/s, and its variance.
    """

    def __init__(self, set_bias: Callable[[Floats, Floats], None]) -> None:
        self._set_bias = set_bias
        self._running: tuple[Zeroing, Order] | None = None
        self._told = 0.0  # progress

    @property
    def is_running(self) -> bool:
        """Whether estimates must be observed."""
        return self._running is not None

    @property
    def percent(self) -> int:
        """Progress."""
        return round(100 * self._running[0].progress) if self._running else 255

    def begin(self, order: Order) -> Result:
        """Obey an order to calibrate the gyros, or say that it is being obeyed."""
        if self._running is None:
            self._running, self._told = (Zeroing(), order), 0.0
            return Result.IN_PROGRESS
        running = self._running[1]
        same = (running.asker, running.peer) == (order.asker, order.peer)
        return Result.IN_PROGRESS if same else Result.TEMPORARILY_REJECTED

    def end(self, why: str) -> list[Report]:
        """Give up, if it is running."""
        return [self._close(Result.FAILED, f"gyro calibration {why}")] if self._running else []

    def observe(self, estimate: Estimate) -> list[Report]:
        """Take the next estimate."""
        if self._running is None:
            return []
        zeroing, order = self._running
        zeroing.take(estimate.fused.rate_b, estimate.heading.speed, estimate.elapsed)
        if zeroing.state is Zeroed.MOVED:
            return self.end("failed: not at rest")
        if zeroing.state is Zeroed.STARVED:
            return self.end("failed: too few samples")
        if zeroing.state is Zeroed.DONE:
            self._set_bias(zeroing.mean, zeroing.variance)
            bias = ", ".join(f"{x:+.2f}" for x in np.degrees(zeroing.mean).tolist())
            return [self._close(Result.ACCEPTED, f"gyro bias {bias} deg/s")]
        if zeroing.progress - self._told < PROGRESS_STEP - 1e-9:
            return []
        self._told = zeroing.progress
        return [Report(order, Result.IN_PROGRESS, self.percent)]

    def _close(self, result: Result, text: str) -> Report:
        if self._running is None:
            raise ValueError("gyro calibration: found none running, expected one")
        (_, order), self._running = self._running, None
        severity = Severity.INFO if result is Result.ACCEPTED else Severity.WARNING
        return Report(order, result, notice=Notice(severity, text))
