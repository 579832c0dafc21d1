"""Targets: what stands in files."""

import json
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
from fuzz_checks import (
    ROOM,
    check_config,
    check_estimates,
    check_line,
    driven,
)
from fuzz_script import START_US
from msgspec import structs
from network import OWN
from streams import KEY

from risaf_link.config import Config, load, load_calibration
from risaf_link.core.array import Calibration
from risaf_link.errors import ConfigError
from risaf_link.kept import kept_parameters
from risaf_link.keys import open_keys, state_path
from risaf_link.mavlink.parameters import Parameters
from risaf_link.pipeline import Pipeline
from risaf_link.remembered import decoded, encoded


def config(data: bytes) -> None:
    """A file is a configuration, which can be written and read again, or a line says why not."""
    path = ROOM / "any.yaml"
    setting, _, content = data.partition(b"\n\n") if data[:1] == b"=" else (b"", b"", data)
    settings = [setting[1:].decode(errors="replace")] if setting else []
    path.write_bytes(content)
    try:
        found = load(path, settings)
    except ConfigError as error:
        check_line(error)
        return
    check_config(found)
    check_line(ConfigError(repr(kept_parameters(found, path, settings).values)))


def kept(data: bytes) -> None:
    """What the program itself has kept is used as far as it can be; it never bars a start."""
    path = ROOM / "kept.yaml"
    path.with_suffix(".parameters.yaml").write_bytes(data)
    values = kept_parameters(Config(), path).values
    check_config(Parameters(Config(), values).tuned)
    _open_key(data)


def _open_key(state: bytes) -> None:
    key = ROOM / "key"
    for path, content in ((key, KEY), (state_path(key), state)):
        path.write_bytes(content)
        path.chmod(0o600)
    link = {"name": "ground", "url": "udpin://127.0.0.1:14560", "signing": {"key": str(key)}}
    keys = open_keys(load(None, [f"links={json.dumps([link])}"]))
    keys.advance(START_US)
    sign = keys.links["ground"].sign
    assert sign is not None
    before = keys.links["ground"].key.ticks
    assert len(sign(b"any frame")) == 13
    assert keys.links["ground"].key.ticks == before + 1
    keys.open()


def calibration(data: bytes) -> None:
    """Any file is a calibration, by which rates are corrected, or one line says why not."""
    path = ROOM / "calibration.yaml"
    path.write_bytes(data)
    array = structs.replace(Config().array, calibration=str(path))
    try:
        found = load_calibration(structs.replace(Config(), array=array))
    except ConfigError as error:
        check_line(error)
        return
    assert found is not None
    n = len(found.gyros)
    rates_b, forces_b = Calibration(found).apply(np.zeros((2, n, 3)), np.zeros((2, n, 3)))
    assert rates_b.shape == forces_b.shape == (2, n, 3)
    assert not np.isnan(rates_b).any()


NASTY = [0, 1, -1, 0.5, 1e-9, 1e9, -1e9, 1e300, 1e-300, 2**53, 2**63, -(2**63), 2**70]


NASTIER = [None, True, False, "", "x", [], {}, [[1.0]], [1.0, [2.0]], {"version": 1}]


def state(data: bytes) -> None:
    """A state is of no use and one line says why, or an estimator goes on from it."""
    content = data[1:] if data[:1] == b"r" else _edited(data)
    try:
        memory = decoded(content)
    except ValueError as error:
        check_line(error)
        return
    assert memory.is_sound
    pipeline = Pipeline(Config(), OWN, memory=memory)
    for frame, received_us in driven():
        for block in pipeline.gather(frame, received_us):
            check_estimates(block)
    for block in pipeline.release():
        check_estimates(block)
    assert pipeline.recalled


def _edited(data: bytes) -> bytes:
    """A sensible state in which some values are others."""
    tree = json.loads(a_state())
    leaves = list(_leaves(tree))
    for at in range(0, len(data) - 3, 4):
        parent, key = leaves[int.from_bytes(data[at : at + 2], "little") % len(leaves)]
        how, amount = data[at + 2], data[at + 3]
        if how < len(NASTY):
            parent[key] = NASTY[how]
        elif how < len(NASTY) + len(NASTIER):
            parent[key] = NASTIER[how - len(NASTY)]
        elif isinstance(parent[key], float):
            parent[key] *= 10.0 ** ((amount - 128) / 16) * (-1) ** how
    return json.dumps(tree).encode()


def _leaves(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Every place in a tree: what it is in, and its key or index."""
    for key in list(tree) if isinstance(tree, dict) else range(len(tree)):
        yield tree, key
        if isinstance(tree[key], dict | list):
            yield from _leaves(tree[key])


@cache
def a_state() -> bytes:
    pipeline = Pipeline(Config(), OWN)
    for frame, received_us in driven():
        pipeline.step(frame, received_us)
    memory = pipeline.memory()
    assert memory is not None
    return encoded(memory)
