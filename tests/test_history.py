"""What is kept of a run in constant memory."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from risaf_link.core.history import ROOM, History, Worst

VALUES = st.lists(
    st.tuples(st.floats(0, 500), st.floats(-9, 9)), min_size=1, max_size=80
)  # s; value


def stepwise(history: History, pairs: list[tuple[float, float]], how) -> list[float]:
    """Of each step that was used, what its values come to."""
    steps: dict[int, list[float]] = {}
    for time_s, value in pairs:
        steps.setdefault(int(time_s / history.step), []).append(value)
    return [how(steps[k]) for k in sorted(steps)]


@given(VALUES, st.integers(1, 80))
def test_a_step_keeps_the_least_the_most_and_the_sum_of_its_values(pairs, cut):
    for keeps, how in (("least", min), ("most", max), ("sum", sum)):
        history = History(keeps, 1)
        for part in (pairs[:cut], pairs[cut:]):
            table = np.array(part).reshape(-1, 2)
            history.add(table[:, 0], table[:, 1:])
        used = {int(t / history.step) for t, _ in pairs}
        found = [history.values[k, 0] for k in sorted(used)]
        assert found == pytest.approx(stepwise(history, pairs, how), abs=1e-9)


def test_the_first_value_of_a_step_is_that_which_came_first():
    history = History("first", 1)
    time_s = np.arange(0.0, 300.0, 0.01)
    history.add(time_s, time_s[:, np.newaxis])
    assert history.values[:, 0] == pytest.approx(history.edges[:-1], abs=0.011)


def test_a_history_of_years_is_no_longer_than_that_of_a_minute():
    history = History("sum", 1)
    for day in range(1000):
        history.add(np.array([86400.0 * day]), np.ones((1, 1)))
    assert len(history) <= ROOM
    assert history.edges[-1] > 86400.0 * 999
    assert history.values.sum() == 1000


@given(VALUES, st.integers(1, 50))
def test_sums_over_all_parts_of_the_time_are_the_whole(pairs, parts):
    history = History("sum", 1)
    table = np.array(pairs)
    history.add(table[:, 0], np.ones((len(table), 1)))
    edges = np.linspace(0.0, history.edges[-1], parts + 1)
    assert history.between(edges).sum() == pytest.approx(len(pairs))


def test_quantities_that_come_later_have_no_past():
    history = History("most", 1)
    history.add(np.array([0.5]), np.array([[1.0]]))
    history.widen(2)
    history.add(np.array([9.5]), np.array([[2.0, 3.0]]))
    kept = history.values[np.isfinite(history.values).any(axis=1)]
    assert kept == pytest.approx(np.array([[1.0, np.nan], [2.0, 3.0]]), nan_ok=True)


def test_of_many_moments_the_worst_stay_in_the_order_of_time():
    worst = Worst(2)
    badness = np.random.default_rng(1).uniform(0.0, 1.0, 20 * ROOM)
    peaks = [7, 5 * ROOM + 3, 19 * ROOM]
    badness[peaks] = 10.0
    for time_s, bad in enumerate(badness.tolist()):
        worst.add((float(time_s), bad))
    assert worst.seen == 20 * ROOM
    assert len(worst.rows) <= 2 * ROOM
    assert (np.diff(worst.rows[:, 0]) > 0).all()
    assert set(peaks) <= set(worst.rows[:, 0])
