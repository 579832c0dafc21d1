"""The heading over time and its error, as a picture."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from risaf_link.core.estimate import EstimateBlock
from risaf_link.core.heading import HeadingState
from risaf_link.core.rotation import Floats, yaws_of
from risaf_link.errors import RisafError

STEP_S = 0.1  # between two points
MARKERS = {"truth": "truth", "gps": "withheld GPS"}


class HeadingPlot:
    """Gathers the course of one run and draws it."""

    def __init__(self) -> None:
        try:
            import matplotlib as mpl
        except ImportError:
            raise RisafError(
                "--plot needs matplotlib: install risaf-link with the extra `plot`"
            ) from None
        mpl.use("Agg")
        self._points: list[tuple[float, float, float, bool]] = []

    def take(self, block: EstimateBlock) -> None:
        """Take the next estimates."""
        track = block.track
        yaw = np.where(track.aligned, yaws_of(track.q_nb), np.nan)
        is_out = block.heading.state == HeadingState.DEAD_RECKONING
        for point in zip(block.elapsed, yaw, track.yaw_std, is_out, strict=True):
            if not self._points or point[0] >= self._points[-1][0] + STEP_S:
                self._points.append(point)

    def draw(self, path: Path, title: str, trace: Iterable[tuple[str, Floats, Floats]]) -> None:
        """Write the picture.

        Parameters
        ----------
        path : Path
            PNG, or whatever its suffix says.
        title : str
        trace : iterable of (str, ndarray, ndarray)
            Heading errors of a reference: its name, seconds, rad.
        """
        from matplotlib import pyplot as plt

        time_s, yaw, std, is_out = np.array(self._points).T
        figure, (above, below) = plt.subplots(
            2, 1, sharex=True, figsize=(10, 6), layout="constrained"
        )
        above.plot(time_s, np.degrees(yaw) % 360, ".", markersize=2, label="estimated")
        above.set(ylabel="heading (deg)", ylim=(0, 360), yticks=range(0, 361, 90), title=title)
        std = np.where(np.isnan(yaw), np.nan, np.degrees(std))
        below.fill_between(time_s, -std, std, alpha=0.2, linewidth=0, label="one sigma, estimated")
        for reference, label in MARKERS.items():
            parts = [np.array(part) for name, *part in trace if name == reference]
            errors = np.hstack(parts) if parts else np.zeros((2, 0))
            if errors.size:
                errors_deg = np.degrees(errors[1])
                below.plot(errors[0], errors_deg, ".", markersize=2, label=f"against {label}")
        below.set(ylabel="heading error (deg)", xlabel="time since the first sample (s)")
        for axes in (above, below):
            axes.fill_between(
                time_s,
                0,
                1,
                where=is_out > 0,
                transform=axes.get_xaxis_transform(),
                color="tab:orange",
                alpha=0.12,
                linewidth=0,
                label="without GPS",
            )
            axes.grid(alpha=0.3)
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), markerscale=4)
        figure.savefig(path, dpi=120)
        plt.close(figure)
