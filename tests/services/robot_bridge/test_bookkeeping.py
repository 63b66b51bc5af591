"""Minimum-time bookkeeping (thesis 6.1), with the thesis's own numbers."""

from services.robot_bridge.bookkeeping import EpisodeResult, Ledger, Totals
from tests.services.robot_bridge.scripted import EventClock, ScriptedTask


def ledger_of(time_limit, reset_steps, has_goal=True, totals=None):
    task = ScriptedTask(EventClock(), time_limit=time_limit, reset_steps=reset_steps, has_goal=has_goal)
    return Ledger(task.spec, totals)


def act(ledger, cycles, goal=False, reward=-1.0):
    """Begin an attempt of ``cycles`` cycles that ends at the goal or not; return how its last cycle was counted."""
    ledger.begin_attempt()
    for _ in range(cycles - 1):
        assert ledger.end_cycle(reward, terminated=False) == (False, None)
    return ledger.end_cycle(reward, terminated=goal)


def reset(ledger, cycles):
    for _ in range(cycles):
        ledger.end_reset_cycle()


def test_three_time_outs_and_a_goal_after_25_steps_return_minus_385():
    ledger = ledger_of(time_limit=100, reset_steps=20)
    for _ in range(3):
        assert act(ledger, 100) == (True, None)
        reset(ledger, 20)
    truncated, episode = act(ledger, 25, goal=True)
    assert not truncated
    assert episode == EpisodeResult(
        episode=0, undiscounted_return=-385.0, length=385, attempts=4, steps=385, acted_steps=325
    )
    assert ledger.totals == Totals(steps=385, acted_steps=325, episodes=1, attempts=4)


def test_the_next_episode_starts_from_nothing():
    ledger = ledger_of(time_limit=100, reset_steps=20)
    act(ledger, 100)
    reset(ledger, 20)
    act(ledger, 25, goal=True)
    assert ledger.episode == 0  # what is counted now still belongs to it: its last TimeStep
    _, episode = act(ledger, 7, goal=True)
    assert ledger.episode == 1
    assert episode == EpisodeResult(1, -7.0, length=7, attempts=1, steps=152, acted_steps=132)


def test_the_goal_in_the_last_cycle_of_the_limit_is_a_goal_and_no_time_out():
    truncated, episode = act(ledger_of(time_limit=5, reset_steps=2), 5, goal=True)
    assert not truncated
    assert episode.length == 5


def test_a_reset_costs_nothing_in_the_attempt_that_follows():
    ledger = ledger_of(time_limit=3, reset_steps=10)
    act(ledger, 3)
    reset(ledger, 10)
    ledger.begin_attempt()
    assert ledger.step_index == 0
    assert ledger.attempt == 1


def test_rewards_are_summed_as_they_are():
    ledger = ledger_of(time_limit=4, reset_steps=3)
    act(ledger, 4, reward=0.5)
    reset(ledger, 3)
    _, episode = act(ledger, 2, goal=True, reward=0.25)
    assert episode.undiscounted_return == 4 * 0.5 - 3 + 2 * 0.25


def test_without_a_goal_each_attempt_is_an_episode_and_its_reset_is_not_part_of_it():
    ledger = ledger_of(time_limit=10, reset_steps=4, has_goal=False)
    truncated, first = act(ledger, 10, reward=0.5)
    reset(ledger, 4)
    _, second = act(ledger, 10, reward=1.0)
    assert truncated
    assert (first.undiscounted_return, first.length, first.attempts) == (5.0, 10, 1)
    assert (second.undiscounted_return, second.length, second.attempts) == (10.0, 10, 1)
    assert second.steps == 24  # the run's steps hold the reset
    assert second.acted_steps == 20


def test_an_attempt_without_a_cycle_is_no_attempt_of_the_episode():
    ledger = ledger_of(time_limit=10, reset_steps=0)
    for _ in range(3):
        ledger.begin_attempt()  # asked for a first answer, none came
    _, episode = act(ledger, 4, goal=True)
    assert episode.attempts == 1
    assert ledger.totals.attempts == 4  # numbers of attempts are never used twice


def test_a_restarted_bridge_goes_on_from_the_totals_of_the_one_before():
    ledger = ledger_of(time_limit=10, reset_steps=0, totals=Totals(steps=500, acted_steps=400, episodes=7, attempts=9))
    ledger.begin_attempt()
    assert (ledger.episode, ledger.attempt) == (7, 9)
    _, episode = ledger.end_cycle(-1.0, terminated=True)
    assert episode == EpisodeResult(7, -1.0, length=1, attempts=1, steps=501, acted_steps=401)


def test_an_attempt_that_is_cut_short_is_truncated_unless_the_goal_was_reached():
    ledger = ledger_of(time_limit=10, reset_steps=2)
    ledger.begin_attempt()
    assert ledger.end_cycle(-1.0, terminated=False, cut_short=True) == (True, None)
    reset(ledger, 2)
    ledger.begin_attempt()
    truncated, episode = ledger.end_cycle(-1.0, terminated=True, cut_short=True)
    assert not truncated
    assert (episode.undiscounted_return, episode.length, episode.attempts) == (-4.0, 4, 2)
