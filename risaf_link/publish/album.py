"""The course of a run in pictures."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from risaf_link.core.health import Reason, SensorState
from risaf_link.core.history import History
from risaf_link.core.outage import Reference
from risaf_link.core.rotation import Floats
from risaf_link.publish import course as columns
from risaf_link.publish.course import Course
from risaf_link.publish.plot import (
    BLUE,
    GREY,
    INK,
    ORANGE,
    VERMILLION,
    WIDE,
    YELLOW,
    Size,
    legend,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKERS: dict[Reference, str] = {"truth": "truth", "gps": "withheld GPS"}
RATE_EPOCHS = 20  # in a step of the epoch rate, at least: with fewer it flickers
FINEST_RATIO = 0.01  # test ratio; smaller ones are drawn there
WIDEST = 1024  # steps in an image: no more than its pixels
AMBER_RATIO = 0.5  # of an innovation that is worth a look

HEALTHY_COLOUR = "#ECECEC"
STANDINGS: dict[tuple[SensorState, Reason], tuple[str, str]] = {
    (SensorState.SUSPECT, Reason.SETTLING): ("suspect: settling", "#BFE0F5"),
    (SensorState.SUSPECT, Reason.WANDERING): ("suspect: wandering", YELLOW),
    (SensorState.SUSPECT, Reason.OUTLYING): ("suspect: outlying", "#F4A582"),
    (SensorState.SUSPECT, Reason.SILENT): ("suspect: silent", "#9A9A9A"),
    (SensorState.DEAD, Reason.SETTLING): ("dead: not trusted for a minute", BLUE),
    (SensorState.DEAD, Reason.WANDERING): ("dead: wandering", "#A39600"),
    (SensorState.DEAD, Reason.OUTLYING): ("dead: outlying", "#8C2D04"),
    (SensorState.DEAD, Reason.FROZEN): ("dead: frozen", "#7A3E8E"),
    (SensorState.DEAD, Reason.SILENT): ("dead: silent", "#000000"),
}
"""How a sensor stood, in words and as a colour: one for each reason, darker where it is dead."""


class Album:
    """Draws the course of one run.

    Parameters
    ----------
    course : Course
        A finished one.
    outages : sequence of (float, float)
        Times without GPS, s from the first sample; they are shaded everywhere.
    size : Size
    """

    def __init__(
        self, course: Course, outages: Sequence[tuple[float, float]], size: Size = WIDE
    ) -> None:
        self._course = course
        self._outages = outages
        self._size = size

    def overview(self, title: str) -> "Figure":
        """Heading and its error in one picture."""
        figure, (above, below) = self._size.figure((2.2, 2.2), title)
        self._draw_heading(above)
        self._draw_errors(below)
        return self._finished(figure, [above, below])

    def heading(self) -> "Figure":
        """Estimated yaw and GPS headings."""
        figure, panels = self._size.figure((2.2,))
        self._draw_heading(*panels)
        return self._finished(figure, panels)

    def errors(self) -> "Figure":
        """Errors of the heading with what was stated of them."""
        figure, panels = self._size.figure((2.4,))
        self._draw_errors(*panels)
        return self._finished(figure, panels)

    def innovations(self) -> "Figure":
        """Innovations of GPS headings, with gates, and their test ratios."""
        figure, (above, below) = self._size.figure((1.9, 1.3))
        rows = self._course.innovations.rows
        time_s = rows[:, columns.TIME]
        value, std = np.degrees(rows[:, columns.VALUE]), np.degrees(rows[:, columns.STD])
        gate = rows[:, columns.GATE] * std
        fused, reset = rows[:, columns.FUSED] > 0.0, rows[:, columns.RESET] > 0.0
        limit = _limit(gate, value[fused & ~reset])
        begins = np.diff(time_s, prepend=-np.inf) > _pause(time_s)
        edge = np.where(begins, np.nan, gate)
        above.fill_between(time_s, -edge, edge, color=BLUE, alpha=0.13, linewidth=0, label="gate")
        ratio = np.maximum(rows[:, columns.RATIO], FINEST_RATIO)
        kinds = (
            *((fused & ~reset, ".", BLUE, "fused"), (~fused, "x", VERMILLION, "rejected")),
            (reset, "d", INK, "set yaw"),
        )
        for chosen, marker, colour, label in kinds:
            if chosen.any():
                drawn: dict[str, Any] = {
                    "color": colour,
                    "markersize": 3.0,
                    "linestyle": "none",
                    "marker": marker,
                }
                inside = np.clip(value[chosen], -limit, limit)
                above.plot(time_s[chosen], inside, label=label, **drawn)
                below.plot(time_s[chosen], ratio[chosen], **drawn)
        above.set(ylabel="innovation (deg)", ylim=(-1.05 * limit, 1.05 * limit))
        top = max(3.0, 1.5 * float(ratio.max())) if len(ratio) else 3.0
        below.axhline(1.0, color=VERMILLION, linewidth=1.0, label="rejected above 1")
        below.axhline(
            AMBER_RATIO, color=ORANGE, linewidth=1.0, linestyle="--", label="worth a look: 0.5"
        )
        below.set(ylabel="test ratio", yscale="log", ylim=(0.8 * FINEST_RATIO, top))
        below.yaxis.set_major_formatter("{x:g}")
        return self._finished(figure, [above, below])

    def biases(self) -> "Figure":
        """Biases of the fused rate, axis by axis."""
        figure, panels = self._size.figure((0.95, 0.95, 0.95), lines=1)
        least, most = self._course.least, self._course.most
        std = self._course.bias_std
        for axis, panel in enumerate(panels):
            column = columns.BIAS.start + axis
            low, high = (np.degrees(each.values[:, column]) for each in (least, most))
            middle = 0.5 * (low + high)
            known = np.isfinite(std.values[:, axis])
            deviation = np.degrees(std.values[known, axis])
            centre = np.interp(std.times[known], least.times, middle)
            band = centre - deviation, centre + deviation
            panel.fill_between(
                std.times[known], *band, color=BLUE, alpha=0.15, linewidth=0, label="one sigma"
            )
            _envelope(panel, least.times, low, high, BLUE, "bias")
            settled = std.times[known] > 0.05 * self._course.duration
            reach = np.concatenate([edge[settled] for edge in band] + [[centre[-1]]])
            room = 0.1 * max(float(np.ptp(reach)), 1e-4)
            panel.set(
                ylabel=f"{'xyz'[axis]} (deg/s)", ylim=(reach.min() - room, reach.max() + room)
            )
        return self._finished(figure, panels, legends=1)

    def rates(self) -> "Figure":
        """Rates of the vehicle, axis by axis."""
        figure, panels = self._size.figure((0.8, 0.8, 0.8), lines=1)
        for axis, panel in enumerate(panels):
            self._draw_range(panel, columns.RATE.start + axis, BLUE, "rate, bias taken off")
            panel.set_ylabel(f"{'xyz'[axis]} (deg/s)")
        return self._finished(figure, panels, legends=1)

    def tilt(self) -> "Figure":
        """Roll and pitch with what is stated of them."""
        figure, panels = self._size.figure((1.0, 1.0), lines=1)
        least, most = self._course.least, self._course.most
        names = (("roll", columns.ROLL), ("pitch", columns.PITCH))
        for i, (panel, (name, column)) in enumerate(zip(panels, names, strict=True)):
            std = most.values[:, columns.TILT_STD.start + i]
            low = np.degrees(least.values[:, column] - std)
            high = np.degrees(most.values[:, column] + std)
            panel.fill_between(
                least.times, low, high, color=BLUE, alpha=0.15, linewidth=0, label="one sigma"
            )
            self._draw_range(panel, column, BLUE, name)
            panel.set_ylabel(f"{name} (deg)")
        return self._finished(figure, panels)

    def health(self) -> "Figure":
        """How every sensor stood over time: an image."""
        from matplotlib.colors import ListedColormap
        from matplotlib.patches import Patch
        from matplotlib.ticker import MaxNLocator

        history = self._course.health
        image, end = _image(history)
        n = history.columns
        codes = [8 * state + reason for state, reason in STANDINGS]
        found = [i for i, code in enumerate(codes) if (image == code).any()]
        entries = 1 + len(found) + bool(self._outages)
        across = max(2, self._size.legend - 1)  # the words are long
        height = min(max(0.022 * n, 0.7), 4.5)
        figure, panels = self._size.figure((height,), lines=-(-entries // across))
        shown = np.where(np.isnan(image), np.nan, 0.0)
        for i, code in enumerate(codes):
            shown[image == code] = i + 1
        colours = [HEALTHY_COLOUR, *(colour for _, colour in STANDINGS.values())]
        (panel,) = panels
        panel.imshow(
            shown.T,
            aspect="auto",
            interpolation="nearest",
            extent=(0.0, end, n - 0.5, -0.5),
            cmap=ListedColormap(colours),
            vmin=-0.5,
            vmax=len(colours) - 0.5,
        )
        panel.grid(visible=False)
        panel.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        panel.set_ylabel("sensor")
        words = [word for word, _ in STANDINGS.values()]
        patches = [Patch(facecolor=HEALTHY_COLOUR, edgecolor=GREY, linewidth=0.5, label="healthy")]
        patches += [Patch(facecolor=colours[i + 1], label=words[i]) for i in found]
        for i, (start, stop) in enumerate(self._outages):  # above it: the image is not to be tinted
            label = "" if i else "without GPS"
            bar = panel.axvspan(
                *(start, stop, 1.0, 1.0 + 0.06 / height),
                color=ORANGE,
                clip_on=False,
                label=label,
            )
            patches += [] if i else [bar]
        panel.set_xlim(0.0, max(self._course.duration, 1e-3))
        legend(panel, patches, across)
        return figure

    def array(self) -> "Figure":
        """Epochs a second, samples lost, sensors behind the fused rate."""
        course = self._course
        has_lost = bool(course.lost.values.any())
        heights = (1.0, *([0.8] if has_lost else []), 1.0)
        figure, panels = self._size.figure(heights, lines=1)
        time_s, rate = _rates(course.epochs, course.duration)
        panels[0].plot(time_s, rate, drawstyle="steps-mid", color=BLUE, label="epochs")
        panels[0].set(ylabel="epochs/s", ylim=(0.0, 1.15 * max(float(rate.max()), 1e-3)))
        if has_lost:
            lost = course.lost
            parts = np.linspace(0.0, max(course.duration, 1e-3), 301)
            counts = lost.between(parts)[:, 0] / np.diff(parts)
            panels[1].fill_between(
                parts[:-1], counts, step="post", color=VERMILLION, linewidth=0.5, label="lost"
            )
            panels[1].set(ylabel="samples/s")
            panels[1].set_ylim(bottom=0.0)
        last = panels[-1]
        active = course.least.values[:, columns.ACTIVE]
        last.plot(course.least.times, active, color=BLUE, label="behind the fused rate, at least")
        self._draw_counts(last)
        last.set(ylabel="sensors", ylim=(0.0, 1.12 * max(course.health.columns, 1)))
        return self._finished(figure, panels)

    def _draw_counts(self, panel: "Axes") -> None:
        history = self._course.health
        if not len(history):
            return
        for state, colour, style in (
            (SensorState.SUSPECT, ORANGE, "--"),
            (SensorState.DEAD, INK, ":"),
        ):
            count = (history.values // 8 == state).sum(axis=1)
            panel.plot(
                history.times, count, color=colour, linestyle=style, label=state.name.lower()
            )

    def _draw_heading(self, panel: "Axes") -> None:
        rows = self._course.innovations.rows
        measured = np.degrees(rows[:, columns.YAW]) % 360.0
        fused = rows[:, columns.FUSED] > 0.0
        time_s = rows[:, columns.TIME]
        kinds = (
            (fused, ".", ORANGE, "GPS, fused"),
            (~fused, "x", VERMILLION, "GPS, rejected"),
        )
        for chosen, marker, colour, label in kinds:
            if chosen.any():
                style: dict[str, Any] = {"marker": marker, "markersize": 3.0, "linestyle": "none"}
                panel.plot(time_s[chosen], measured[chosen], color=colour, label=label, **style)
        yaw = self._course.yaw
        degrees = np.degrees(yaw.values[:, 0]) % 360.0
        wrapped = np.flatnonzero(np.abs(np.diff(degrees)) > 180.0) + 1
        line = np.insert(degrees, wrapped, np.nan)  # the line is not drawn across
        panel.plot(np.insert(yaw.times, wrapped, np.nan), line, color=BLUE, label="estimated")
        panel.set(ylabel="heading (deg)", ylim=(0, 360), yticks=range(0, 361, 90))

    def _draw_errors(self, panel: "Axes") -> None:
        most = self._course.most
        std = np.degrees(most.values[:, columns.YAW_STD])
        for factor, alpha, label in ((2.0, 0.10, "two"), (1.0, 0.16, "one")):
            panel.fill_between(
                *(most.times, -factor * std, factor * std),
                color=BLUE,
                alpha=alpha,
                linewidth=0,
                label=f"{label} sigma, stated",
            )
        sizes = [2.0 * std]
        for reference, found in sorted(self._course.errors.items(), reverse=True):
            colour = INK if reference == "truth" else VERMILLION
            low, high = (np.degrees(each.values[:, 0]) for each in (found.least, found.most))
            label = f"against {MARKERS[reference]}"
            _envelope(panel, found.least.times, low, high, colour, label, dots=True)
            sizes.append(np.fmax(np.abs(low), np.abs(high)))
        limit = _limit(*sizes)
        panel.set(ylabel="heading error (deg)", ylim=(-limit, limit))

    def _draw_range(self, panel: "Axes", column: int, colour: str, label: str) -> None:
        least, most = self._course.least, self._course.most
        low, high = (np.degrees(each.values[:, column]) for each in (least, most))
        _envelope(panel, least.times, low, high, colour, label)

    def _finished(
        self, figure: "Figure", panels: Sequence["Axes"], legends: int | None = None
    ) -> "Figure":
        """Shade outages and gaps, and put the legends above their panels."""
        for number, panel in enumerate(panels):
            for i, (start, end) in enumerate(self._outages):
                label = "" if i or number else "without GPS"
                panel.axvspan(
                    *(start, end), color=ORANGE, alpha=0.16, linewidth=0, zorder=0, label=label
                )
            for i, (start, end) in enumerate(self._course.gaps):
                label = "" if i or number else "no samples"
                panel.axvspan(*(start, end), color="#BDBDBD", linewidth=0, zorder=3, label=label)
            panel.set_xlim(0.0, max(self._course.duration, 1e-3))
            if legends is None or number < legends:
                legend(panel, None, self._size.legend)
        return figure


def _envelope(
    panel: "Axes",
    time_s: Floats,
    low: Floats,
    high: Floats,
    colour: str,
    label: str,
    dots: bool = False,
) -> None:
    """Draw what lies between least and most; a line where they are one."""
    panel.fill_between(time_s, low, high, color=colour, alpha=0.45, linewidth=0.6)
    known = np.isfinite(low)
    style: dict[str, Any] = {}
    if dots:
        style = {"marker": ".", "markersize": 1.5, "linestyle": "none"}
    panel.plot(
        time_s[known], 0.5 * (low + high)[known], color=colour, linewidth=0.9, label=label, **style
    )


def _limit(*sizes: Floats) -> float:
    """Up to where an axis must reach: to all that is usual, and to most of what is not."""
    known = [np.abs(each[np.isfinite(each)]) for each in sizes]
    usual = [float(np.quantile(each, 0.98)) for each in known if len(each)]
    return 1.25 * max([*usual, 0.1])


def _pause(time_s: Floats) -> float:
    """Seconds between two headings that are a pause."""
    return 5.0 * float(np.median(np.diff(time_s))) if len(time_s) > 1 else np.inf


def _rates(epochs: History, duration: float) -> tuple[Floats, Floats]:
    """Epochs a second, and when."""
    total = float(epochs.values.sum())
    parts = int(np.clip(total / RATE_EPOCHS, 1, 400))
    edges = np.linspace(0.0, max(duration, 1e-3), parts + 1)
    return 0.5 * (edges[1:] + edges[:-1]), epochs.between(edges)[:, 0] / np.diff(edges)


def _image(history: History) -> tuple[Floats, float]:
    """Steps of an image, (m, c), at most as many as it has pixels, and where they end, s."""
    values, step = history.values, history.step
    while len(values) > WIDEST:
        even = values[: len(values) // 2 * 2].reshape(len(values) // 2, 2, -1)
        rest = values[len(values) // 2 * 2 :]
        values, step = np.vstack((np.fmax(even[:, 0], even[:, 1]), rest)), 2.0 * step
    return values, len(values) * step
