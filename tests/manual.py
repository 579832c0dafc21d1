"""The manual and the example configuration say of each parameter what stands beside its field.

python tests/manual.py      writes what is generated in both
"""

import ast
import inspect
import re
import sys
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from msgspec import Struct

from risaf_link.config import Config
from risaf_link.mavlink.parameters import Parameter, Parameters, parameters_of
from risaf_link.publish.topics import MESSAGES

ROOT = Path(__file__).parents[1]
PAGE, EXAMPLE = ROOT / "docs" / "mavlink.md", ROOT / "config" / "risaf_link.yaml"
BEGIN, END = "<!-- parameters: tests/manual.py writes them -->\n", "<!-- end -->\n"
TOPICS_PAGE = ROOT / "docs" / "mqtt.md"
IN_ALL = {"schema", "time_us", "unix_us"}  # fields of messages
TOPICS_BEGIN = "<!-- topics: tests/manual.py writes them -->\n"


def documented() -> list[tuple[Parameter, str]]:
    """All parameters with the texts of their fields."""
    return [(parameter, _text(parameter)) for parameter in parameters_of(Config)]


def table() -> str:
    """The parameters as the page has them."""
    parameters = Parameters(Config())
    lines = ["| name | key | unit | default | range | |", "|---|---|---|---|---|---|"]
    for i, (parameter, text) in enumerate(documented()):
        allowed = parameter.expected
        if parameter.words:
            allowed = ", ".join(f"{k} {word}" for k, word in enumerate(parameter.words))
        when = " At the filter's next start." if parameter.at_start else ""
        cells = (
            parameter.name,
            f"`{parameter.key}`",
            parameter.unit,
            f"{parameters.value(i):g}",
            allowed,
            f"{text}.{when}",
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def page() -> str:
    """The page, with the table that is right."""
    head, _, rest = PAGE.read_text().partition(BEGIN)
    return head + BEGIN + table() + END + rest.partition(END)[2]


def topics_page() -> str:
    """The page on MQTT, with the messages as they are."""
    head, _, rest = TOPICS_PAGE.read_text().partition(TOPICS_BEGIN)
    parts = []
    for topic, message in MESSAGES.items():
        parts.append(f"**`{topic}`** {message.__doc__}\n")
        hints = get_type_hints(message, include_extras=True)
        rows = [
            f"| `{name}` | {_kind(hint)} | {_meant(hint)} |"
            for name, hint in hints.items()
            if name not in IN_ALL or topic == "availability"
        ]
        parts.append("\n".join(["| field | is | |", "|---|---|---|", *rows]) + "\n")
    return head + TOPICS_BEGIN + "\n" + "\n".join(parts) + "\n" + END + rest.partition(END)[2]


def _kind(hint: Any) -> str:
    """What JSON has there."""
    names = {int: "integer", float: "number", str: "string", type(None): "null"}
    if get_args(hint) and get_origin(hint) in {Annotated, UnionType}:
        parts = get_args(hint) if get_origin(hint) is UnionType else get_args(hint)[:1]
        return " or ".join(_kind(part) for part in parts)
    if get_origin(hint) is list:
        return f"[{_kind(get_args(hint)[0])}, ...]"
    return names[hint]


def _meant(hint: Any) -> str:
    """What a field's annotation says of it."""
    return str(next(note.description for note in hint.__metadata__ if note.description))


def example() -> str:
    """The example configuration, with the comments that are right."""
    comments = {}
    for parameter, text in documented():
        section, key, *_ = parameter.path
        unit = f"{parameter.unit}; " if parameter.unit else ""
        if section != "emit":
            comments[section, key] = unit + text
    lines, section = [], ""
    for line in EXAMPLE.read_text().splitlines():
        found = re.match(r"(\w+):|  (\w+): *(\[.*?\]|[^# ]+) *# ", line)
        section = (found and found[1]) or section
        if found and (section, found[2]) in comments:
            value = f"  {found[2]}: {found[3]} "
            lines.append(f"{value:<22} # {comments[section, found[2]]}")
        else:
            lines.append(line)
    return "\n".join(lines) + "\n"


def _text(parameter: Parameter) -> str:
    schema: type[Struct] = Config
    *sections, key = [step for step in parameter.path if isinstance(step, str)]
    if sections == ["emit"]:
        return f"{key}: {_docstrings(Config)['emit']}"
    for section in sections:
        schema = next(hint for hint in _structs(schema) if hint[0] == section)[1]
    return _docstrings(schema)[key]


def _structs(schema: type[Struct]) -> list[tuple[str, type[Struct]]]:
    return [(name, type(getattr(schema(), name))) for name in schema.__struct_fields__]


def _docstrings(schema: type[Struct]) -> dict[str, str]:
    """Texts below a struct's fields."""
    (definition,) = ast.parse(inspect.getsource(schema)).body
    assert isinstance(definition, ast.ClassDef)
    texts = {}
    for field, below in zip(definition.body, definition.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
            assert isinstance(field.target, ast.Name)
            text = ast.literal_eval(below.value)
            texts[field.target.id] = " ".join(text.split()).removesuffix(".")
    return texts


if __name__ == "__main__":
    PAGE.write_text(page())
    TOPICS_PAGE.write_text(topics_page())
    EXAMPLE.write_text(example())
    sys.exit()
