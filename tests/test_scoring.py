"""Errors that are known, and what is said of them."""

import math

import pytest

from risaf_link.core.rotation import wrap
from risaf_link.core.scoring import ErrorAccount, YawTrack


def score(*errors, step=1.0):
    account = ErrorAccount()
    for i, error in enumerate(errors):
        account.add(i * step, error)
    return account.score()


def test_without_an_error_there_is_no_score():
    assert score() is None


def test_one_error_has_a_size_and_no_drift():
    found = score(-0.3)
    assert (found.samples, found.final, found.largest, found.drift) == (1, 0.3, 0.3, 0.0)
    assert found.rmse == pytest.approx(0.3)


def test_the_score_is_the_root_mean_square_the_last_the_largest_and_the_growth():
    found = score(0.1, -0.4, 0.2, step=2.0)
    assert found.rmse == pytest.approx(math.sqrt((0.01 + 0.16 + 0.04) / 3))
    assert (found.samples, found.largest) == (3, 0.4)
    assert found.final == pytest.approx(0.2)
    assert found.drift == pytest.approx(0.1 / 4.0)


def test_a_drift_is_followed_through_half_a_turn_while_sizes_stay_below_it():
    found = score(*(wrap(0.5 * i) for i in range(21)))
    assert found.drift == pytest.approx(0.5)
    assert found.final == pytest.approx(abs(wrap(10.0)))
    assert found.largest <= math.pi


def test_errors_at_one_instant_have_no_drift():
    assert score(0.1, 0.2, step=0.0).drift == 0.0


@pytest.fixture
def track():
    track = YawTrack(length=3)
    for time_us, yaw in [(100, 3.0), (200, -3.0), (300, -2.8)]:
        track.add(time_us, yaw)
    return track


def test_yaw_is_read_between_points_the_short_way_round(track):
    assert track.at(200) == -3.0
    assert track.at(275) == pytest.approx(-2.85)
    assert wrap(track.at(150)) == pytest.approx(math.pi)


@pytest.mark.parametrize("time_us", [99, 301])
def test_the_track_says_nothing_of_times_that_it_does_not_reach(track, time_us):
    assert track.at(time_us) is None
    assert YawTrack().at(time_us) is None


def test_the_track_forgets_its_oldest_points(track):
    track.add(400, 0.0)
    assert (track.at(150), track.at(400)) == (None, 0.0)


def test_of_two_points_at_one_time_the_later_one_counts(track):
    track.add(300, 1.0)
    assert track.at(300) == 1.0
    assert track.at(250) == pytest.approx(-2.9)


def test_where_time_goes_back_the_track_starts_anew(track):
    track.add(50, 0.5)
    assert (track.at(50), track.at(200)) == (0.5, None)
