"""What an experiment leaves behind: a figure, numbers as JSON and CSV, and its part of the page."""

import csv
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from risaf_link import __version__
from risaf_link.errors import ConfigError
from risaf_link.sweep import Row, Sweep

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Setting:
    """Where an experiment writes, and how large it is."""

    out: Path
    sweep: Sweep
    quick: bool = False
    seeds: int = 20
    own: tuple[tuple[str, str], ...] = ()  # methods of the user's own: name, source text

    def range(self, most: int) -> range:
        """Seeds, at most so many."""
        return range(min(self.seeds, most))


@dataclass(frozen=True)
class Section:
    """One experiment's part of the page."""

    name: str
    title: str
    says: str  # what was done, in a sentence or two
    paper: str  # what the paper reports
    head: Sequence[str]
    rows: Sequence[Sequence[Any]]
    parameters: Mapping[str, Any]
    numbers: Mapping[str, Any] = field(default_factory=dict)  # beside the rows

    def markdown(self) -> str:
        """Show the figure and the table."""
        lines = [
            f"## {self.name}: {self.title}",
            "",
            self.says,
            "",
            f"*The paper:* {self.paper}",
            "",
            f"![{self.title}]({self.name}.png)",
            "",
            "| " + " | ".join(self.head) + " |",
            "|" + "---|" * len(self.head),
        ]
        lines += ["| " + " | ".join(map(_shown, row)) + " |" for row in self.rows]
        files = ", ".join(f"[{self.name}.{kind}]({self.name}.{kind})" for kind in ("json", "csv"))
        return "\n".join([*lines, "", f"Numbers, seeds and parameters: {files}.", ""])


def write(setting: Setting, section: Section, figure: "Figure") -> Section:
    """Write the figure and the numbers of an experiment."""
    table = [dict(zip(section.head, row, strict=True)) for row in section.rows]
    content = {
        "experiment": section.name,
        "version": __version__,
        "quick": setting.quick,
        "parameters": section.parameters,
        "table": table,
        **section.numbers,
    }
    try:
        setting.out.mkdir(parents=True, exist_ok=True)
        figure.savefig(setting.out / f"{section.name}.png", dpi=110)
        path = setting.out / f"{section.name}.json"
        path.write_text(json.dumps(_plain(content), indent=1) + "\n")
        with (setting.out / f"{section.name}.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(section.head)
            writer.writerows(section.rows)
    except OSError as error:
        raise ConfigError(f"{setting.out}: {error.strerror or error}") from None
    return section


def page(setting: Setting, sections: Iterable[Section]) -> Path:
    """Write the page that shows all experiments."""
    how = "quick: few seeds, few sensors, short drives" if setting.quick else "full"
    head = f"# The paper's experiments, repeated\n\nrisaf-link {__version__}, {how}.\n"
    path = setting.out / "index.md"
    path.write_text("\n".join([head, *(section.markdown() for section in sections)]))
    return path


def spread(values: Iterable[float]) -> tuple[float, float, float]:
    """Median and quartiles; a run without a heading counts as the worst, half a turn."""
    known = np.array([180.0 if value is None or math.isnan(value) else value for value in values])
    low, middle, high = np.quantile(known, (0.25, 0.5, 0.75)).tolist()
    return middle, low, high


def rmses(results: Sequence[Row], method: str, reference: str = "truth") -> list[float]:
    """Heading RMSE, deg, of a method in all outages of all its results; NaN without a heading."""
    return [
        outage[reference]["rmse_deg"] if outage[reference] else math.nan
        for result in results
        if method in result["methods"]
        for outage in result["methods"][method]["outages"]
    ]


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.3g}" if abs(value) < 1 else f"{value:.2f}"
    return str(value)


def _plain(value: Any) -> Any:
    """Content for JSON, which has no NaN."""
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple, range)):
        return [_plain(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
