"""Figures as a table for a terminal, and as an object for JSON."""

from collections.abc import Iterable
from typing import Any

from rich.console import Console
from rich.table import Table

from risaf_link.bench.figure import Figure, Spread

DIGITS = 3  # that are shown


def as_object(machine: dict[str, Any], figures: Iterable[Figure]) -> dict[str, Any]:
    """All that was measured, and where."""
    return {"machine": machine, "figures": {figure.key: figure.as_dict() for figure in figures}}


def show(machine: dict[str, Any], figures: Iterable[Figure], console: Console) -> None:
    """Print the table: medians, and the least and most where there are several."""
    table = Table(
        *("figure", "unit", "ours", "reference", "is", "ratio", "goal", ""),
        title=", ".join(_words(machine)),
        title_justify="left",
        caption="median (least to most); ratio: how many times better than the reference",
        caption_justify="left",
    )
    notes = []
    for figure in figures:
        ratio = f"{_number(figure.ratio)} x" if figure.ratio else ""
        bound = "above" if figure.more_is_better else "below"
        goal = "" if figure.goal is None else f"{bound} {figure.goal:g}"
        if figure.goal == 0:
            goal = "0"
        verdict = {True: "yes", False: "[red]no", None: ""}[figure.reached]
        values = _text(figure.ours), _text(figure.reference), figure.against
        table.add_row(figure.text, figure.unit, *values, ratio, goal, verdict)
        if figure.note:
            notes.append(f"{figure.text}: {figure.note}")
    console.print(table)
    for note in dict.fromkeys(notes):
        console.print(note, highlight=False)


def _words(machine: dict[str, Any]) -> list[str]:
    kernel = "kernel built" if machine["kernel"] else "no kernel: NumPy alone"
    load = "/".join(f"{value:g}" for value in machine["load_average"])
    return [
        f"{machine['processor']}, {machine['cores']} cores",
        f"load {load}",
        f"Python {machine['python']}, NumPy {machine['numpy']}",
        kernel,
    ]


def _text(spread: Spread | None) -> str:
    if spread is None:
        return "-"
    if spread.least == spread.most:
        return _number(spread.median)
    return f"{_number(spread.median)} ({_number(spread.least)} to {_number(spread.most)})"


def _number(value: float) -> str:
    """Write three digits, and no exponent."""
    whole = len(str(int(abs(value))))
    decimals = max(0, DIGITS - whole) if abs(value) >= 1 else DIGITS
    return f"{value:.{decimals}f}"
