"""What the policy sees of its own earlier choices, and that replay makes the same of the experience it gets."""

import numpy as np
import pytest

from common import topics
from common.clock import FakeClock
from common.frame_ring import RingWriter
from common.pending_actions import observed_spec
from tests.helpers import make_spec
from tests.services.actor.scene import BRIDGE, Scene, make_weights

SPEC = make_spec(camera=False)
SENSED = len(SPEC.proprioception_low)
COUNT = 3


def pending_of(observation):
    """The TimeSteps that its pending actions answer, newest first; 0: nothing was chosen.

    :class:`TellingPolicy` chooses a hundredth of the TimeStep's number.
    """
    return np.rint(observation.proprioception[SENSED:].reshape(-1, 2)[:, 0] * 100).astype(int).tolist()


def test_the_policy_sees_what_it_has_chosen_on_the_time_steps_before_applied_or_not(tmp_path):
    scene = Scene(tmp_path, SPEC, pending_actions=COUNT)
    for seq in range(1, 6):
        scene.take(seq)
    assert [pending_of(o) for o in scene.policy.observations] == [[0, 0, 0], [1, 0, 0], [2, 1, 0], [3, 2, 1], [4, 3, 2]]
    newest = scene.policy.observations[-1]
    np.testing.assert_array_equal(newest.proprioception[:SENSED], scene.time_step(5).proprioception)
    np.testing.assert_array_equal(newest.previous_action, scene.time_step(5).action)


def test_time_steps_that_were_passed_over_have_no_choice(tmp_path):
    scene = Scene(tmp_path, SPEC, pending_actions=COUNT)
    scene.take(1)
    scene.take(2, 3)
    scene.take(4)
    scene.take(6)
    assert pending_of(scene.policy.observations[2]) == [3, 0, 1]
    assert pending_of(scene.policy.observations[3]) == [0, 4, 3]


def test_an_attempt_begins_with_none_and_so_does_another_bridge(tmp_path):
    scene = Scene(tmp_path, SPEC, pending_actions=COUNT)
    scene.take(1, 2)
    scene.take(scene.time_step(3, terminated=True))
    scene.take(scene.time_step(4, attempt=1, step_index=0))
    scene.take(scene.time_step(5, attempt=1, step_index=1))
    scene.take(scene.time_step(3, incarnation=BRIDGE + 1))
    scene.take(scene.time_step(4, incarnation=BRIDGE + 1))
    expected = [[0, 0, 0], [0, 0, 0], [4, 0, 0], [0, 0, 0], [3, 0, 0]]
    assert [pending_of(o) for o in scene.policy.observations] == expected


def test_an_answer_that_is_still_computed_is_known_to_what_comes_after_it(tmp_path):
    clock = FakeClock(0)
    scene = Scene(tmp_path, SPEC, clock, pending_actions=COUNT, min_inference_s=0.050)
    scene.actor._forwarder.start()
    scene.send_head(1, oldest_seq=1)
    scene.take(1)
    clock.advance_to(40_000_000)
    scene.take(2)
    clock.advance_to(50_000_000)
    assert [action.answered_seq for action in scene.take()] == [1]
    experiences = scene.experiences.wait_for(2)
    scene.actor._forwarder.stop()
    assert pending_of(scene.policy.observations[-1]) == [1, 0, 0]
    np.testing.assert_array_equal(experiences[1].extras.chosen_action, np.full(2, 0.01, np.float32))


def test_without_pending_actions_the_policy_sees_the_time_step_s_own_proprioception(tmp_path):
    scene = Scene(tmp_path, SPEC)
    scene.take(1)
    scene.take(2)
    np.testing.assert_array_equal(scene.policy.observations[-1].proprioception, scene.time_step(2).proprioception)


def test_policies_of_the_observed_task_are_taken_and_others_refused(tmp_path):
    scene = Scene(tmp_path, SPEC, pending_actions=COUNT)
    scene.actor._swap._swap(make_weights(SPEC, version=1))
    assert scene.actor._swap.received == 0
    assert scene.service.refusals.counts == {"policy": 1}
    scene.actor._swap._swap(make_weights(observed_spec(SPEC, COUNT), version=2))
    assert scene.actor._swap.received == 1


class Line:
    """What a bridge sends, over a link that loses, delays and bundles."""

    def __init__(self, scene, rng) -> None:
        self._scene, self._rng = scene, rng
        self._step_index, self._attempt = -1, 0
        self._late = []
        self.lost = set()

    def send(self, seq) -> None:
        """Let number ``seq`` arrive now, later, or never, and what is late perhaps now."""
        self._step_index += 1
        ends = self._rng.random() < 0.04
        step = self._scene.time_step(seq, step_index=self._step_index, attempt=self._attempt, truncated=ends)
        if ends:
            self._step_index, self._attempt = -1, self._attempt + 1
        fate = self._rng.choice(["now", "late", "lost"], p=[0.85, 0.13, 0.02])
        if fate == "now":
            self._scene.peer.send(topics.TIME_STEP, step)
        elif fate == "late":
            self._late.append(step)
        else:
            self.lost.add(seq)
        if self._rng.random() < 0.3:
            self.send_late()

    def send_late(self) -> None:
        """Repair what can be repaired."""
        for step in self._late:
            self._scene.peer.send(topics.TIME_STEP_RESENT, step)
        self._late = []


@pytest.mark.parametrize("inference_s", [0.0, 0.030, 0.070], ids=["at once", "in the cycle", "longer than a cycle"])
def test_replay_makes_of_the_experience_what_the_policy_saw(tmp_path, inference_s):
    rng, clock, steps = np.random.default_rng(7), FakeClock(0), 400
    scene = Scene(tmp_path, SPEC, clock, pending_actions=COUNT, min_inference_s=inference_s)
    line = Line(scene, rng)
    scene.actor._forwarder.start()
    scene.send_head(1, oldest_seq=1)
    for seq in range(1, steps):
        line.send(seq)
        if rng.random() < 0.8:  # otherwise the actor finds it together with the next
            scene.take()
        for _ in range(4):
            clock.advance(0.010)
            scene.take()
    line.send_late()
    scene.take(steps)
    scene.send_head(steps + 1, oldest_seq=steps + 1)  # what is missing now is lost
    experiences = scene.experiences.wait_for(steps - len(line.lost))
    scene.actor._forwarder.stop()

    ring = RingWriter.create_or_reopen(tmp_path / "ring", SPEC, 2 * steps, pending_actions=COUNT)
    for experience in experiences:
        ring.append(experience)
    rows = ring.read_rows(np.arange(ring.rows_appended))
    stored = {int(row["seq"]): row for row in rows}
    assert len(line.lost) > 3
    compared, full = 0, 0
    for observation in scene.policy.observations:
        row = stored[int(observation.proprioception[0])]
        if row["whole"]:
            np.testing.assert_array_equal(row["proprioception"], observation.proprioception)
            compared += 1
            full += 0 not in pending_of(observation)
    # Only what lost ones had to tell of is missing, two observations each.
    assert len(scene.policy.observations) - compared <= 2 * len(line.lost)
    assert full > 50 if inference_s < 0.04 else compared > 100
    # Each choice ends up where it belongs: the action of a transition is what was chosen on what it begins with.
    for row in rows[rows["pair"] == 1]:
        assert row["has_extras"]
        np.testing.assert_allclose(row["chosen_action"], (row["seq"] - 1) / 100, rtol=1e-6)
