"""The search for the minimum steps, where they are known."""

import math

import numpy as np
import pytest

from experiments.target_hits.search import NotRepeatableError, luby, shortest_way
from experiments.target_hits.world import World
from services.robot_bridge.tasks import load_task
from tests.experiments.target_hits.fake_tasks import Countdown, FakeSettings, Forgetful, Line, Nowhere


def search(task, restart=None, seed=0, **options):
    world = World(task)
    return shortest_way(world, restart or world.begin_episode, np.random.default_rng(seed), **options)


class FarLine(Line):
    """Starts at one place, 60 above the goal, where it takes 60 steps down to get: all at -1, the lower bound."""

    START, HIGHEST = 60.0, 3.0

    def _start(self):
        self.position = self.START


def test_the_lengths_of_tries_are_luby_s():
    assert [luby(index) for index in range(1, 16)] == [1, 1, 2, 1, 1, 2, 4, 1, 1, 2, 1, 1, 2, 4, 8]


@pytest.mark.parametrize("start", [1.0, 4.4, 17.0, 60.0])
def test_the_shortest_way_is_found_where_it_is_one_command_held(monkeypatch, start):
    monkeypatch.setattr(FarLine, "START", start)
    # Within .5 of the goal is there.
    assert search(FarLine(FakeSettings())).steps == math.ceil(start - 0.5 + 1e-9)


def test_upwards_it_is_three_times_as_fast(monkeypatch):
    monkeypatch.setattr(FarLine, "START", -30.0)
    assert search(FarLine(FakeSettings())).steps == 10


def test_the_same_seed_searches_the_same_plans():
    assert search(FarLine(FakeSettings()), seed=5) == search(FarLine(FakeSettings()), seed=5)


def test_a_goal_that_is_never_reached_is_not_found_and_costs_no_more_than_allowed():
    way = search(Nowhere(FakeSettings(), rng=np.random.default_rng(0)), most_effort=5000)
    assert (way.steps, way.effort) == (None, 5000)


def test_a_goal_one_step_away_ends_the_search(monkeypatch):
    monkeypatch.setattr(Countdown, "CYCLES", (1,))
    way = search(Countdown(FakeSettings()))
    assert (way.steps, way.effort) == (1, 1)


def test_a_task_that_does_not_repeat_itself_is_named():
    with pytest.raises(NotRepeatableError, match="task fake does not repeat itself"):
        search(Forgetful(FakeSettings()))


def test_a_double_integrator_with_a_speed_condition_is_solved_all_but_as_fast_as_it_can_be():
    """Dot-Reacher from rest at (.65, 0): .4 to go in x, arriving at most .15 fast.

    Thrust a_k in step k of N takes the dot .04 sum a_k (N - k + .5) far and leaves it .2 sum a_k fast, so sum a_k <=
    .75. The farthest is thrust first, brake last: N = 5 with 1, 1, .75, -1, -1 gets .315 far, N = 6 with 1, 1, 1, -.25,
    -1, -1 gets .435 far. So 6 steps are the fewest.
    """
    task = load_task("dot_reacher", "thesis", rng=np.random.default_rng(0))
    world = World(task)

    def restart():
        task._dot.place(np.array([0.65, 0.0]))

    assert shortest_way(world, restart, np.random.default_rng(2), 20_000).steps in (6, 7)
