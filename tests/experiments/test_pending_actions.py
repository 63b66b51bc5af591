"""Runs with pending actions over a bad network: what the policy saw is what the learner learns from."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from common.algorithms.ppo import PPO
from common.algorithms.sac import SAC
from common.frame_ring import RingReader
from common.policies.numpy_policy import NumpyPolicy
from common.policies.torch_policy import TorchPolicy
from experiments.train import Training, main, train
from services.actor.actor import Actor

COUNT = 3
SMALL = (
    f"algorithm.pending_actions={COUNT}",
    "algorithm.batch_size=8",
    "algorithm.hidden_size=32",
    "algorithm.replay_capacity=500",
    "task.target_half_width=0.6",
    "actor.min_inference_s=0.001",
    "learner.min_update_s=0.005",
)
SAC_ONLY = ("algorithm.min_size_to_sample=30", "algorithm.policy_push_interval=5")
PPO_ONLY = ("algorithm.rollout_length=40", "algorithm.epochs=1")


class Spy:
    """Listens to policy, actor and algorithm of a run in this process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.seen = {}
        """Number of a TimeStep -> what the policy saw besides frames."""
        self.minibatches = []
        self._newest = None
        for policy in (NumpyPolicy, TorchPolicy):
            self._listen(monkeypatch, policy, "act", self._hear_observation)
        self._listen(monkeypatch, Actor, "_remember", self._hear_answer)
        for algorithm, update in ((SAC, "update"), (PPO, "update_in_slices")):
            self._listen(monkeypatch, algorithm, update, self.minibatches.append)

    @staticmethod
    def _listen(monkeypatch, owner, name, hear) -> None:
        method = getattr(owner, name)

        def listening(instance, *arguments, **options):
            hear(arguments[0])
            return method(instance, *arguments, **options)

        monkeypatch.setattr(owner, name, listening)

    def _hear_observation(self, observation) -> None:
        self._newest = observation.proprioception.copy(), observation.previous_action.copy()

    def _hear_answer(self, computed) -> None:
        self.seen[computed.arrived.message.seq] = self._newest


@pytest.mark.parametrize(
    ("task", "algorithm", "steps", "settings"),
    [
        ("dot_reacher", "sac", 180, SAC_ONLY),
        ("visual_dot_reacher", "sac", 120, SAC_ONLY),
        ("dot_reacher", "ppo", 250, PPO_ONLY),
    ],
)
def test_the_learner_learns_from_what_the_policy_saw(task, algorithm, steps, settings, tmp_path, monkeypatch):
    spy = Spy(monkeypatch)
    run_dir: Path = tmp_path / "run"
    values = train(
        Training(
            task, run_dir, algorithm, steps=steps, mode="remote_only", network="wifi_bad", overrides=(*SMALL, *settings)
        )
    )
    assert values["late_actions"] > 0.5 * values["cycles"]
    assert values["experience"]["lost"] == 0
    ring = RingReader(run_dir / "ring")
    rows = ring.read_rows(np.arange(ring.rows_appended))
    assert rows["whole"].all()
    assert spy.minibatches
    own = rows["proprioception"].shape[1] - 2 * COUNT
    pending = Counter()
    for minibatch in spy.minibatches:
        for at, row in enumerate(minibatch.rows):
            now = rows[row]
            proprioception, previous_action = spy.seen[int(now["seq"]) - 1]
            np.testing.assert_array_equal(minibatch.proprioception[at], proprioception)
            np.testing.assert_array_equal(minibatch.previous_action[at], previous_action)
            # What the next observation adds is the choice that this one was followed by.
            np.testing.assert_array_equal(minibatch.next_proprioception[at, own : own + 2], minibatch.chosen_action[at])
            np.testing.assert_array_equal(
                minibatch.next_proprioception[at, own + 2 :], minibatch.proprioception[at, own:-2]
            )
            if int(now["seq"]) in spy.seen:  # The last of an attempt is not acted on.
                np.testing.assert_array_equal(minibatch.next_proprioception[at], spy.seen[int(now["seq"])][0])
            pending[int((proprioception[own:].reshape(COUNT, 2) != 0).any(axis=1).sum())] += 1
    assert set(pending) == {0, 1, 2, 3}  # The first steps of attempts are among them.


def test_a_count_that_cannot_be_is_refused_before_anything_is_begun(tmp_path, capsys):
    options = ["--task", "dot_reacher", "--run-dir", str(tmp_path / "run"), "--set", "algorithm.pending_actions=-1"]
    assert main(options) == 1
    assert "pending_actions = -1: expected an integer in 0..100" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
