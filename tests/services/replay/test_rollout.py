"""A rollout is what one acting policy has done, in order, each transition once; the rest is dropped and counted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from common.algorithms.config import AlgorithmConfig
from common.algorithms.ppo_config import PPOConfig
from common.errors import ConfigError
from common.frame_ring import RingWriter
from common.messages import ActionSource
from services.replay.rollout import RolloutStore
from services.replay.store_table import open_store
from tests.common.ring_cases import Bridge, task_spec

LENGTH = 4


class Scene:
    """A rollout store on a ring that the test fills."""

    def __init__(self, directory, length=LENGTH) -> None:
        self.ring = RingWriter.create_or_reopen(directory / "ring", task_spec(camera=False), 100)
        self.learner_version = 0
        self.store = RolloutStore(self.ring, length, lambda: self.learner_version)
        self.bridge = Bridge(camera=False)

    def start(self):
        """The first TimeStep of an attempt; return its row."""
        return self._append(self.bridge.start())

    def steps(self, count, version=0, **changes):
        """Transitions whose actions a policy chose; return their rows."""
        return [self._step(version, **changes) for _ in range(count)]

    def take(self, again=False):
        rows = self.store.next_rows(again=again)
        if rows is None:
            return None
        self.store.note_sent(again=again)
        return rows.tolist()

    def counter(self, name):
        return self.store.counters()[name]

    def _step(self, version, terminated=False, truncated=False, source=None, extras=True):
        experience = self.bridge.step(terminated=terminated, truncated=truncated)
        if source:
            experience = replace(experience, time_step=replace(experience.time_step, action_source=source))
        known = replace(experience.extras, policy_version=version) if extras else None
        return self._append(replace(experience, extras=known))

    def _append(self, experience):
        row = self.ring.append(experience)
        self.store.note_row(row)
        return row


@pytest.fixture
def scene(tmp_path):
    scene = Scene(tmp_path)
    yield scene
    scene.ring.close()


def test_a_rollout_is_handed_out_when_it_is_complete_and_once(scene):
    scene.start()
    rows = scene.steps(3)
    assert scene.take() is None
    rows += scene.steps(1)
    assert scene.take() == rows == [1, 2, 3, 4]
    assert scene.take() is None
    assert (scene.counter("rollouts"), scene.counter("dropped_transitions")) == (1, 0)


def test_first_time_steps_of_attempts_are_no_transitions(scene):
    rows = []
    for _ in range(2):
        scene.start()
        rows += scene.steps(1) + scene.steps(1, truncated=True)
    assert scene.take() == rows == [1, 2, 4, 5]


def test_what_the_actor_does_during_the_update_is_dropped_and_counted(scene):
    scene.start()
    scene.steps(LENGTH)
    assert scene.take() is not None
    scene.steps(3)
    assert scene.counter("dropped_transitions") == 3
    rows = scene.steps(2, version=1)
    assert scene.take() is None  # the old one is gone, too
    rows += scene.steps(2, version=1)
    assert scene.take() == rows
    assert (scene.counter("rollouts"), scene.counter("dropped_transitions")) == (2, 3)


def test_a_rollout_that_the_ring_no_longer_holds_is_replaced_by_one_of_the_same_policy(scene):
    # Nobody took it, because the learner was not there; without another one there would never be a newer policy.
    scene.start()
    scene.steps(LENGTH)
    rows = scene.steps(120)  # the ring has room for 100
    taken = scene.take()
    assert len(taken) == LENGTH
    assert set(taken) <= set(rows)
    assert scene.ring.valid_pairs(np.array(taken)).all()
    assert scene.counter("dropped_transitions") == LENGTH + 120 - LENGTH


def test_a_newer_policy_ends_an_unfinished_rollout(scene):
    scene.start()
    scene.steps(3)
    rows = scene.steps(LENGTH, version=1)
    assert scene.take() == rows
    assert scene.counter("dropped_transitions") == 3


def test_an_older_policy_is_not_heard_once_a_newer_one_has_acted(scene):
    # A restarted actor begins with version 0 again, until the learner's comes.
    scene.start()
    rows = scene.steps(2, version=5)
    scene.steps(3, version=0)
    rows += scene.steps(2, version=5)
    assert scene.take() == rows == [1, 2, 6, 7]
    assert scene.counter("dropped_transitions") == 3


def test_where_the_policy_chose_nothing_or_the_robot_was_stopped_there_is_no_transition(scene):
    scene.start()
    rows = scene.steps(1)
    scene.steps(1, extras=False)
    scene.steps(1, source=ActionSource.STOP)
    rows += scene.steps(3)
    assert scene.take() == rows == [1, 4, 5, 6]
    assert scene.counter("dropped_transitions") == 0


def test_a_held_action_is_no_reason_to_leave_out_what_was_chosen(scene):
    scene.start()
    rows = scene.steps(LENGTH, source=ActionSource.HELD)
    assert scene.take() == rows


def test_a_lost_rollout_is_handed_out_again_as_long_as_it_is_the_newest(scene):
    scene.start()
    rows = scene.steps(LENGTH)
    assert scene.take() == rows
    assert scene.take(again=True) == rows
    assert scene.take() is None
    newer = scene.steps(LENGTH, version=1)
    assert scene.take(again=True) == newer
    assert scene.take() is None  # not twice, if nothing was lost


def test_a_new_learner_gets_what_its_predecessor_has_not_answered(scene):
    scene.start()
    rows = scene.steps(LENGTH)
    assert scene.take() == rows
    scene.store.note_new_learner()
    assert scene.take() == rows


def test_the_learner_owes_a_policy_from_the_end_of_a_rollout_to_its_new_version(scene):
    scene.start()
    scene.steps(LENGTH - 1)
    assert scene.store.owed == 0.0
    scene.steps(1)
    assert scene.store.owed == LENGTH
    scene.take()
    assert scene.store.owed == LENGTH  # having got it is not having learnt from it
    scene.learner_version = 1
    assert scene.store.owed == 0.0


def test_what_a_reopened_ring_holds_is_not_learnt_from_again(tmp_path):
    first = Scene(tmp_path)
    first.start()
    first.steps(3)
    first.ring.close()
    second = Scene(tmp_path)
    second.bridge = first.bridge
    rows = second.steps(LENGTH)
    assert second.take() == rows == [4, 5, 6, 7]
    second.ring.close()


def test_the_settings_decide_which_store_it_is(scene):
    config = PPOConfig(rollout_length=8, replay_capacity=100)
    store = open_store(config, scene.ring, max_surplus=1.0, rng=None, learner_version=lambda: 0)
    assert isinstance(store, RolloutStore)
    with pytest.raises(ConfigError, match="expected an OffPolicyConfig or an OnPolicyConfig"):
        open_store(AlgorithmConfig(), scene.ring, max_surplus=1.0, rng=None, learner_version=lambda: 0)
