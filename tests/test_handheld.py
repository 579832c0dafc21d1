"""Inclination of a hand-held IMU, side by side with VQF on the same readings."""

import numpy as np
import pytest

pytest.importorskip("vqf", reason="VQF is not installed: the extra `bench`")

from handheld import KINDS, METHODS, RATE, SETTLED, errors, trial

SEEDS = range(3)
SECONDS = 70.0  # two motions and the rests about them


@pytest.mark.parametrize("kind", KINDS)
def test_inclination_is_better_than_vqf_s(kind):
    """Median over seeds, after a start of two seconds, both by their defaults."""
    settled = slice(round(SETTLED * RATE), None)
    rms = []
    for seed in SEEDS:
        one = trial(KINDS[kind], "instant" if seed % 2 else "mean", seed, SECONDS)
        methods = (METHODS["eskf"], METHODS["vqf"])
        squares = [errors(one, method(one))[settled] ** 2 for method in methods]
        rms.append(np.sqrt([square.mean() for square in squares]))
    ours, theirs = np.median(rms, axis=0)
    assert ours < theirs
