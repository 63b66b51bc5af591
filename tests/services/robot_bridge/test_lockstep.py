"""Lockstep: the answer is the deadline, and the world moves by one cycle for each."""

import numpy as np
import pytest

from common import topics
from common.messages import ActionSource
from tests.services.builders import START_NS
from tests.services.robot_bridge.scripted import Scene, action_of


def lockstep(tmp_path, goal_cycles=(), answers=0.3, steps=5, **task):
    return Scene(tmp_path, answers, {"goal_cycles": goal_cycles, "pacing": "lockstep", **task}, steps=steps)


@pytest.mark.parametrize("answers", [0.0, 0.3])
def test_the_world_moves_exactly_one_cycle_per_step(tmp_path, answers):
    scene = lockstep(tmp_path, answers=answers, time_limit=3, reset_steps=2, steps=10)
    scene.run()
    times = np.array(sorted(set(scene.task.advanced_to_ns)))
    assert times.tolist() == (START_NS + np.arange(11) * 40_000_000).tolist()


def test_an_action_is_in_force_for_the_whole_cycle_it_answers(tmp_path):
    scene = lockstep(tmp_path, steps=3)
    _, _, second, third, fourth = scene.run()
    np.testing.assert_allclose(second.proprioception, action_of(1) * 0.04, atol=1e-7)
    np.testing.assert_allclose(fourth.proprioception, (action_of(1) + action_of(2) + action_of(3)) * 0.04, atol=1e-7)
    assert [(t.action_source, t.answered_seq) for t in (second, third, fourth)] == [
        (ActionSource.POLICY, 1),
        (ActionSource.POLICY, 2),
        (ActionSource.POLICY, 3),
    ]


def test_however_long_the_answer_takes_nothing_is_late_stopped_or_overrun(tmp_path):
    scene = lockstep(tmp_path, answers=60.0, steps=3)
    scene.run()
    counts = scene.counts
    assert (counts.overruns, counts.late_actions, counts.unanswered, counts.cycles) == (0, 0, 0, 3)
    assert scene.bridge.counters()["stops"] == 0


def test_resets_take_steps_and_no_real_time(tmp_path):
    scene = lockstep(tmp_path, answers=0.0, time_limit=3, reset_steps=4, steps=10)
    time_steps = scene.run()
    assert (time_steps[5].is_first, time_steps[5].steps) == (True, 7)
    assert scene.clock.seconds == 0.0


def test_a_time_step_that_was_lost_is_published_again(tmp_path):
    scene = lockstep(tmp_path, answers=0.0, steps=3)
    lost = []

    def drop_second(topic, payload):
        if topic is topics.TIME_STEP and len(scene.time_steps) == 2 and not lost:
            lost.append(payload)
            return True
        return False

    scene.network.drops = drop_second
    time_steps = scene.run()
    assert [t.seq for t in time_steps] == [0, 1, 2, 3, 4]
    assert scene.published_s[2] == 0.0  # the same payload, a second later
    assert scene.clock.seconds == 1.0
    assert scene.bridge.counters()["resent"] == 1
    assert scene.counts.produced == 5


def test_an_answer_that_was_lost_is_asked_for_until_it_comes(tmp_path):
    scene = lockstep(tmp_path, answers=0.0, steps=2)
    dropped = []

    def drop_three_actions(topic, payload):
        if topic is topics.ACTION and len(scene.time_steps) >= 2 and len(dropped) < 3:
            dropped.append(payload)
            return True
        return False

    scene.network.drops = drop_three_actions
    scene.run()
    assert [t.seq for t in scene.time_steps] == [0, 1, 1, 1, 1, 2, 3]
    assert scene.counts.cycles == 2


def test_a_second_answer_to_the_same_time_step_changes_nothing(tmp_path):
    scene = lockstep(tmp_path, answers=[0.0, 0.1], steps=4)
    time_steps = scene.run()
    assert [t.answered_seq for t in time_steps[2:]] == [1, 2, 3, 4]


def test_a_goal_and_a_time_out_end_attempts_as_in_real_time(tmp_path):
    scene = lockstep(tmp_path, {2}, answers=0.0, time_limit=3, steps=5)
    ends = [(t.terminated, t.truncated) for t in scene.run()]
    assert ends == [
        (False, False),
        (False, False),
        (False, False),
        (True, False),
        (False, False),
        (False, False),
        (False, False),
        (False, True),
    ]


def test_a_request_to_stop_is_heard_while_waiting_for_an_answer(tmp_path):
    scene = lockstep(tmp_path, answers=None, steps=3)
    scene.clock.at(2.5, lambda: scene.service.stop("test"))
    scene.run()
    assert scene.counts.cycles == 0
    assert scene.finished[0].reason == "stopped"
