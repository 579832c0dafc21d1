"""YAML that people or machines have written, read with care.

Nothing but plain values comes of it. A key that stands twice is an error, where YAML would take the
last one. A document that is too large, too deep, or too large once its aliases are written out, is
an error as well: a few lines of aliases make billions of values.
"""

from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

LARGEST = 1_000_000  # bytes; a calibration of 1000 sensors takes a quarter
MOST_VALUES = 100_000  # aliases written out; that calibration has 50 000
LONGEST = 2048  # characters of one value: a number of more cannot even be told
DEEPEST = 32


class DocumentError(ValueError):
    """What is wrong with a document, in one line."""


class _Loader(yaml.SafeLoader):
    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        found: set[Hashable] = set()
        for key_node, _ in node.value:
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


def _too_deep() -> DocumentError:
    return DocumentError(f"found values more than {DEEPEST} deep in one another, expected fewer")
