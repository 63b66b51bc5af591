"""The watchdog decides; times are in nanoseconds and small."""

import pytest

from services.robot_bridge.watchdog import Watchdog


@pytest.fixture
def watchdog():
    """A watchdog of 100 ns that was started at 1000."""
    watchdog = Watchdog(100)
    watchdog.restart(1000)
    return watchdog


def test_it_expires_once_when_the_time_is_up(watchdog):
    assert watchdog.deadline_ns == 1100
    assert not watchdog.expire(1099)
    assert not watchdog.stopped
    assert watchdog.expire(1100)
    assert watchdog.stopped
    assert not watchdog.expire(1101)
    assert not watchdog.expire(9999)
    assert watchdog.stops == 1


def test_a_fresh_action_moves_the_deadline(watchdog):
    assert watchdog.accept(observed_ns=1050, now_ns=1080)
    assert watchdog.deadline_ns == 1180
    assert not watchdog.expire(1179)
    assert watchdog.expire(1180)


def test_a_fresh_action_clears_the_stop_and_the_next_stop_counts_again(watchdog):
    assert watchdog.expire(1100)
    assert watchdog.accept(observed_ns=1490, now_ns=1500)
    assert not watchdog.stopped
    assert watchdog.expire(1600)
    assert watchdog.stops == 2


def test_an_answer_to_an_old_observation_is_not_fresh(watchdog):
    assert watchdog.expire(1100)
    assert not watchdog.accept(observed_ns=1000, now_ns=1101)
    assert watchdog.stopped
    assert watchdog.accept(observed_ns=1001, now_ns=1101)  # exactly as old as the limit


def test_an_answer_to_an_old_observation_does_not_keep_the_robot_moving(watchdog):
    assert watchdog.accept(1060, 1090)
    assert not watchdog.accept(1050, 1151)
    assert watchdog.expire(1190)


@pytest.mark.parametrize("reason", ["pause", "e_stop"])
def test_a_latch_refuses_fresh_actions_until_it_is_released(watchdog, reason):
    watchdog.latch(reason)
    assert watchdog.stopped
    assert not watchdog.accept(1050, 1051)
    watchdog.restart(1060)  # an attempt begins
    assert watchdog.stopped
    assert not watchdog.accept(1070, 1071)
    watchdog.release(5000)
    assert not watchdog.stopped
    assert watchdog.deadline_ns == 5100
    assert watchdog.accept(5010, 5020)


def test_an_emergency_stop_is_not_weakened_to_a_pause(watchdog):
    watchdog.latch("pause")
    assert watchdog.latched == "pause"
    watchdog.latch("e_stop")
    assert watchdog.latched == "e_stop"
    watchdog.latch("pause")
    assert watchdog.latched == "e_stop"


def test_a_latched_robot_does_not_stop_for_want_of_an_action(watchdog):
    watchdog.latch("pause")
    assert not watchdog.expire(1100)
    assert watchdog.stops == 0
    watchdog.release(2000)
    assert not watchdog.expire(2099)
    assert watchdog.expire(2100)
