"""YAML that people or machines have written, read with care.

Nothing but plain values comes of it. A key that stands twice is an error, where YAML would take the
last one; so is text that cannot be written to a file, or name one; and so is a document that is too
large, too deep, or too large once its aliases are written out: a few lines of them make billions of
values.
"""

import reprlib
from collections.abc import Hashable
from pathlib import Path
from typing import Any, NoReturn

import yaml

LARGEST = 1_000_000  # bytes; a calibration of 1000 sensors takes a quarter
MOST_VALUES = 100_000  # aliases written out; that calibration has 50 000
LONGEST = 2048  # characters of one value: a number of more cannot even be told
DEEPEST = 32


class DocumentError(ValueError):
    """What is wrong with a document, in one line."""


class _Loader(yaml.SafeLoader):
    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        if not isinstance(node, yaml.ScalarNode):
            return super().construct_object(node, deep)
        try:
            value = super().construct_object(node, deep)
        except (ArithmeticError, AttributeError, LookupError, ValueError):  # numbers, dates
            kind = node.tag.rpartition(":")[2]
            _refuse(node.start_mark, f"{reprlib.repr(node.value)}, expected one of kind {kind}")
        if isinstance(value, str) and not _is_text(value):
            _refuse(node.start_mark, "characters that are not for text")
        return value

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        found: set[Hashable] = set()
        pairs = node.value if isinstance(node, yaml.MappingNode) else []
        for key_node, _ in pairs:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, Hashable):
                continue  # which is told below
            if key in found:
                line = key_node.start_mark.line + 1
                raise yaml.YAMLError(f"line {line}: {key}: found twice, expected once")
            found.add(key)
        return super().construct_mapping(node, deep)


def read_document(path: Path) -> Any:
    """Read a file.

    Raises
    ------
    OSError
        It cannot be read.
    DocumentError
        It is not what it should be.
    """
    with path.open("rb") as file:
        content = file.read(LARGEST + 1)
    if len(content) > LARGEST:
        raise DocumentError(f"found more than {LARGEST} bytes, expected YAML")
    try:
        return parse_document(content.decode())
    except UnicodeDecodeError:
        raise DocumentError("found bytes that are not UTF-8, expected YAML") from None


def parse_document(text: str) -> Any:
    """Read a text.

    Raises
    ------
    DocumentError
        It is not what it should be.
    """
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        _weigh(node, {}, 0)
        return loader.construct_document(node)
    except DocumentError:
        raise
    except RecursionError:
        raise _too_deep() from None
    except (yaml.YAMLError, ValueError, OverflowError) as error:  # of numbers and dates as well
        raise DocumentError(" ".join(str(error).split())) from None
    except (AttributeError, LookupError, TypeError):  # what is tagged as something that it is not
        raise DocumentError("found a tag that does not fit its value, expected none") from None


def _weigh(node: yaml.Node, weights: dict[int, int], depth: int) -> int:
    """How many values a node stands for, aliases written out."""
    if depth > DEEPEST:
        raise _too_deep()  # also what contains itself
    if isinstance(node, yaml.ScalarNode):
        if len(node.value) > LONGEST:
            raise DocumentError(f"found a value of more than {LONGEST} characters, expected fewer")
        return 1
    if id(node) not in weights:
        parts = (
            node.value
            if isinstance(node, yaml.SequenceNode)
            else [part for pair in node.value for part in pair]
        )
        weights[id(node)] = 1 + sum(_weigh(part, weights, depth + 1) for part in parts)
        if weights[id(node)] > MOST_VALUES:
            raise DocumentError(f"found more than {MOST_VALUES} values, expected fewer")
    return weights[id(node)]


def _refuse(mark: yaml.Mark, found: str) -> NoReturn:
    raise yaml.YAMLError(f"line {mark.line + 1}: found {found}")


def _is_text(value: str) -> bool:
    return "\0" not in value and not any("\ud800" <= character <= "\udfff" for character in value)


def _too_deep() -> DocumentError:
    return DocumentError(f"found values more than {DEEPEST} deep in one another, expected fewer")
