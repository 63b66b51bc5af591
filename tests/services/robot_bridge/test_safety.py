"""What keeps the robot from harm: watchdog, emergency stop, pause, refused messages, sensors that fail."""

import math
import re

import numpy as np
import pytest

from common import topics
from common.errors import ServiceError
from common.messages import Action, ActionSource
from tests.services.builders import START_NS
from tests.services.robot_bridge.scripted import ACTOR, BRIDGE, Scene, action_of

POLICY, STOP = ActionSource.POLICY, ActionSource.STOP


def sources(scene):
    """Where the command at each cycle's end came from, the first attempt's cycles in order."""
    return [t.action_source for t in scene.time_steps if t.step_index > 0]


def only(*seqs, delay_s=0.01):
    return lambda time_step: delay_s if time_step.seq in seqs else None


def test_the_watchdog_stops_the_robot_at_its_time_and_not_at_the_cycles_end(tmp_path):
    scene = Scene(tmp_path, only(1), steps=4, stop_after=0.1)
    scene.run()
    assert scene.task.times("stop")[-1] == 0.11  # 0.1 s after the action of 10 ms
    assert [t.action_source.value for t in scene.time_steps[2:]] == ["policy", "held", "stop", "stop"]
    stopped = scene.time_steps[4]
    np.testing.assert_array_equal(stopped.action, [0, 0])
    assert (stopped.answered_seq, stopped.action_applied_ns) == (-1, START_NS + 110_000_000)
    np.testing.assert_allclose(stopped.proprioception, action_of(1) * 0.1, atol=1e-7)
    assert scene.service.counters()["stops"] == 1


def test_the_watchdog_runs_from_the_attempts_beginning(tmp_path):
    scene = Scene(tmp_path, answers=None, steps=4, stop_after=0.1)
    scene.run()
    assert sources(scene) == [ActionSource.ZERO, ActionSource.ZERO, STOP, STOP]


def test_a_reset_that_takes_longer_than_the_watchdogs_time_does_not_stop_the_next_attempt(tmp_path):
    scene = Scene(tmp_path, answers=0.03, task={"time_limit": 2, "reset_steps": 20}, steps=26, stop_after=0.1)
    scene.run()
    assert sources(scene) == [POLICY] * 4
    assert scene.service.counters()["stops"] == 0


def test_a_fresh_action_sets_a_stopped_robot_going_again(tmp_path):
    scene = Scene(tmp_path, only(1, 6), steps=8, stop_after=0.1)
    scene.run()
    assert [s.value for s in sources(scene)] == ["policy", "held", "stop", "stop", "stop", "policy", "held", "stop"]
    assert scene.service.counters()["stops"] == 2


def test_an_answer_that_is_older_than_the_watchdog_allows_does_not_move_the_robot(tmp_path):
    # As after an outage: what was in the buffers comes all at once, the newest last.
    scene = Scene(tmp_path, answers=None, steps=8, stop_after=0.1)
    for seq in (1, 2, 3):  # published at 0, 40 and 80 ms
        scene.clock.at(0.19, lambda seq=seq: scene.answer(seq))
    scene.clock.at(0.21, lambda: scene.answer(6))
    scene.run()
    assert [s.value for s in sources(scene)[:6]] == ["zero", "zero", "stop", "stop", "stop", "policy"]
    assert scene.time_steps[7].answered_seq == 6
    assert scene.counts.refused_actions == 3
    assert scene.counts.late_actions == 3
    assert scene.task.times("command") == [0.21]


@pytest.mark.parametrize("name", ["pause", "e_stop"])
def test_a_stop_command_stops_the_robot_at_once_and_keeps_it_stopped(tmp_path, name):
    scene = Scene(tmp_path, answers=0.01, steps=4)
    replies = []
    scene.clock.at(0.02, lambda: replies.append(scene.command(name)))
    scene.run()
    assert replies[0].accepted
    assert 0.02 in scene.task.times("stop")
    assert sources(scene) == [STOP] * 4
    assert scene.counts.refused_actions == 3
    assert scene.task.times("command") == [0.01]
    assert scene.service.counters()["stops"] == 0  # no want of actions


def test_a_stop_command_that_comes_as_the_bridge_goes_to_sleep_is_not_slept_over(tmp_path):
    scene = Scene(tmp_path, answers=0.01, steps=1)
    expire = scene.bridge._watchdog.expire

    def stop_meanwhile(now_ns):  # after the bridge has looked for commands, before it sleeps
        if now_ns == START_NS + 10_000_000:
            scene.command("e_stop")
        return expire(now_ns)

    scene.bridge._watchdog.expire = stop_meanwhile
    scene.run()
    assert 0.01 in scene.task.times("stop")


def test_a_pause_does_not_lift_an_emergency_stop_and_resume_does(tmp_path):
    scene = Scene(tmp_path, answers=0.01, steps=6)
    scene.clock.at(0.02, lambda: scene.command("e_stop"))
    scene.clock.at(0.06, lambda: scene.command("pause"))
    scene.clock.at(0.14, lambda: scene.command("resume"))
    scene.run()
    assert sources(scene) == [STOP, STOP, STOP, STOP, POLICY, POLICY]
    assert scene.task.times("command") == pytest.approx([0.01, 0.17, 0.21])


def test_what_was_answered_before_a_stop_is_not_applied_again_after_it(tmp_path):
    scene = Scene(tmp_path, answers=None, steps=2)
    scene.clock.at(0.045, lambda: scene.answer(2))
    scene.clock.at(0.05, lambda: scene.command("pause"))
    scene.clock.at(0.055, lambda: scene.command("resume"))
    scene.clock.at(0.06, lambda: scene.answer(1))
    scene.clock.at(0.06, lambda: scene.answer(2))
    scene.run()
    assert sources(scene) == [ActionSource.ZERO, STOP]
    assert scene.task.times("command") == pytest.approx([0.045])


def test_no_attempt_starts_while_the_robot_is_to_stand_still(tmp_path):
    scene = Scene(tmp_path, answers=0.01, task={"time_limit": 2}, steps=4)
    scene.clock.at(0.05, lambda: scene.command("e_stop"))
    scene.clock.at(3.0, lambda: scene.command("resume"))
    scene.run()
    firsts = [at for at, t in zip(scene.published_s, scene.time_steps, strict=True) if t.is_first]
    assert firsts[:2] == [0.0, 0.0]
    assert all(at >= 3.0 for at in firsts[2:])  # a new first answer is asked for, then the attempt
    assert len(firsts) == 4
    assert scene.task.times("command")[:2] == pytest.approx([0.01, firsts[3] + 0.01])


def test_an_emergency_stop_before_the_first_attempt_holds_it_back(tmp_path):
    scene = Scene(tmp_path, answers=0.01, steps=1)
    scene.command("e_stop")
    scene.clock.at(2.0, lambda: scene.command("resume"))
    scene.run()
    assert min(scene.published_s) >= 2.0


def test_an_emergency_stop_holds_in_lockstep_too(tmp_path):
    scene = Scene(tmp_path, answers=0.01, task={"pacing": "lockstep"}, steps=3)
    scene.clock.at(0.005, lambda: scene.command("e_stop"))
    scene.clock.at(7.5, lambda: scene.command("resume"))
    scene.run()
    # The TimeStep is published again each second, and answered again.
    assert scene.task.times("command") == pytest.approx([8.01, 8.02, 8.03])
    assert sources(scene) == [POLICY] * 3


def test_an_unknown_command_is_refused_with_the_known_ones(tmp_path):
    scene = Scene(tmp_path, steps=1)
    reply = scene.command("dance")
    assert not reply.accepted
    for name in ("e_stop", "pause", "resume", "stop"):
        assert name in reply.detail


@pytest.mark.parametrize(
    "action",
    [np.array([np.nan, 0], np.float32), np.array([np.inf, 0], np.float32), np.zeros(3, np.float32), np.zeros(2)],
    ids=["nan", "infinity", "shape", "dtype"],
)
def test_an_action_that_is_no_action_is_dropped_and_counted(tmp_path, action):
    scene = Scene(tmp_path, answers=None, steps=1)
    bad = Action(ACTOR, BRIDGE, 1, action, -1.0, 0, *scene.actor_times())
    scene.clock.at(0.01, lambda: scene.actor.send(topics.ACTION, bad))
    scene.run()
    assert sources(scene) == [ActionSource.ZERO]
    assert scene.service.refusals.counts == {"action": 1}


def test_bytes_that_are_no_message_do_not_hide_the_action_behind_them(tmp_path):
    scene = Scene(tmp_path, answers=None, steps=1)
    scene.clock.at(0.01, lambda: scene.actor.send_bytes(topics.ACTION, b"\x93noise"))
    scene.clock.at(0.01, lambda: scene.answer(1))
    scene.run()
    assert sources(scene) == [POLICY]
    assert scene.service.refusals.counts == {"action": 1}


def test_a_flood_of_actions_keeps_the_newest(tmp_path):
    scene = Scene(tmp_path, answers=None, steps=1)

    def flood():
        for _ in range(500):
            scene.answer(0)
        scene.answer(1)

    scene.clock.at(0.01, flood)
    scene.run()
    assert sources(scene) == [POLICY]


@pytest.mark.parametrize(("field", "value"), [("offset", math.nan), ("reward", math.nan), ("reward", -1e39)])
def test_a_sensor_that_gives_no_number_ends_the_service_and_stops_the_robot(tmp_path, field, value):
    scene = Scene(tmp_path, answers=0.01, steps=10)
    scene.task.on_outcome = {3: lambda: setattr(scene.task, field, value)}
    with pytest.raises(ServiceError, match=rf"{re.escape(str(value))}.*expected finite 32-bit numbers"):
        scene.run()
    assert scene.task.log[-1][0] == "close"
    assert len(scene.time_steps) == 4  # what cannot be trusted is not published


def test_a_stopped_service_leaves_the_robot_stopped(tmp_path):
    scene = Scene(tmp_path, answers=0.01, steps=10)
    scene.clock.at(0.055, lambda: scene.service.stop("test"))
    scene.run()
    assert scene.task.log[-1] == ("close", 0.055)
    assert scene.finished[0].reason == "stopped"
    assert scene.finished[0].produced == len(scene.time_steps) == 3
