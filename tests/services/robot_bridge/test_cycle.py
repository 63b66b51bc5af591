"""The action cycle in real time: what a TimeStep says about the cycle that led to it. Cycles last 40 ms."""

import numpy as np
import pytest

from common import topics
from common.codec import decode
from common.errors import ConfigError
from common.messages import ActionSource, TaskSpec
from services.robot_bridge.engagement import NO_ANSWER
from tests.services.builders import START_NS
from tests.services.robot_bridge.scripted import ACTOR, BRIDGE, PROBE, Scene, action_of

POLICY, HELD, ZERO, NONE = ActionSource.POLICY, ActionSource.HELD, ActionSource.ZERO, ActionSource.NONE


def ns(seconds):
    return START_NS + round(seconds * 1e9)


def answers_by_seq(**delays):
    """Answer only some TimeSteps: ``s3=0.01`` answers number 3 after 10 ms."""
    return lambda time_step: delays.get(f"s{time_step.seq}")


def in_force(time_step):
    """What determined the command at the cycle's end, what it answers, and when it was applied."""
    applied_s = round((time_step.action_applied_ns - START_NS) / 1e9, 6)
    return time_step.action_source, time_step.answered_seq, applied_s


def test_a_cycle_ends_with_the_action_that_answered_its_beginning(tmp_path):
    scene = Scene(tmp_path, answers=0.01, steps=2)
    probe, first, second, third = scene.run()
    assert probe.seq == PROBE
    assert scene.published_s == [0.0, 0.0, 0.04, 0.08]

    assert first.is_first
    assert (first.action_source, first.answered_seq, first.action_applied_ns) == (NONE, -1, 0)
    np.testing.assert_array_equal(first.action, [0, 0])
    assert (first.reward, first.steps, first.acted_steps) == (0.0, 0, 0)

    assert (second.step_index, second.attempt, second.episode) == (1, first.attempt, first.episode)
    assert in_force(second) == (POLICY, 1, 0.01)
    np.testing.assert_array_equal(second.action, action_of(1))
    assert (second.reward, second.steps, second.acted_steps) == (-1.0, 1, 1)
    # The command took effect when it arrived: 30 of the 40 ms.
    np.testing.assert_allclose(second.proprioception, action_of(1) * 0.03, atol=1e-7)

    assert in_force(third) == (POLICY, 2, 0.05)
    np.testing.assert_allclose(third.proprioception, action_of(1) * 0.04 + action_of(2) * 0.03, atol=1e-7)
    assert [t.seq for t in scene.time_steps] == [0, 1, 2, 3]
    assert {t.incarnation for t in scene.time_steps} == {BRIDGE}


def test_who_waits_in_vain_for_a_first_answer_is_told_so_until_it_comes(tmp_path, caplog):
    scene, seen = Scene(tmp_path, answers=None, steps=2, stop_after=0.5), []
    scene.probe_answer = None
    for at_s in (4.7, 5.7, 25.0):
        scene.clock.at(at_s, lambda: seen.append(scene.bridge.details()["waits_for"]))

    def answer_from_now_on():
        scene.answers = lambda time_step: 0.01
        scene.answer(scene.time_steps[-1].seq)

    scene.clock.at(25.1, answer_from_now_on)
    scene.run()
    assert seen == [None, NO_ANSWER, NO_ANSWER]
    told = [record.message for record in caplog.records if NO_ANSWER in record.message]
    assert 1 <= len(told) <= 3  # every ten seconds
    assert scene.counts.cycles == 2
    assert scene.bridge.details()["waits_for"] is None


@pytest.mark.parametrize(("pacing", "started"), [("realtime", 1), ("lockstep", 0)])
def test_in_real_time_the_world_is_started_before_all_else(tmp_path, pacing, started):
    scene = Scene(tmp_path, answers=0.01, steps=2, task={"pacing": pacing})
    clocks = []

    def start(clock):
        assert scene.task.advanced_to_ns == []
        clocks.append(clock)

    scene.task.start = start
    scene.run()
    assert clocks == [scene.clock] * started


def test_what_the_task_counts_is_told_with_the_bridges_counts(tmp_path):
    scene = Scene(tmp_path, answers=0.01, steps=2)
    scene.task.counters = lambda: {"sensor_packets": 10}
    scene.run()
    told = scene.bridge.counters()
    assert (told["sensor_packets"], told["steps"]) == (10, 2)


def test_an_answer_is_applied_the_moment_it_arrives(tmp_path):
    scene = Scene(tmp_path, answers=0.013, steps=2)
    scene.run()
    commands = [entry for entry in scene.task.log if entry[0] == "command"]
    assert [entry[1] for entry in commands] == [0.013, 0.053]  # the probe's answer is not applied


def test_the_deadlines_are_absolute(tmp_path):
    scene = Scene(tmp_path, answers=lambda t: 0.003 * (t.seq % 7), steps=50)
    scene.run()
    assert scene.published_s[1:] == [pytest.approx(0.04 * i, abs=1e-9) for i in range(51)]


def test_without_an_answer_the_last_command_is_held_and_says_what_it_answered(tmp_path):
    scene = Scene(tmp_path, answers_by_seq(s1=0.01), steps=3)
    _, _, second, third, fourth = scene.run()
    assert in_force(second) == (POLICY, 1, 0.01)
    assert in_force(third) == in_force(fourth) == (HELD, 1, 0.01)
    np.testing.assert_array_equal(fourth.action, action_of(1))
    np.testing.assert_allclose(fourth.proprioception, action_of(1) * 0.11, atol=1e-7)
    assert scene.counts.unanswered == 2


def test_before_the_first_answer_the_command_is_zero(tmp_path):
    scene = Scene(tmp_path, answers_by_seq(s2=0.01), steps=2)
    _, _, second, third = scene.run()
    assert (second.action_source, second.answered_seq) == (ZERO, -1)
    np.testing.assert_array_equal(second.action, [0, 0])
    assert in_force(third) == (POLICY, 2, 0.05)


def test_zero_takes_the_command_back_at_the_end_of_a_cycle_without_an_answer(tmp_path):
    scene = Scene(tmp_path, answers_by_seq(s1=0.01, s5=0.01), steps=5, on_missing_action="zero")
    _, _, second, third, fourth, fifth, sixth = scene.run()
    assert in_force(second) == (POLICY, 1, 0.01)
    assert in_force(third) == (HELD, 1, 0.01)  # in force until its end
    assert in_force(fourth) == in_force(fifth) == (ZERO, -1, 0.08)
    np.testing.assert_array_equal(fourth.action, [0, 0])
    np.testing.assert_allclose(fourth.proprioception, action_of(1) * 0.07, atol=1e-7)
    assert in_force(sixth) == (POLICY, 5, 0.17)


def test_after_a_zero_command_nothing_is_applied_that_is_older_than_the_last_answer(tmp_path):
    scene = Scene(tmp_path, answers_by_seq(s1=0.13, s2=[0.01, 0.1]), steps=4, on_missing_action="zero")
    scene.run()
    assert in_force(scene.time_steps[4]) == (HELD, 2, 0.05)
    assert in_force(scene.time_steps[5]) == (ZERO, -1, 0.12)
    assert scene.counts.refused_actions == 2


def test_an_action_that_comes_after_its_cycle_is_late_and_still_applied_if_it_is_the_newest(tmp_path):
    scene = Scene(tmp_path, answers_by_seq(s1=0.05), steps=3)
    _, _, second, third, fourth = scene.run()
    assert second.action_source is ZERO
    assert in_force(third) == (POLICY, 1, 0.05)
    assert in_force(fourth) == (HELD, 1, 0.05)
    assert scene.counts.late_actions == 1
    assert scene.counts.refused_actions == 0


def test_a_late_action_does_not_replace_a_newer_one(tmp_path):
    scene = Scene(tmp_path, answers_by_seq(s1=0.06, s2=0.01), steps=2)
    third = scene.run()[3]
    assert in_force(third) == (POLICY, 2, 0.05)
    assert scene.counts.late_actions == 1
    assert scene.counts.refused_actions == 1


def test_an_action_at_the_very_deadline_is_in_time(tmp_path):
    scene = Scene(tmp_path, answers_by_seq(s1=0.04), steps=1)
    second = scene.run()[2]
    assert in_force(second) == (POLICY, 1, 0.04)
    assert scene.counts.late_actions == 0


def test_an_action_that_arrives_at_the_deadline_and_is_read_later_was_in_time(tmp_path):
    scene = Scene(tmp_path, answers=None, steps=2)
    scene.task.on_outcome = {1: lambda: scene.answer(1)}  # while the bridge judges the cycle
    _, _, second, third = scene.run()
    assert second.action_source is ZERO
    assert in_force(third) == (POLICY, 1, 0.04)
    assert scene.counts.late_actions == 0


def test_of_several_answers_to_one_time_step_the_first_counts(tmp_path):
    scene = Scene(tmp_path, answers_by_seq(s1=[0.01, 0.02]), steps=1)
    second = scene.run()[2]
    assert in_force(second) == (POLICY, 1, 0.01)
    assert scene.counts.refused_actions == 1


def test_an_answer_to_an_earlier_attempt_is_refused(tmp_path):
    scene = Scene(tmp_path, answers_by_seq(s1=0.01, s2=0.06), task={"time_limit": 2}, steps=4)
    time_steps = scene.run()
    assert [t.attempt for t in time_steps] == [0, 1, 1, 1, 2, 2, 2]
    # The answer to number 2 came 20 ms into the second attempt.
    assert [t.action_source for t in time_steps[4:]] == [NONE, ZERO, ZERO]
    assert scene.counts.refused_actions == 1
    assert scene.counts.late_actions == 1


def test_an_answer_to_another_bridge_is_refused(tmp_path):
    scene = Scene(tmp_path, answers=None, steps=1)
    scene.clock.at(0.01, lambda: scene.answer(1, incarnation=BRIDGE - 1))
    scene.clock.at(0.02, lambda: scene.answer(1, incarnation=BRIDGE + 1))
    second = scene.run()[2]
    assert second.action_source is ZERO
    assert scene.counts.refused_actions == 2
    assert scene.counts.late_actions == 0


def test_an_answer_to_a_time_step_that_does_not_exist_is_refused(tmp_path):
    scene = Scene(tmp_path, answers=None, steps=1)
    scene.clock.at(0.01, lambda: scene.answer(77))
    second = scene.run()[2]
    assert second.action_source is ZERO
    assert scene.counts.refused_actions == 1


def test_of_two_actors_the_newer_one_acts(tmp_path):
    scene = Scene(tmp_path, answers=None, steps=2)
    scene.clock.at(0.01, lambda: scene.answer(1, [0.5, 0.5], actor_incarnation=ACTOR + 1))
    scene.clock.at(0.05, lambda: scene.answer(2, [0.1, 0.1], actor_incarnation=ACTOR))
    scene.clock.at(0.06, lambda: scene.answer(2, [0.7, 0.7], actor_incarnation=ACTOR + 1))
    third = scene.run()[3]
    np.testing.assert_allclose(third.action, [0.7, 0.7])
    assert scene.counts.refused_actions == 1


def test_actions_are_clipped_to_the_task_and_recorded_clipped(tmp_path):
    scene = Scene(tmp_path, answers=None, steps=1)
    scene.clock.at(0.01, lambda: scene.answer(1, [7.0, -7.0]))
    second = scene.run()[2]
    np.testing.assert_array_equal(second.action, [1.0, -2.0])
    assert ("command", 0.01, 1.0, -2.0) in scene.task.log


def test_waiting_stretches_the_cycle_until_the_action_comes(tmp_path):
    scene = Scene(tmp_path, answers_by_seq(s1=0.01, s2=0.1, s3=0.01), steps=3, on_missing_action="wait")
    _, _, second, third, fourth = scene.run()
    assert scene.published_s[1:] == pytest.approx([0.0, 0.04, 0.14, 0.18])
    assert in_force(second) == (POLICY, 1, 0.01)
    assert in_force(third) == (POLICY, 2, 0.14)
    assert in_force(fourth) == (POLICY, 3, 0.15)
    # The robot went on moving meanwhile.
    np.testing.assert_allclose(third.proprioception, action_of(1) * 0.13, atol=1e-7)
    assert scene.counts.late_actions == 0
    assert scene.counts.unanswered == 0


def test_what_the_bridge_waits_for_is_no_overrun_of_its_own(tmp_path):
    scene = Scene(tmp_path, answers_by_seq(s1=0.01, s2=0.3, s3=0.01, s4=0.06), steps=4, on_missing_action="wait")
    scene.run()
    assert scene.published_s[1:] == pytest.approx([0.0, 0.04, 0.34, 0.38, 0.44])
    assert scene.counts.overruns == 0
    assert scene.counts.skipped_cycles == 0


def test_waiting_ends_with_the_watchdog(tmp_path):
    scene = Scene(tmp_path, answers_by_seq(s1=0.01), steps=3, on_missing_action="wait", stop_after=0.2)
    _, _, second, third, fourth = scene.run()
    assert in_force(second) == (POLICY, 1, 0.01)
    assert scene.published_s[1:] == pytest.approx([0.0, 0.04, 0.21, 0.25])
    assert in_force(third) == in_force(fourth) == (ActionSource.STOP, -1, 0.21)
    assert scene.counts.overruns == 0
    assert scene.service.counters()["stops"] == 1


@pytest.mark.parametrize(("late_s", "overruns"), [(0.003, 0), (0.004, 0), (0.005, 1), (0.03, 1)])
def test_an_overrun_is_a_deadline_missed_by_more_than_a_tenth_of_the_cycle(tmp_path, late_s, overruns):
    scene = Scene(tmp_path, answers=0.01, steps=5)
    scene.clock.at(0.055, lambda: scene.clock.oversleep_s.append(late_s))
    scene.run()
    assert scene.counts.overruns == overruns
    assert scene.counts.skipped_cycles == 0
    expected = [0.0, 0.04, 0.08 + late_s, 0.12, 0.16, 0.2]
    assert scene.published_s[1:] == pytest.approx(expected)


def test_cycles_that_passed_unnoticed_are_given_up(tmp_path):
    scene = Scene(tmp_path, answers=0.01, steps=4)
    scene.clock.at(0.055, lambda: scene.clock.oversleep_s.append(0.09))
    scene.run()
    assert scene.published_s[1:] == pytest.approx([0.0, 0.04, 0.17, 0.2, 0.24])
    assert (scene.counts.overruns, scene.counts.skipped_cycles) == (1, 2)


def test_time_spent_on_the_task_counts_where_it_makes_the_bridge_late(tmp_path):
    scene = Scene(tmp_path, answers=0.001, steps=4)
    scene.task.on_outcome = {1: lambda: scene.clock.advance(0.03), 2: lambda: scene.clock.advance(0.05)}
    scene.run()
    assert scene.published_s[1:] == pytest.approx([0.0, 0.07, 0.13, 0.13, 0.16])
    assert scene.counts.overruns == 1


def test_neither_late_nor_missing_actions_are_overruns(tmp_path):
    scene = Scene(tmp_path, answers=lambda t: [0.05, None, 0.039][t.seq % 3], steps=30)
    scene.run()
    assert scene.counts.late_actions > 0
    assert scene.counts.overruns == 0


def test_overruns_after_the_warm_up_are_counted_by_themselves(tmp_path):
    scene = Scene(tmp_path, answers=0.01, steps=1003)
    for cycle in (5, 1000, 1001):  # counted from 1; the warm-up is the first 1000
        scene.clock.at((cycle - 1) * 0.04 + 0.015, lambda: scene.clock.oversleep_s.append(0.01))
    scene.run()
    assert scene.counts.cycles == 1003
    assert scene.counts.overruns == 3
    assert scene.counts.overruns_after_1000 == 1


def test_an_action_older_than_the_memory_is_not_even_late(tmp_path):
    scene = Scene(tmp_path, answers=lambda t: None if t.seq == 1 else 0.01, steps=300)
    scene.clock.at(299 * 0.04 + 0.02, lambda: scene.answer(1))
    scene.run()
    assert scene.counts.late_actions == 0
    assert scene.counts.refused_actions == 1


def test_every_action_that_counts_is_recorded_with_its_times(tmp_path):
    scene = Scene(tmp_path, answers_by_seq(s1=0.01, s2=0.05), steps=3)
    scene.run()
    rows = scene.service.record.tables["actions"]
    assert [(r["answered_seq"], r["published_ns"], r["arrived_ns"], r["late"]) for r in rows] == [
        (0, ns(0), ns(0), 0),
        (1, ns(0), ns(0.01), 0),
        (2, ns(0.04), ns(0.09), 1),
    ]


def test_camera_frames_travel_as_the_camera_numbered_them(tmp_path):
    scene = Scene(tmp_path, task={"camera": True}, steps=2)
    time_steps = scene.run()
    # What only asks for an answer brings the newest frame alone.
    assert [t.frame_ids.tolist() for t in time_steps] == [[1], [2, 3], [4, 5], [6, 7]]
    assert [t.frames[:, 0, 0, 0].tolist() for t in time_steps] == [[1], [2, 3], [4, 5], [6, 7]]
    assert time_steps[3].frame_capture_ns.tolist() == [ns(0.08)] * 2


@pytest.mark.parametrize("encoding", ["zstd", "jpeg444"])
def test_camera_frames_travel_encoded_as_announced(tmp_path, encoding):
    scene = Scene(tmp_path, task={"camera": True}, steps=2, encoding=encoding)
    time_steps = scene.run()
    assert scene.announced.frame_encoding == encoding
    assert {t.frames.encoding for t in time_steps} == {encoding}
    # Grey, all over: JPEG keeps that too, within what its quantisation leaves of the level.
    levels = np.array([t.pixels[-1, 0, 0, 0] for t in time_steps], int)
    assert np.abs(levels - [1, 3, 5, 7]).max() <= (0 if encoding == "zstd" else 1)


def test_without_a_camera_there_is_nothing_to_encode(tmp_path):
    scene = Scene(tmp_path, steps=2, encoding="jpeg444")
    scene.run()
    assert scene.announced.frame_encoding == "raw"


def test_an_encoding_that_the_tasks_frames_do_not_fit_is_refused_at_the_start(tmp_path):
    Scene(tmp_path, task={"camera": True, "channels": 1}, encoding="zstd")
    with pytest.raises(ConfigError, match=r"robot_bridge.encoding = jpeg444: expected .* 3 channels, scripted has 1"):
        Scene(tmp_path, task={"camera": True, "channels": 1}, encoding="jpeg444")


def test_the_bridge_answers_what_the_task_looks_like(tmp_path):
    scene = Scene(tmp_path)
    payload = scene.actor.transport.query(topics.SPEC)
    assert decode(payload, TaskSpec).time_limit_steps == scene.task.spec.time_limit_steps
