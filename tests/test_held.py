"""Datagrams that wait for the rest of their epoch: nothing comes later, or otherwise, for it."""

from itertools import count

import numpy as np
import pytest

from risaf_link.bench.feed import bursts
from risaf_link.config import load
from risaf_link.core.estimate import Estimate
from risaf_link.mavlink.frame import FrameParser
from risaf_link.mavlink.held import MESSAGE_ID, MOST_HELD, READINGS, Held
from risaf_link.pipeline import Pipeline
from risaf_link.service import Service
from risaf_link.sim.scenario import scenario

LINK = "links=[{name: array, url: 'udpout://127.0.0.1:14550', emit: {}}]"


def sent(name: str, epochs: int = 120) -> list[list[bytes]]:
    """Datagrams of every instant, of an array of 100 gyros."""
    chosen = scenario(name, seed=3, duration=epochs / 100, sensors=100)
    return [burst.frames for burst in bursts(chosen, epochs / 100)]


class Watched:
    """A service that is given datagrams by hand, and what it has estimated."""

    def __init__(self) -> None:
        self.estimates: list[Estimate] = []
        clock = count(1_700_000_000_000_000, 400)
        self.service = Service(load(None, [LINK]), clock_us=lambda: next(clock))
        self.service._component.observe = self.estimates.append  # type: ignore[method-assign]

    def give(self, data: bytes, peer: str = "") -> None:
        self.service._receive(self.service.links[0], data, peer)
        self.service._take_account()


class Singly:
    """The pipeline, frame by frame."""

    def __init__(self) -> None:
        self.estimates: list[Estimate] = []
        config = load(None, [])
        self._pipeline, self._parser = Pipeline(config, config.own), FrameParser()

    def give(self, data: bytes) -> None:
        for frame in self._parser.receive_data(data):
            self.estimates += self._pipeline.step(frame, 1_700_000_000_000_000)


def spoil(burst: list[bytes], how: str, generator: np.random.Generator) -> list[bytes]:
    if how == "in order":
        return burst
    if how == "shuffled":
        return [burst[i] for i in generator.permutation(len(burst))]
    if how == "lost":
        kept = (raw[MESSAGE_ID] not in READINGS or generator.random() > 0.05 for raw in burst)
        return [raw for raw, stays in zip(burst, kept, strict=True) if stays]
    return [raw for raw in burst for _ in range(1 + int(generator.random() < 0.2))]


@pytest.mark.parametrize("name", ["circle", "drive1"])
@pytest.mark.parametrize("how", ["in order", "shuffled", "repeated", "lost"])
def test_estimates_are_as_frame_by_frame_and_none_is_late(name, how):
    generator = np.random.default_rng(5)
    watched, singly = Watched(), Singly()
    for burst in sent(name):
        came = spoil(burst, how, generator)
        for raw in came:
            watched.give(raw)
            singly.give(raw)
        if burst[-1] in came:
            assert len(watched.estimates) == len(singly.estimates)
    assert len(singly.estimates) > 80
    for ours, theirs in zip(watched.estimates, singly.estimates, strict=False):
        assert ours.time_us == theirs.time_us
        assert ours.attitude.q_nb.tolist() == theirs.attitude.q_nb.tolist()
        assert ours.fused.rate_b.tolist() == theirs.fused.rate_b.tolist()
        assert ours.array.epochs == theirs.array.epochs
        assert ours.array.samples_lost == theirs.array.samples_lost


def test_an_epoch_is_taken_with_its_last_datagram_at_once():
    watched = Watched()
    for burst in sent("circle", 20):
        for raw in burst[:-1]:
            watched.give(raw)
        before = len(watched.estimates)
        watched.give(burst[-1])
        assert len(watched.estimates) >= before
    assert len(watched.estimates) == 20


def test_what_waits_is_taken_before_what_another_sends():
    watched = Watched()
    *whole, last = sent("circle", 20)
    for burst in whole:
        for raw in burst:
            watched.give(raw)
    watched.give(last[0], "array")
    watched.give(last[0], "array")
    frames = watched.service._frames
    watched.give(b"\0", "another")
    assert watched.service._frames >= frames + 1


def end(held, data):
    """Let an epoch end with a datagram."""
    assert not held.holds(data)
    held.note_end(steady=True)


def test_no_more_is_held_than_that():
    first, second = (raw for raw in sent("circle", 20)[-1][-2:])
    held = Held()
    end(held, second)
    assert all(held.holds(first) for _ in range(MOST_HELD))
    assert not held.holds(first)
    assert held.take(second) == MOST_HELD * first + second
    assert not held


def test_nothing_is_held_while_something_waits_in_the_pipeline():
    first, second = (raw for raw in sent("circle", 20)[-1][-2:])
    held = Held()
    end(held, second)
    held.note_end(steady=False)
    assert not held.holds(first)


@pytest.mark.parametrize("cut", range(0, 30, 3))
def test_a_piece_of_a_frame_is_not_held(cut):
    first, second = (raw for raw in sent("circle", 20)[-1][-2:])
    held = Held()
    end(held, second)
    assert not held.holds(first[:cut])
    assert not held.holds(first + second[:cut] + b"\0")
