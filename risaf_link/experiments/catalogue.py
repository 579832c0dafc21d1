"""All methods by name, and how a method of one's own joins them."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from risaf_link.errors import ConfigError
from risaf_link.experiments.central import Centralised
from risaf_link.experiments.gyro_filters import (
    Integration,
    MeanEkf,
    Ours,
    Risaf,
    RobustFusion,
    SingleEkf,
    Virtual,
)
from risaf_link.experiments.method import ArrayModel, Method
from risaf_link.experiments.particles import Particles
from risaf_link.experiments.robust_filters import Correntropy, Huber, Variational
from risaf_link.experiments.unscented import Unscented

Factory = Callable[..., Method]


@dataclass(frozen=True, slots=True)
class Entry:
    """A method, and what it is called in figures and tables."""

    make: Factory
    title: str
    direct: bool = False  # whether it has an update of 3 n by 3 n besides
    slow: bool = False  # whether a step takes many times as long as ours


METHODS: dict[str, Entry] = {
    "ours": Entry(Ours, "ours"),
    "robust": Entry(RobustFusion, "our fusion, paper's filter"),
    "risaf": Entry(Risaf, "RISAF, paper's filter"),
    "mean": Entry(MeanEkf, "standard EKF on the mean"),
    "single": Entry(SingleEkf, "single-sensor EKF"),
    "integration": Entry(Integration, "mean, integrated"),
    "virtual": Entry(Virtual, "augmented virtual filter"),
    "centralised": Entry(Centralised, "centralised EKF", direct=True, slow=True),
    "huber": Entry(Huber, "Huber EKF", direct=True, slow=True),
    "mcc": Entry(Correntropy, "maximum correntropy EKF", direct=True, slow=True),
    "vb": Entry(Variational, "variational Bayesian EKF", direct=True, slow=True),
    "mmukf": Entry(Unscented, "robust M-M unscented", direct=True, slow=True),
    "particles": Entry(Particles, "correntropy particle filter", slow=True),
}

SLOW_SEEDS = 5
"""Of a drive, on which slow methods are run, so that the rest can be run on many."""


def methods_on(seed: int, own: Mapping[str, str]) -> tuple[str, ...]:
    """The methods that are run on a seed."""
    names = (name for name, entry in METHODS.items() if not entry.slow or seed < SLOW_SEEDS)
    return (*names, *own)


def titles(own: Mapping[str, str]) -> dict[str, str]:
    """What every method is called, and those of one's own: name to source text."""
    return {name: entry.title for name, entry in METHODS.items()} | {name: name for name in own}


def make(specification: str, array: ArrayModel, own: Mapping[str, str]) -> Method:
    """Make a method.

    Parameters
    ----------
    specification : str
        A name of `METHODS` or of `own`; behind a colon, parameters: `risaf:alpha=0.99,gate=0.15`.
    array : ArrayModel
    own : mapping
        Source text of methods of one's own, by name.

    Raises
    ------
    ConfigError
        If there is no such method.
    """
    name, _, tail = specification.partition(":")
    settings = dict(item.split("=") for item in tail.split(",")) if tail else {}
    if name in own:
        factory: Factory = _class_of(name, own[name])
    elif name in METHODS:
        factory = METHODS[name].make
    else:
        raise ConfigError(f"method: {name!r}, expected one of {', '.join([*METHODS, *own])}")
    return factory(array, **{key: _value(text) for key, text in settings.items()})


def read_own(path: Path) -> tuple[str, str]:
    """Read a method of one's own.

    Parameters
    ----------
    path : Path
        A Python file; its last class with a `step` is the method.

    Returns
    -------
    name, source : str

    Raises
    ------
    ConfigError
        If it cannot be read, or holds no method.
    """
    try:
        source = path.read_text()
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from None
    if path.stem in METHODS:
        raise ConfigError(f"{path}: the name {path.stem!r} is taken, expected another")
    _class_of(path.stem, source)
    return path.stem, source


def _class_of(name: str, source: str) -> Factory:
    module = ModuleType(name)
    try:
        exec(compile(source, f"{name}.py", "exec"), module.__dict__)  # noqa: S102 the user's own
    except Exception as error:
        raise ConfigError(f"{name}.py: {type(error).__name__}: {error}") from error
    classes: list[Any] = [
        thing
        for thing in vars(module).values()
        if inspect.isclass(thing) and thing.__module__ == name
    ]
    for found in reversed(classes):
        if all(hasattr(found, part) for part in ("step", "correct", "estimate")):
            return found  # type: ignore[no-any-return]
    raise ConfigError(f"{name}.py: expected a class with step, correct and estimate")


def _value(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
