"""One page on one run, for whoever looks back: words, tables and pictures in a single file."""

import base64
import io
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from risaf_link import __version__
from risaf_link.config import Config, dump
from risaf_link.errors import ConfigError, RisafError
from risaf_link.judgement import heading_verdict, sensor_rows, sensor_sentences
from risaf_link.publish import plot
from risaf_link.publish.album import Album
from risaf_link.publish.course import Course
from risaf_link.replay import Replay
from risaf_link.whole import replace_file
from risaf_link.words import REFERENCES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE = "report.html"
TEMPLATE = Path(__file__).parent / "publish" / PAGE
LATEST = datetime(9999, 12, 31, tzinfo=UTC).timestamp()


@dataclass(frozen=True, slots=True)
class Picture:
    """One picture, as wide as a desk's screen and as a telephone's."""

    name: str
    title: str
    wide: str  # URL
    narrow: str
    caption: str


CAPTIONS: dict[str, tuple[str, str]] = {
    "heading": (
        "Heading",
        "The estimated yaw from true north, and the headings that GPS measured.",
    ),
    "errors": (
        "Heading error",
        "Estimated minus reference, over the deviation that the filter stated at that time. Where "
        "few peaks reach far beyond the rest, they are cut off.",
    ),
    "innovations": (
        "Innovations",
        "GPS heading minus what was predicted. Beyond the gate, or where headings contradict one "
        "another, it is rejected; those beyond the edge are drawn on it. Below, the same as a test "
        "ratio: size over gate.",
    ),
    "health": (
        "Sensors",
        "A line a sensor: how it stood, and why. What is suspect or dead is not used.",
    ),
    "array": (
        "Array",
        "Whole epochs a second, samples that never came, and how many sensors are behind the fused "
        "rate on the worst axis.",
    ),
    "biases": (
        "Gyro bias",
        "Of the fused rate, as the filter holds it, with one standard deviation.",
    ),
    "tilt": ("Roll and pitch", "With one standard deviation, as stated."),
    "rates": (
        "Rates",
        "Of the vehicle, body forward, right, down; least and most of each moment.",
    ),
}


class LookBack:
    """Gathers what one replay comes to, and draws it when it has ended.

    Parameters
    ----------
    log : Path
    config : Config
    replayed : Replay
        That of the log, not yet begun.
    picture : Path or None
        Where heading and error go.
    directory : Path or None
        Where the page goes; it is made if it is not there.

    Raises
    ------
    RisafError
        Without matplotlib and jinja2.
    ConfigError
        If the directory is something else.
    """

    def __init__(
        self,
        log: Path,
        config: Config,
        replayed: Replay,
        picture: Path | None,
        directory: Path | None,
    ) -> None:
        plot.require()
        if directory:
            _require_jinja()
            if directory.exists() and not directory.is_dir():
                raise ConfigError(f"--report {directory}: found a file, expected a directory")
        self._log, self._config, self._replayed = log, config, replayed
        self._picture, self._directory = picture, directory
        self._course = Course()
        replayed.scorer.listeners.append(self._course.take_errors)
        self.take = self._course.take

    def finish(self) -> None:
        """Write what is wanted.

        Raises
        ------
        RisafError
            If it cannot be written.
        """
        self._course.finish()
        summary = self._replayed.summary()
        if self._picture:
            with plot.styled():
                figure = Album(self._course, shaded(summary)).overview(self._log.name)
                plot.save(figure, self._picture, plot.WIDE)
        if self._directory:
            made = page(self._log, self._config, summary, self._course, self._replayed.array_name)
            path = self._directory / PAGE
            try:
                self._directory.mkdir(parents=True, exist_ok=True)
                replace_file(path, made.encode())
            except OSError as error:
                raise ConfigError(f"--report {path}: {error.strerror or error}") from None


def _require_jinja() -> None:
    if not find_spec("jinja2"):
        raise RisafError("--report needs jinja2: install risaf-link with the extra `plot`")


def page(log: Path, config: Config, summary: dict[str, Any], course: Course, array: str) -> str:
    """Make the page.

    Parameters
    ----------
    log : Path
        Only its name is told.
    config : Config
        Of the replay.
    summary : dict
        `Replay.summary`.
    course : Course
        Of the same replay, finished.
    array : str
        What the array calls itself.
    """
    from jinja2 import Environment, StrictUndefined

    environment = Environment(autoescape=True, undefined=StrictUndefined)
    environment.filters["number"] = _number
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        log=log.name,
        array=array,
        summary=summary,
        course=course,
        began=_date(course.began_us),
        verdict=heading_verdict(summary, course),
        references=REFERENCES,
        sensor_sentences=sensor_sentences(course),
        sensors=sensor_rows(course),
        pictures=_pictures(course, shaded(summary)),
        configuration=dump(config),
        version=__version__,
    )


def shaded(summary: dict[str, Any]) -> list[tuple[float, float]]:
    """Outages of a summary, each once: begin and end, s."""
    return sorted({(row["start_s"], row["end_s"]) for row in summary["outages"]})


def _pictures(course: Course, outages: list[tuple[float, float]]) -> list[Picture]:
    albums = [Album(course, outages, size) for size in (plot.WIDE, plot.NARROW)]
    pictures = []
    with plot.styled():
        for name, (title, caption) in CAPTIONS.items():
            if name == "innovations" and not course.innovations.seen:
                continue
            draws: list[Callable[[], Figure]] = [getattr(album, name) for album in albums]
            sizes = plot.WIDE, plot.NARROW
            wide, narrow = (_url(draw(), size) for draw, size in zip(draws, sizes, strict=True))
            pictures.append(Picture(name, title, wide, narrow, caption))
    return pictures


def _url(figure: "Figure", size: plot.Size) -> str:
    """The picture itself, as a URL."""
    file = io.BytesIO()
    plot.save(figure, file, size)
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()


def _date(time_us: int) -> str:
    """A moment in words; empty if it can be none."""
    seconds = time_us / 1e6
    if not 0 < seconds < LATEST:
        return ""
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def _number(value: float | None, digits: int = 2) -> str:
    return "–" if value is None else f"{value:.{digits}f}"  # noqa: RUF001 what stands for nothing
