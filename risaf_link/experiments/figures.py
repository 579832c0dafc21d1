"""What all figures have in common."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from risaf_link.core.rotation import Floats, wraps
from risaf_link.errors import ConfigError
from risaf_link.sweep import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = {
    "ours": "#d62728",
    "robust": "#ff7f0e",
    "risaf": "#1f77b4",
    "mean": "#2f2f2f",
    "single": "#8c564b",
    "integration": "#7f7f7f",
    "virtual": "#bcbd22",
    "centralised": "#9467bd",
    "huber": "#17becf",
    "mcc": "#2ca02c",
    "vb": "#e377c2",
    "mmukf": "#98a000",
    "particles": "#005f73",
}
OTHER = "#aa00ff"  # a method of the user's own


def check() -> None:
    """Make sure that figures can be drawn.

    Raises
    ------
    ConfigError
        Without matplotlib.
    """
    try:
        import matplotlib as mpl
    except ImportError:
        raise ConfigError(
            "experiment needs matplotlib: install risaf-link with the extra `plot`"
        ) from None
    mpl.use("Agg")


def figure(rows: int, columns: int = 1, **options: Any) -> tuple["Figure", Any]:
    """Make a figure with a grid of axes; always a two-dimensional array of them."""
    from matplotlib import figure as mpl

    options = {"figsize": (5.5 * columns + 2.5, 3.2 * rows)} | options
    size = options.pop("figsize")
    made = mpl.Figure(figsize=size, layout="constrained")
    axes = made.subplots(rows, columns, squeeze=False, **options)
    for each in axes.ravel():
        each.grid(alpha=0.3)
    return made, axes


def colour(name: str) -> str:
    """Colour of a method."""
    return COLOURS.get(name.partition(":")[0], OTHER)


def unwrapped(angles: Sequence[float | None]) -> Floats:
    """Degrees of angles, rad, without jumps; NaN where there is none."""
    values = np.array(angles, dtype=float)
    known = np.isfinite(values)
    values[known] = np.unwrap(values[known])
    degrees: Floats = np.degrees(values)
    return degrees


def near(angles: Floats, reference: Floats) -> Floats:
    """Degrees brought to within half a turn of the reference at the first of them."""
    known = np.isfinite(angles)
    if not known.any():
        return angles
    first = int(np.argmax(known))
    moved: Floats = angles - 360.0 * round((angles[first] - reference[first]) / 360.0)
    return moved


def shade_outages(axes: "Axes", outages: Sequence[tuple[float, float]]) -> None:
    """Show when GPS is withheld."""
    for start, end in outages:
        axes.axvspan(start, end, color="tab:orange", alpha=0.1, linewidth=0)


def draw_headings(
    axes: "Axes", result: Row, names: Sequence[str], titles: Mapping[str, str]
) -> None:
    """Draw true, measured and estimated headings."""
    trace = result["trace"]
    time_s, truth = np.array(trace["time_s"]), unwrapped(trace["yaw"])
    for name in names:
        yaw = near(unwrapped(result["methods"][name]["yaw"]), truth)
        axes.plot(time_s, yaw, color=colour(name), linewidth=1.0, label=titles[name])
    axes.plot(time_s, truth, "k--", linewidth=0.8, label="truth")
    gps_s, withheld = np.array(trace["gps_time_s"]), np.array(trace["withheld"], dtype=bool)
    gps = np.degrees(np.array(trace["gps"]))
    expected = np.interp(gps_s, time_s, truth)
    gps += 360.0 * np.round((expected - gps) / 360.0)
    thin = slice(None, None, 5)
    for mask, shade, label in ((~withheld, "red", "GPS"), (withheld, "0.6", "GPS, withheld")):
        axes.plot(gps_s[mask][thin], gps[mask][thin], ".", color=shade, markersize=2, label=label)
    low, high = truth.min(), truth.max()
    room = max(15.0, 0.25 * (high - low))
    axes.set(ylabel="heading (deg)", ylim=(low - room, high + room))


def draw_errors(axes: "Axes", result: Row, names: Sequence[str], titles: Mapping[str, str]) -> None:
    """Draw sizes of heading errors."""
    trace = result["trace"]
    for name in names:
        error = np.array(result["methods"][name]["yaw"], dtype=float) - np.array(trace["yaw"])
        size = np.degrees(np.abs(wraps(error)))
        axes.plot(trace["time_s"], size, color=colour(name), linewidth=1.0, label=titles[name])
    axes.set(yscale="log", ylim=(0.02, 200), ylabel="|heading error| (deg)")


def draw_bars(
    axes: "Axes",
    names: Sequence[str],
    titles: Mapping[str, str],
    spreads: Sequence[Sequence[float]],
) -> None:
    """Draw medians with quartiles, one bar a method."""
    places = np.arange(len(names))
    middle, low, high = np.array(spreads).T
    axes.barh(places, middle, color=[colour(name) for name in names], alpha=0.85)
    axes.errorbar(
        middle, places, xerr=[middle - low, high - middle], fmt="none", color="0.25", capsize=2
    )
    axes.set(yticks=places, yticklabels=[titles[name] for name in names], xscale="log")
    axes.invert_yaxis()
    for place, value in zip(places, high, strict=True):
        axes.annotate(
            f" {middle[place]:.2f}", (value, place), va="center", fontsize=8, clip_on=False
        )
    axes.set_xlim(max(0.5 * low.min(), 1e-3), 2.5 * high.max())


def legend(axes: "Axes", scale: float = 1.0) -> None:
    """Put the legend beside the axes; `scale` enlarges its markers."""
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, markerscale=scale)
