"""Faults of sensors that no longer read: stuck, or silent. Times are in seconds from the start."""

import math
from dataclasses import dataclass

import numpy as np

from risaf_link.core.rotation import Floats
from risaf_link.sim.target import Strike, Target


@dataclass(frozen=True, slots=True)
class Frozen:
    """Sensors that repeat one reading from some time on."""

    share: float  # of the array
    onset: tuple[float, float]  # s: some time in between

    def strike(self, target: Target) -> Strike:
        """Begin to strike an array."""
        victims = target.victims(self.share)
        begin = target.when.uniform(*self.onset, len(victims))
        held = np.full((len(victims), 3), np.nan)

        def spoil(time_s: Floats, _: Floats, readings: Floats) -> None:
            first = np.searchsorted(time_s, begin)
            (new,) = np.nonzero((first < len(time_s)) & np.isnan(held[:, 0]))
            held[new] = readings[first[new], victims[new]]
            frozen = np.arange(len(time_s))[:, np.newaxis] >= first
            readings[:, victims] = np.where(frozen[:, :, np.newaxis], held, readings[:, victims])

        return spoil


@dataclass(frozen=True, slots=True)
class Saturated:
    """Sensors that are stuck at full scale, on all axes, from some time on."""

    share: float  # of the array
    onset: tuple[float, float]  # s: some time in between

    def strike(self, target: Target) -> Strike:
        """Begin to strike an array."""
        victims = target.victims(self.share)
        begin = target.when.uniform(*self.onset, len(victims))
        stuck = np.copysign(math.inf, target.how_much.uniform(-1.0, 1.0, (len(victims), 3)))

        def spoil(time_s: Floats, _: Floats, readings: Floats) -> None:
            since = (time_s[:, np.newaxis] >= begin)[:, :, np.newaxis]
            readings[:, victims] = np.where(since, stuck, readings[:, victims])

        return spoil


@dataclass(frozen=True, slots=True)
class Invalid:
    """Sensors whose readings are invalid now and then, for a spell."""

    share: float  # of the array
    every: float  # s from one spell to the next, mean
    length: float  # s, mean

    def strike(self, target: Target) -> Strike:
        """Begin to strike an array."""
        victims = target.victims(self.share)
        spells = math.ceil(2.0 * target.duration / self.every) + 20
        lengths = target.when.exponential((self.every, self.length), (spells, len(victims), 2))
        edges = np.cumsum(np.moveaxis(lengths, 2, 1).reshape(2 * spells, -1), axis=0)

        def spoil(time_s: Floats, _: Floats, readings: Floats) -> None:
            for victim, own_edges in zip(victims, edges.T, strict=True):
                passed = np.searchsorted(own_edges, time_s, side="right")
                readings[passed % 2 == 1, victim] = np.nan

        return spoil


@dataclass(frozen=True, slots=True)
class Dropouts:
    """Sensors that fall silent: their places in the chunks are marked invalid.

    Some come back.
    """

    share: float  # of the array
    returning: float  # share of those that come back
    absence: float  # s, mean, until they do
    onset: tuple[float, float]  # s: some time in between

    def strike(self, target: Target) -> Strike:
        """Begin to strike an array."""
        victims = target.victims(self.share)
        begin = target.when.uniform(*self.onset, len(victims))
        returns = target.when.random(len(victims)) < self.returning
        absence = target.when.exponential(self.absence, len(victims))
        end = np.where(returns, begin + absence, math.inf)

        def spoil(time_s: Floats, _: Floats, readings: Floats) -> None:
            now = time_s[:, np.newaxis]
            silent = (begin <= now) & (now < end)
            readings[:, victims] = np.where(silent[:, :, np.newaxis], np.nan, readings[:, victims])

        return spoil
