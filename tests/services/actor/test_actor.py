"""The actor answers the newest observation, once, and at once."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from common import topics
from common.clock import FakeClock
from common.messages import Finished
from tests.helpers import eventually, make_spec
from tests.services.actor.scene import ACTOR, BRIDGE, Scene, TellingPolicy


def seqs(actions):
    return [action.answered_seq for action in actions]


def stack_ids(observation):
    """Ids of the stacked frames, oldest first: each frame's pixels are its id."""
    return observation.frames[:, 0, 0, 0].tolist()


def test_an_answer_says_whom_and_what_it_answers(tmp_path):
    clock = FakeClock(7_000)
    scene = Scene(tmp_path, clock=clock)
    (action,) = scene.take(12)
    assert (action.actor_incarnation, action.incarnation, action.answered_seq) == (ACTOR, BRIDGE, 12)
    np.testing.assert_allclose(action.action, [0.12, 0.12])
    assert (action.policy_version, action.log_probability) == (0, 0.0)
    assert (action.received_ns, action.sent_ns) == (7_000, 7_000)


def test_an_observation_is_stack_proprioception_and_the_action_in_force(tmp_path):
    scene = Scene(tmp_path)
    for seq in range(6):
        scene.take(seq)
    observation = scene.policy.observations[-1]
    assert stack_ids(observation) == [2, 3, 4, 5]
    assert observation.frames.shape == (4, 6, 8, 3)
    np.testing.assert_array_equal(observation.proprioception, np.full(5, 5))
    np.testing.assert_array_equal(observation.previous_action, [0.5, 0.5])
    first = scene.policy.observations[0]
    assert stack_ids(first) == [0, 0, 0, 0]
    np.testing.assert_array_equal(first.previous_action, [0, 0])


def test_of_a_burst_only_the_newest_is_answered_and_its_stack_is_whole(tmp_path):
    scene = Scene(tmp_path)
    assert seqs(scene.take(0)) == [0]
    assert seqs(scene.take(1, 2, 3, 4, 5)) == [5]
    assert stack_ids(scene.policy.observations[-1]) == [2, 3, 4, 5]
    assert len(scene.policy.observations) == 2


@pytest.mark.parametrize("order", [(3, 1, 2), (2, 3, 1)])
def test_the_newest_is_the_one_with_the_highest_number_not_the_last_to_arrive(tmp_path, order):
    scene = Scene(tmp_path)
    scene.take(0)
    assert seqs(scene.take(*order)) == [3]
    assert stack_ids(scene.policy.observations[-1]) == [0, 1, 2, 3]


def test_what_is_older_than_the_last_answer_is_not_answered(tmp_path):
    scene = Scene(tmp_path)
    scene.take(0)
    scene.take(4)
    assert scene.take(1, 2, 3) == []
    assert scene.take(3, topic=topics.TIME_STEP_RESENT) == []
    assert seqs(scene.take(5)) == [5]


def test_the_newest_may_come_by_way_of_a_repair(tmp_path):
    scene = Scene(tmp_path)
    assert seqs(scene.take(3, topic=topics.TIME_STEP_RESENT)) == [3]


@pytest.mark.parametrize("end", [{"terminated": True}, {"truncated": True}])
def test_the_last_time_step_of_an_attempt_is_not_answered(tmp_path, end):
    scene = Scene(tmp_path)
    scene.take(0, 1)
    assert scene.take(scene.time_step(2, **end)) == []
    assert scene.take(scene.time_step(2, **end)) == []  # nor if it comes again


def test_an_attempt_that_is_over_is_not_acted_in(tmp_path):
    scene = Scene(tmp_path)
    scene.take(0)
    # The world has left the observation of number 1 behind.
    assert scene.take(scene.time_step(1), scene.time_step(2, truncated=True)) == []


def test_the_first_time_step_of_the_next_attempt_is_answered_as_such(tmp_path):
    scene = Scene(tmp_path)
    scene.take(0, 1, 2, 3)
    end = scene.time_step(4, terminated=True)
    first = scene.time_step(5, attempt=1, step_index=0, action=np.zeros(2, np.float32))
    assert seqs(scene.take(end, first)) == [5]
    observation = scene.policy.observations[-1]
    assert stack_ids(observation) == [5, 5, 5, 5]  # no frame of the attempt before
    np.testing.assert_array_equal(observation.previous_action, [0, 0])


def test_a_time_step_that_is_published_again_gets_the_same_answer_again(tmp_path):
    scene = Scene(tmp_path)
    (answer,) = scene.take(3)
    (again,) = scene.take(3)
    np.testing.assert_array_equal(again.action, answer.action)
    assert (again.answered_seq, again.sent_ns) == (answer.answered_seq, answer.sent_ns)
    assert len(scene.policy.observations) == 1
    assert scene.actor.counters()["actions"] == 1
    assert len(scene.take(3, 3, 3)) == 1  # one for all copies that came together


def test_a_new_bridge_is_answered_though_its_numbers_are_lower(tmp_path):
    scene = Scene(tmp_path)
    scene.take(7, 8, 9)
    restarted = scene.time_step(0, incarnation=BRIDGE + 1)
    (action,) = scene.take(restarted)
    assert (action.incarnation, action.answered_seq) == (BRIDGE + 1, 0)
    assert stack_ids(scene.policy.observations[-1]) == [0, 0, 0, 0]
    assert scene.take(10) == []  # from the bridge before


def test_a_late_word_of_the_bridge_before_does_not_disturb_the_stack(tmp_path):
    scene = Scene(tmp_path)
    scene.take(0, 1)
    scene.take(*(scene.time_step(seq, incarnation=BRIDGE + 1) for seq in range(4)))
    scene.take(9)
    scene.take(scene.time_step(4, incarnation=BRIDGE + 1))
    assert stack_ids(scene.policy.observations[-1]) == [1, 2, 3, 4]


def test_of_two_bridges_in_one_burst_the_newer_is_answered(tmp_path):
    scene = Scene(tmp_path)
    (action,) = scene.take(scene.time_step(0, incarnation=BRIDGE + 1), scene.time_step(9))
    assert (action.incarnation, action.answered_seq) == (BRIDGE + 1, 0)


def test_after_a_gap_the_actor_acts_on_what_it_has(tmp_path):
    scene = Scene(tmp_path)
    scene.take(0, 1)
    assert seqs(scene.take(5)) == [5]
    ids = stack_ids(scene.policy.observations[-1])
    assert ids[-1] == 5
    assert ids == sorted(ids)


def test_a_time_step_without_a_new_frame_repeats_the_stack(tmp_path):
    scene = Scene(tmp_path)
    scene.take(0, 1, 2, 3, 4)
    no_frame = {"frame_ids": np.zeros(0, np.int64), "frame_capture_ns": np.zeros(0, np.int64)}
    assert seqs(scene.take(scene.time_step(5, frames=np.zeros((0, 6, 8, 3), np.uint8), **no_frame))) == [5]
    assert stack_ids(scene.policy.observations[-1]) == [1, 2, 3, 4]


def test_an_actor_that_knows_no_frame_yet_does_not_act(tmp_path):
    scene = Scene(tmp_path)
    no_frame = {"frame_ids": np.zeros(0, np.int64), "frame_capture_ns": np.zeros(0, np.int64)}
    assert scene.take(scene.time_step(5, frames=np.zeros((0, 6, 8, 3), np.uint8), **no_frame)) == []
    assert seqs(scene.take(6)) == [6]


def test_frames_whose_ids_do_not_increase_are_refused_and_not_acted_on(tmp_path):
    scene = Scene(tmp_path)
    ids = np.array([4, 4], np.int64)
    bad = scene.time_step(1, frame_ids=ids, frame_capture_ns=ids, frames=np.zeros((2, 6, 8, 3), np.uint8))
    assert scene.take(bad) == []
    assert scene.service.refusals.counts == {"timestep": 1}


@pytest.mark.parametrize(
    "changes",
    [
        {"proprioception": np.full(5, np.nan, np.float32)},
        {"proprioception": np.zeros(4, np.float32)},
        {"frames": np.zeros((1, 6, 9, 3), np.uint8)},
        {"action": np.zeros(2, np.float64)},
        {"reward": float("inf")},
        {"seq": -1},
    ],
    ids=["nan", "shape", "frame size", "dtype", "infinity", "negative"],
)
def test_a_time_step_that_is_none_is_dropped_and_counted(tmp_path, changes):
    scene = Scene(tmp_path)
    assert scene.take(replace(scene.time_step(1), **changes)) == []
    assert scene.service.refusals.counts == {"timestep": 1}
    assert seqs(scene.take(2)) == [2]


def test_without_a_camera_there_are_no_frames_in_the_observation(tmp_path):
    scene = Scene(tmp_path, make_spec(camera=False))
    assert seqs(scene.take(0, 1)) == [1]
    assert scene.policy.observations[0].frames is None


def test_the_newest_policy_acts_from_the_next_observation_on(tmp_path):
    scene = Scene(tmp_path)
    assert scene.take(0)[0].policy_version == 0
    scene.actor._swap.policy = TellingPolicy(version=4)
    (action,) = scene.take(1)
    assert (action.policy_version, action.log_probability) == (4, -1.0)
    assert scene.actor.counters()["policy_version"] == 4


# ---------------------------------------------------------------------- lockstep


class TellingCondition(threading.Condition):
    """A condition that calls ``before`` when someone begins to wait on it."""

    def __init__(self, before) -> None:
        super().__init__()
        self._before = before

    def wait(self, timeout=None) -> bool:
        self._before()
        return super().wait(timeout)


def run_forwarder(scene):
    """Let the actor hear acknowledgements, without its loop."""
    scene.actor._forwarder.start()


def test_in_lockstep_the_actor_waits_until_the_budget_is_spent(tmp_path):
    scene = Scene(tmp_path, make_spec(pacing="lockstep"))
    run_forwarder(scene)
    waits = []

    def learn_a_little():
        waits.append(len(scene.actions))
        scene.acknowledge(0, updates_owed=max(0.0, 5.0 - len(waits)))

    scene.acknowledge(0, updates_owed=5.0)
    eventually(lambda: scene.actor.counters()["updates_owed"] == 5.0)
    scene.service.wake = TellingCondition(learn_a_little)
    assert seqs(scene.take(1)) == [1]
    scene.actor._forwarder.stop()
    # 2 updates of surplus are allowed: it waited at 5, 4 and 3, and had not acted before.
    assert len(waits) >= 3
    assert set(waits) == {0}


@pytest.mark.parametrize(("pacing", "owed"), [("realtime", 1000.0), ("lockstep", 2.0)])
def test_otherwise_it_does_not_wait(tmp_path, pacing, owed):
    scene = Scene(tmp_path, make_spec(pacing=pacing))
    run_forwarder(scene)
    scene.acknowledge(0, updates_owed=owed)
    eventually(lambda: scene.actor.counters()["updates_owed"] == owed)
    assert seqs(scene.take(1)) == [1]
    scene.actor._forwarder.stop()


@pytest.mark.parametrize("end", ["finished", "stop"])
def test_the_end_of_the_run_ends_the_wait(tmp_path, end):
    scene = Scene(tmp_path, make_spec(pacing="lockstep"))
    run_forwarder(scene)
    scene.acknowledge(0, updates_owed=50.0)
    eventually(lambda: scene.actor.counters()["updates_owed"] == 50.0)

    def end_run():
        if end == "stop":
            scene.service.stopping.set()
        else:
            scene.service.finished_message = Finished(BRIDGE, 2, "steps")

    scene.service.wake = TellingCondition(end_run)
    scene.take(1)
    scene.actor._forwarder.stop()


# ---------------------------------------------------------------------- the whole loop


def test_the_actor_runs_until_everything_is_with_replay(tmp_path):
    scene = Scene(tmp_path, make_spec(camera=False))
    scene.service.peers = {topics.REPLAY: "drained", topics.ROBOT_BRIDGE: "drained"}
    loop = threading.Thread(target=scene.actor.run)
    loop.start()
    scene.send_head(0)
    for seq in range(5):
        scene.peer.send(topics.TIME_STEP, scene.time_step(seq))
    scene.experiences.wait_for(5)
    scene.service.finished_message = Finished(BRIDGE, 7, "steps")
    eventually(lambda: scene.service.state == "draining")
    # Two TimeSteps were still on their way.
    scene.peer.send(topics.TIME_STEP, scene.time_step(6, truncated=True))
    scene.peer.send(topics.TIME_STEP_RESENT, scene.time_step(5))
    experiences = scene.experiences.wait_for(7)
    assert [e.time_step.seq for e in experiences] == list(range(7))
    scene.acknowledge(6)
    assert loop.is_alive()
    scene.acknowledge(7)
    loop.join(20)
    assert not loop.is_alive()
    assert scene.service.state == "drained"
    assert scene.actor.counters()["unacknowledged"] == 0


def test_an_answer_comes_no_sooner_than_a_slower_computer_would_give_it(tmp_path):
    clock = FakeClock(0)
    scene = Scene(tmp_path, clock=clock, min_inference_s=0.012)
    assert scene.take(1) == []
    clock.advance_to(11_999_999)
    assert scene.take() == []
    clock.advance_to(12_000_000)
    (action,) = scene.take()
    assert (action.answered_seq, action.received_ns, action.sent_ns) == (1, 0, 12_000_000)


def test_who_still_computes_answers_that_first_and_then_the_newest_of_what_came_meanwhile(tmp_path):
    clock = FakeClock(0)
    scene = Scene(tmp_path, clock=clock, min_inference_s=0.100)
    assert scene.take(0) == []
    for seq, at_ns in ((1, 40_000_000), (2, 80_000_000)):
        clock.advance_to(at_ns)
        assert scene.take(seq) == []
    clock.advance_to(100_000_000)
    assert seqs(scene.take()) == [0]
    assert len(scene.policy.observations) == 2
    assert stack_ids(scene.policy.observations[-1]) == [0, 0, 1, 2]
    clock.advance_to(200_000_000)
    assert seqs(scene.take()) == [2]


def test_while_an_action_is_held_back_experience_goes_on_to_replay(tmp_path):
    scene = Scene(tmp_path, clock=FakeClock(0), min_inference_s=1.0)
    scene.actor._forwarder.start()
    scene.take(0)
    scene.take(1)
    eventually(lambda: len(scene.experiences) == 2)
    scene.actor._forwarder.stop()
    assert len(scene.actions) == 0


def test_an_observation_that_is_over_before_its_turn_is_not_answered(tmp_path):
    clock = FakeClock(0)
    scene = Scene(tmp_path, clock=clock, min_inference_s=0.100)
    scene.take(0)
    scene.take(1)
    scene.take(scene.time_step(2, terminated=True))
    clock.advance_to(100_000_000)
    assert seqs(scene.take()) == [0]
    clock.advance_to(300_000_000)
    assert scene.take() == []
