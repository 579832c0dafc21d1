"""How pictures look: over time, in colours that a colour-blind reader can tell apart.

The palette is that of Okabe and Ito, "Color Universal Design", 2008.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from risaf_link.core.rotation import Floats
from risaf_link.errors import RisafError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLUE, SKY, ORANGE, VERMILLION, YELLOW = "#0072B2", "#56B4E9", "#E69F00", "#D55E00", "#F0E442"
INK, GREY = "#222222", "#8A8A8A"

STYLE = {
    "font.family": "sans-serif",
    "font.size": 9.0,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.linewidth": 0.7,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.grid": True,
    "grid.color": "#D5D5D5",
    "grid.linewidth": 0.5,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "legend.handlelength": 1.4,
    "legend.columnspacing": 1.2,
    "legend.borderaxespad": 0.2,
    "lines.linewidth": 1.1,
    "text.parse_math": False,  # names come out of logs
}

PACES = (
    *(("none", 0.0, "#FFFFFF"), ("below half", 0.5, VERMILLION), ("50 to 80 %", 0.8, ORANGE)),
    *(("as usual", 1.25, SKY), ("125 to 200 %", 2.0, BLUE), ("above", np.inf, "#0B2E5C")),
)
"""Rate of a message as a share of its median: in words, up to where, and as a colour."""


@dataclass(frozen=True, slots=True)
class Size:
    """For what a picture is made, inches."""

    width: float
    dpi: int
    left: float  # margins, the same in all pictures: their times stand below one another
    legend: int  # entries of a legend in a line
    lines: int = 1  # of a legend
    right: float = 0.15
    scale: float = 1.0  # of heights

    def figure(
        self, heights: Sequence[float], title: str = "", lines: int | None = None
    ) -> tuple["Figure", list["Axes"]]:
        """Make panels of these heights, one below the other, with room for legends above each."""
        from matplotlib.figure import Figure

        above = 0.17 * (1 + (lines or self.lines))
        below, heading = 0.44, 0.26 if title else 0.0
        inches = [height * self.scale for height in heights]
        total = sum(inches) + above * len(inches) + below + heading
        made = Figure(figsize=(self.width, total))
        panels: list[Axes] = []
        top = total - heading
        for height in inches:
            top -= above + height
            across = (self.width - self.left - self.right) / self.width
            place = (self.left / self.width, top / total, across, height / total)
            panel = made.add_axes(place, sharex=panels[0] if panels else None)
            panel.yaxis.set_label_coords(-(self.left - 0.2) / (across * self.width), 0.5)
            panels.append(panel)
        for panel in panels[:-1]:
            panel.tick_params(labelbottom=False)
        panels[-1].set_xlabel("time since the first sample (s)")
        if title:
            made.text(0.01, 1.0 - 0.06 / total, title, va="top", weight="bold")
        return made, panels


WIDE = Size(width=10.0, dpi=144, left=0.75, legend=6)
NARROW = Size(width=4.6, dpi=200, left=0.72, legend=3, lines=2, scale=0.9)


def require() -> None:
    """Make sure that pictures can be drawn.

    Raises
    ------
    RisafError
        Without matplotlib.
    """
    if not find_spec("matplotlib"):
        raise RisafError("pictures need matplotlib: install risaf-link with the extra `plot`")


@contextmanager
def styled() -> Iterator[None]:
    """Draw in the style of this module."""
    import matplotlib as mpl

    with mpl.rc_context(STYLE):
        yield


def draw_paces(path: Path, title: str, rows: Sequence[tuple[str, Floats]], duration: float) -> None:
    """Draw how often each message came over the time of a log.

    Parameters
    ----------
    path : Path
        PNG, or whatever its suffix says.
    title : str
    rows : sequence of (str, ndarray)
        A message, and its rate in equal parts of the time as a share of its median.
    duration : float
        s.
    """
    require()
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    size = Size(width=10.0, dpi=144, left=3.0, legend=len(PACES))
    limits = np.array([limit for _, limit, _ in PACES])
    image = np.array([np.searchsorted(limits, shares) for _, shares in rows])
    with styled():
        figure, (panel,) = size.figure((max(0.19 * len(rows), 0.6),), title)
        panel.imshow(
            image,
            aspect="auto",
            interpolation="nearest",
            extent=(0.0, max(duration, 1e-3), len(rows) - 0.5, -0.5),
            cmap=ListedColormap([colour for *_, colour in PACES]),
            vmin=-0.5,
            vmax=len(PACES) - 0.5,
        )
        panel.grid(visible=False)
        panel.set(xlabel="time since the first record (s)", yticks=range(len(rows)))
        panel.set_yticklabels([name for name, _ in rows], fontsize=8.0)
        for edge in np.arange(0.5, len(rows) - 1):
            panel.axhline(edge, color="white", linewidth=1.5)
        panel.tick_params(axis="y", length=0)
        patches = [
            Patch(facecolor=colour, edgecolor=GREY, linewidth=0.4, label=word)
            for word, _, colour in PACES
        ]
        legend(panel, patches, size.legend)
        save(figure, path, size)


def save(figure: "Figure", path: Any, size: Size) -> None:
    """Write a picture to a path or a file."""
    try:
        figure.savefig(path, dpi=size.dpi, facecolor="white")
    except (OSError, ValueError) as error:  # of matplotlib, if it does not know the suffix
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise RisafError(f"{path}: {reason}") from None


def legend(panel: "Axes", handles: Any, across: int) -> None:
    """Put a legend above a panel, so many entries in a line; `handles` None: all it has."""
    many = {} if handles is None else {"handles": handles}
    count = len(panel.get_legend_handles_labels()[1]) if handles is None else len(handles)
    if count:
        panel.legend(
            loc="lower left",
            bbox_to_anchor=(0.0, 1.0),
            ncols=min(count, across),
            markerscale=2.0,
            **many,
        )
