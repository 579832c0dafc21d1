"""The parameters that a ground station sees: a configuration's tunable values, under short names.

Every one is a REAL32, also where it chooses among words (by their index). Ground stations guess how
an integer lies in the float field from the vehicle's autopilot, whose ways differ (bytewise in PX4,
cast in ArduPilot), not from the component that sends it; for REAL32 all ways are the same.
"""

import struct
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, Any, Generic, Literal, TypeVar, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta, Struct

from risaf_link.core.tunable import Tunable

_FLOAT32 = struct.Struct("<f")
_LARGEST = 3.4e38  # that a float32 holds

Tuned = TypeVar("Tuned", bound=Struct)


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter, as it is offered."""

    name: str  # of at most 16 characters
    path: tuple[str | int, ...]  # where it stands in the configuration
    unit: str
    lowest: float
    highest: float
    words: tuple[str, ...] = ()  # that it chooses among, by their index
    open_below: bool = False  # the lowest is excluded
    open_above: bool = False
    at_start: bool = False  # it takes effect when the filter starts anew

    @property
    def key(self) -> str:
        """Its place in the configuration, as `--set` has it."""
        return ".".join(map(str, self.path))

    @property
    def expected(self) -> str:
        """What it may be, in words."""
        if self.words:
            return f"0 to {len(self.words) - 1}, whole"
        below, above = "above " * self.open_below, "below " * self.open_above
        return f"{below}{self.lowest:g} to {above}{self.highest:g}"

    def admits(self, value: float) -> bool:
        """Whether a value may be taken."""
        above = value > self.lowest if self.open_below else value >= self.lowest
        below = value < self.highest if self.open_above else value <= self.highest
        return above and below and (not self.words or value == int(value))


class Parameters(Generic[Tuned]):
    """A configuration's tunable values: read by name, set with validation.

    Parameters
    ----------
    configured : Struct
        The values that a reset brings back.
    kept : mapping of str to float
        Values kept from before, by name, that go over them. What is not known or not allowed is
        left out.
    overruled : mapping of str to float
        Values that are kept as well, but not in force.
    fixed : collection of str
        Names of those that cannot be set.

    Attributes
    ----------
    all : tuple of Parameter
        In the order of their indices, which never changes.
    tuned : Struct
        The configuration with the values now in force.
    kept : dict of str to float
        What was set, by name: what is worth keeping.
    """

    def __init__(
        self,
        configured: Tuned,
        kept: Mapping[str, float] | None = None,
        overruled: Mapping[str, float] | None = None,
        fixed: Collection[str] = (),
    ) -> None:
        self.all = parameters_of(type(configured))
        self.kept: dict[str, float] = dict(overruled or {})
        self.tuned = self._configured = configured
        self._fixed = frozenset(fixed)
        self._index = {parameter.name: i for i, parameter in enumerate(self.all)}
        for name, value in (kept or {}).items():
            self.set(name, value)

    def index(self, name: str) -> int | None:
        """Index of a parameter; None: there is none of that name."""
        return self._index.get(name)

    def value(self, index: int) -> float:
        """Value in force."""
        parameter = self.all[index]
        found = _found(self.tuned, parameter.path)
        return float(parameter.words.index(found) if parameter.words else found)

    def set(self, name: str, value: float) -> bool:
        """Set a parameter; whether the value was taken.

        A value that is that in force, rounded to a float32, changes nothing.
        """
        index = self.index(name)
        if index is None or name in self._fixed or not self.all[index].admits(value):
            return False
        if value != rounded(self.value(index)):
            self.tuned = self._with(self.all[index], value)
        self.kept[name] = value
        return True

    def reset(self) -> None:
        """Bring back what was configured, and keep nothing."""
        self.tuned, self.kept = self._configured, {}

    def _with(self, parameter: Parameter, value: float) -> Tuned:
        tree = msgspec.json.decode(msgspec.json.encode(self.tuned))  # tuples as lists
        *way, last = parameter.path
        place = tree
        for step in way:
            place = place[step]
        if isinstance(_found(self.tuned, way), dict) and value == 0.0:
            place.pop(last, None)
        else:
            place[last] = parameter.words[int(value)] if parameter.words else value
        return msgspec.convert(tree, type(self.tuned))


@cache
def parameters_of(schema: type[Struct]) -> tuple[Parameter, ...]:
    """All parameters of a configuration, in its order."""
    return tuple(_walk(schema, ()))


def rounded(value: float) -> float:
    """A value as a float32 carries it."""
    result: float = _FLOAT32.unpack(_FLOAT32.pack(value))[0]
    return result


def _walk(schema: type[Struct], path: tuple[str, ...]) -> Iterator[Parameter]:
    for name, hint in get_type_hints(schema, include_extras=True).items():
        if isinstance(hint, type) and issubclass(hint, Struct):
            yield from _walk(hint, (*path, name))
        elif get_origin(hint) is Annotated:
            kind, *notes = get_args(hint)
            for tunable in (note for note in notes if isinstance(note, Tunable)):
                yield from _offered(kind, notes, tunable, (*path, name))


def _offered(
    kind: Any, notes: list[Any], tunable: Tunable, path: tuple[str | int, ...]
) -> Iterator[Parameter]:
    if isinstance(tunable.name, str):
        yield _parameter(tunable, tunable.name, kind, notes, path)
    elif get_origin(kind) is dict:  # of rates: what is left out is 0
        keys, rate = get_args(kind)
        for name, key in zip(tunable.name, get_args(keys), strict=True):
            parameter = _parameter(tunable, name, *_unpacked(rate), (*path, key))
            yield replace(parameter, lowest=0.0, open_below=False)
    else:
        for i, (name, part) in enumerate(zip(tunable.name, get_args(kind), strict=True)):
            yield _parameter(tunable, name, *_unpacked(part), (*path, i))


def _unpacked(hint: Any) -> tuple[Any, list[Any]]:
    kind, *notes = get_args(hint)
    return kind, notes


def _parameter(
    tunable: Tunable, name: str, kind: Any, notes: list[Any], path: tuple[str | int, ...]
) -> Parameter:
    if get_origin(kind) is Literal:
        words = get_args(kind)
        return Parameter(name, path, "", 0, len(words) - 1, words, at_start=tunable.at_start)
    meta = next((note for note in notes if isinstance(note, Meta)), Meta())
    lowest = next((float(x) for x in (meta.ge, meta.gt) if x is not None), -_LARGEST)
    highest = next((float(x) for x in (meta.le, meta.lt) if x is not None), _LARGEST)
    return Parameter(
        name,
        path,
        tunable.unit,
        lowest,
        highest,
        open_below=meta.gt is not None,
        open_above=meta.lt is not None,
        at_start=tunable.at_start,
    )


def _found(tuned: Any, path: Iterable[str | int]) -> Any:
    """What stands at a place of a configuration; a rate that is left out is 0."""
    for step in path:
        if isinstance(tuned, dict):
            tuned = tuned.get(step, 0.0)
        else:
            tuned = tuned[step] if isinstance(step, int) else getattr(tuned, step)
    return tuned
