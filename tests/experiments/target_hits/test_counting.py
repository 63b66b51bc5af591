"""Hits and the steps that resets take, against counts made by hand."""

import itertools

import numpy as np
import pytest

from experiments.target_hits.counting import acted_share, count_hits
from experiments.target_hits.world import World
from tests.experiments.target_hits.fake_tasks import Countdown, FakeSettings

ACTION = itertools.repeat(np.zeros(1, np.float32))


def count(limit, steps, reset_steps=4):
    task = Countdown(FakeSettings(reset_steps=reset_steps))
    return count_hits(World(task), ACTION, limit, steps), task.log


@pytest.mark.parametrize(
    ("steps", "hits"),
    [
        (2, 0),
        (3, 1),  # 3 cycles
        (13, 1),  # 5 of the 7 that it takes, and 4 of reset: 3 + 9 = 12
        (14, 2),  # 2 more
        (16, 2),
        (17, 3),  # and again 3
        (27, 3),  # 17 + 9 = 26
        (28, 4),
    ],
)
def test_resets_count_among_the_steps(steps, hits):
    assert count(5, steps)[0] == hits


def test_the_goal_stays_after_a_time_out_and_is_drawn_anew_after_a_hit():
    assert count(5, 17)[1] == ["episode", "episode", "attempt", "episode", "episode"]


def test_a_limit_as_long_as_the_way_is_long_enough():
    # 3, then 7, then 2, without any reset
    assert count(7, 12)[0] == 3


def test_under_limit_1_every_attempt_is_one_step():
    # Nothing is that near. A step and 4 of reset each: attempts begin at 0, 5, 10 and 15.
    hits, log = count(1, 20)
    assert (hits, log.count("attempt")) == (0, 4)


def test_a_goal_one_step_away_is_hit_at_once(monkeypatch):
    monkeypatch.setattr(Countdown, "CYCLES", (1, 2))
    # Hits at 1, 7 and 13: in between one step that does not suffice, and 4 of reset.
    assert [count(1, steps)[0] for steps in (1, 6, 7, 12, 13, 18)] == [1, 1, 2, 2, 3, 3]


def test_a_reset_may_cost_nothing():
    # 3, 5 in vain, 2, 3, 5 in vain, 2
    assert [count(5, steps, reset_steps=0)[0] for steps in (10, 13, 19, 20)] == [2, 3, 3, 4]


def test_a_limit_beyond_the_steps_never_resets():
    hits, log = count(1000, 24)
    assert (hits, "attempt" in log) == (6, False)


def test_the_share_of_steps_that_are_acted():
    assert acted_share(1, 20) == 1 / 21
    assert acted_share(50, 0) == 1.0
