"""When a world that cannot keep up with the clock is told of."""

from services.robot_bridge.robots.lag_watch import LagWatch

SECOND_NS = 1_000_000_000


def told(lags_s):
    """Seconds at which somebody is told, of looks a second apart."""
    watch = LagWatch()
    return [at_s for at_s, lag_s in enumerate(lags_s) if watch.look(round(lag_s * SECOND_NS), at_s * SECOND_NS)]


def test_a_lag_that_lasts_is_told_of_once_in_ten_seconds():
    assert told([0, 0.5, 0.6, 2] + 20 * [2]) == [2, 12, 22]


def test_a_computer_that_was_suspended_catches_up_unnoticed():
    assert told([0, 5, 0.1, 0, 5, 0.2]) == []


def test_a_lag_that_comes_back_is_told_of_again():
    assert told([1, 1, 1, 0, 1, 1, 1]) == [1, 5]
