"""What can be tuned while the estimator runs: said once, beside each parameter's type and range.

A field of a parameters' struct that carries a `Tunable` is a MAVLink parameter. Its range is that
of its `Meta`; its text is the docstring below it, which the manual and the example configuration
repeat.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Tunable:
    """How a field is offered to a ground station."""

    name: str | tuple[str, ...]
    """Of at most 16 characters; several for a vector, one for each component."""
    unit: str = ""
    at_start: bool = False
    """It takes effect when the filter starts anew."""
