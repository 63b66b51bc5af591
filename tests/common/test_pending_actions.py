"""The one rule about what was chosen before an observation, worked out by hand."""

from dataclasses import dataclass

import numpy as np
import pytest

from common.algorithms.presets import resolve_config
from common.errors import ConfigError
from common.pending_actions import PendingActions, observed_spec
from common.policies.weights import parameter_shapes
from tests.helpers import make_spec

BRIDGE, ACTOR = 1, 50


@dataclass(frozen=True)
class Step:
    """The identity of a TimeStep."""

    seq: int
    step_index: int
    incarnation: int = BRIDGE
    attempt: int = 0


def choice(seq):
    """What is chosen on the TimeStep ``seq``."""
    return np.array([seq, -seq], np.float32)


def after(chosen, count=3):
    """Pending actions of an actor that has chosen on the TimeSteps ``chosen``."""
    pending = PendingActions(count, action_size=2)
    for seq in chosen:
        pending.note(BRIDGE, ACTOR, seq, choice(seq))
    return pending


def seen(pending, step):
    """The first numbers of the pending actions of ``step``, newest first: the TimeSteps that they answer."""
    observed = pending.observe(step, np.array([0.5, 0.25, 0.125], np.float32))
    assert observed.dtype == np.float32
    assert observed[:3].tolist() == [0.5, 0.25, 0.125]
    actions = observed[3:].reshape(-1, 2)
    assert (actions[:, 1] == -actions[:, 0]).all()
    return actions[:, 0].tolist()


def test_an_observation_ends_with_what_was_chosen_on_those_before_it_the_newest_first():
    assert seen(after([3, 4, 5, 6, 7]), Step(8, step_index=8)) == [7, 6, 5]


@pytest.mark.parametrize(("step_index", "expected"), [(0, [0, 0, 0]), (1, [7, 0, 0]), (2, [7, 6, 0]), (3, [7, 6, 5])])
def test_what_was_chosen_in_the_attempt_before_is_not_on_its_way_any_more(step_index, expected):
    assert seen(after([3, 4, 5, 6, 7]), Step(8, step_index)) == expected


def test_what_was_not_answered_is_zeros_in_its_place():
    assert seen(after([3, 5, 7]), Step(8, step_index=8)) == [7, 0, 5]
    pending = after([5, 7])
    pending.note(BRIDGE, ACTOR, 6, None)
    assert seen(pending, Step(8, step_index=8)) == [7, 0, 5]


def test_an_answer_that_is_learnt_of_late_takes_its_place():
    assert seen(after([5, 7, 6]), Step(8, step_index=8)) == [7, 6, 5]


def test_an_observation_that_is_asked_for_late_is_the_one_it_was():
    assert seen(after([3, 4, 5, 6, 7]), Step(6, step_index=6)) == [5, 4, 3]


@pytest.mark.parametrize("origin", [(BRIDGE + 1, ACTOR), (BRIDGE, ACTOR + 1)])
def test_another_bridge_or_another_actor_begins_with_nothing(origin):
    pending = after([5, 6, 7])
    pending.note(*origin, 8, choice(8))
    assert seen(pending, Step(9, step_index=9, incarnation=origin[0])) == [8, 0, 0]


def test_a_bridge_that_was_not_heard_of_yet_has_no_pending_actions():
    assert seen(after([]), Step(8, step_index=8)) == [0, 0, 0]
    assert seen(after([5, 6, 7]), Step(8, step_index=8, incarnation=BRIDGE + 1)) == [0, 0, 0]


@pytest.mark.parametrize(
    ("told", "step_index", "certain"),
    [([5, 6, 7], 8, True), ([6, 7], 8, False), ([5, 7], 8, False), ([6, 7], 2, True), ([], 0, True)],
)
def test_an_observation_is_certain_if_all_that_it_asks_for_was_told(told, step_index, certain):
    pending = after([0, *told])  # of number 0 nothing is asked
    assert pending.is_certain(Step(8, step_index)) == certain


def test_that_nothing_was_chosen_is_certain_too():
    pending = after([5, 7])
    pending.note(BRIDGE, ACTOR, 6, None)
    assert pending.is_certain(Step(8, step_index=8))


def test_however_long_the_run_few_are_remembered():
    pending = after(range(100_000))
    assert len(pending._chosen) < 20
    assert seen(pending, Step(100_000, step_index=100_000)) == [99_999, 99_998, 99_997]


def test_as_many_are_remembered_as_are_asked_for():
    assert seen(after(range(200), count=100), Step(200, step_index=200)) == list(range(199, 99, -1))


def test_without_pending_actions_the_task_is_seen_as_it_is():
    spec = make_spec()
    assert observed_spec(spec, 0) is spec


def test_each_pending_action_is_in_the_range_of_actions():
    spec = make_spec()
    observed = observed_spec(spec, 2)
    for end in ("low", "high"):
        action = getattr(spec, f"action_{end}").tolist()
        expected = [*getattr(spec, f"proprioception_{end}").tolist(), *action, *action]
        assert getattr(observed, f"proprioception_{end}").tolist() == expected
        assert getattr(observed, f"proprioception_{end}").dtype == np.float32
    plain, wide = (parameter_shapes(s, 8, (1, 1, 1, 1))["actor.0.weight"] for s in (spec, observed))
    assert wide == [8, plain[1] + 2 * 2]


@pytest.mark.parametrize("algorithm", ["sac", "ppo"])
@pytest.mark.parametrize("value", [-1, 101, 1.5, "3", True])
def test_a_count_that_is_none_is_refused_with_the_reason(algorithm, value):
    with pytest.raises(ConfigError, match=r"pending_actions = .*: expected (an integer in 0..100|int)"):
        resolve_config(algorithm, "dot_reacher", {"pending_actions": value})
    assert resolve_config(algorithm, "dot_reacher", {}).pending_actions == 0
    assert resolve_config(algorithm, "dot_reacher", {"pending_actions": 100}).pending_actions == 100
