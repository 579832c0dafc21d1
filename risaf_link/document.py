"""YAML, read strictly: a document is data that make sense, or an error says where it does not."""

import reprlib
from collections.abc import Hashable
from typing import Any, NoReturn

import yaml

DEEPEST = 32  # levels of lists and mappings; nothing of ours has more than 6


def parsed(text: str) -> Any:
    """What a document says.

    Raises
    ------
    yaml.YAMLError
        Where it is none. So is what PyYAML would leave with errors of other kinds: a date that no
        calendar has, a number that is none or has thousands of digits, levels without end; what it
        would take silently: a key that stands twice, of which it would take the last; and text that
        cannot be written to a file, or name one.
    """
    return yaml.load(text, _StrictLoader)  # noqa: S506 it is a SafeLoader


class _StrictLoader(yaml.SafeLoader):
    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._level = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        self._level += 1
        if self._level > DEEPEST:
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            _refuse(mark, f"more than {DEEPEST} levels")
        node: yaml.Node | None = super().compose_node(parent, index)
        self._level -= 1
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        if not isinstance(node, yaml.ScalarNode):
            return super().construct_object(node, deep)
        try:
            value = super().construct_object(node, deep)
        except (ArithmeticError, AttributeError, LookupError, ValueError):
            kind = node.tag.rpartition(":")[2]
            _refuse(node.start_mark, f"{reprlib.repr(node.value)}, expected one of kind {kind}")
        if isinstance(value, str) and not _is_text(value):
            _refuse(node.start_mark, "characters that are not for text")
        return value

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        pairs = node.value if isinstance(node, yaml.MappingNode) else []
        keys = [self.construct_object(key, deep=True) for key, _ in pairs]
        for i, key in enumerate(keys):
            if key in keys[:i]:
                line = pairs[i][0].start_mark.line + 1
                raise yaml.YAMLError(f"line {line}: {key}: found twice, expected once")
        return super().construct_mapping(node, deep)


def _refuse(mark: yaml.Mark, found: str) -> NoReturn:
    raise yaml.YAMLError(f"line {mark.line + 1}: found {found}")


def _is_text(value: str) -> bool:
    return "\0" not in value and not any("\ud800" <= character <= "\udfff" for character in value)
