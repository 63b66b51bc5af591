"""New policies are swapped in: only newer ones, only undamaged ones."""

from dataclasses import replace

import numpy as np
import pytest

from common import topics
from common.policies import Observation, policy_from_weights
from common.transport import InMemoryNetwork
from services.actor.weights import PolicySwap
from tests.helpers import eventually, make_spec
from tests.services.actor.scene import TellingPolicy, damaged, make_weights
from tests.services.builders import Peer, SoloService

SPEC = make_spec(camera=False)


class Learner(Peer):
    """Pushes policies to a swap that starts with version 2."""

    def __init__(self, directory) -> None:
        self.network = InMemoryNetwork()
        super().__init__(self.network)
        self._directory = directory

    def start_swap(self) -> PolicySwap:
        self.service = SoloService(topics.ACTOR, self.network, self._directory)
        self.swap = PolicySwap(self.service, SPEC, TellingPolicy(version=2))
        self.swap.start()
        return self.swap

    def push(self, weights) -> None:
        self.send(topics.POLICY, weights)


@pytest.fixture
def learner(tmp_path):
    """A learner whose swap is stopped at the end."""
    learner = Learner(tmp_path)
    yield learner
    learner.swap.stop()


def test_a_newer_policy_is_swapped_in_and_acts_as_the_learner_made_it(learner):
    swap = learner.start_swap()
    weights = make_weights(SPEC, version=3, seed=4)
    learner.push(weights)
    eventually(lambda: swap.policy.version == 3)
    assert swap.received == 1
    observation = Observation(None, np.ones(5, np.float32), np.zeros(2, np.float32))
    expected = policy_from_weights(SPEC, weights).act(observation, np.random.default_rng(0))
    got = swap.policy.act(observation, np.random.default_rng(0))
    np.testing.assert_array_equal(got.action, expected.action)


@pytest.mark.parametrize("version", [1, 3])
def test_the_learner_is_told_what_has_arrived_be_it_of_use_or_not(learner, version):
    learner.start_swap()
    acknowledgements = learner.messages(topics.POLICY_ACK)
    learner.push(make_weights(SPEC, version))
    assert [ack.version for ack in acknowledgements.wait_for(1)] == [version]


@pytest.mark.parametrize("version", [1, 2])
def test_a_policy_that_is_not_newer_is_ignored(learner, version):
    swap = learner.start_swap()
    learner.push(make_weights(SPEC, version))
    learner.push(make_weights(SPEC, version))
    learner.push(make_weights(SPEC, version=9))
    eventually(lambda: swap.policy.version == 9)
    assert swap.received == 1
    assert learner.service.refusals.total == 0


def test_a_policy_that_comes_after_a_newer_one_is_ignored(learner):
    swap = learner.start_swap()
    learner.push(make_weights(SPEC, version=9))
    eventually(lambda: swap.policy.version == 9)
    learner.push(make_weights(SPEC, version=8))
    learner.push(make_weights(SPEC, version=10))
    eventually(lambda: swap.policy.version == 10)
    assert swap.received == 2


OTHER_SPEC = make_spec(camera=False, action_low=-np.ones(3, np.float32), action_high=np.ones(3, np.float32))


@pytest.mark.parametrize(
    "bad",
    [
        damaged(make_weights(SPEC, 5)),
        replace(make_weights(SPEC, 5), digest="0" * 32),
        replace(make_weights(SPEC, 5), dtype="float64"),
        replace(make_weights(SPEC, 5), hidden_size=16),
        replace(make_weights(SPEC, 5), encoder_strides=np.array([1, 1, 1, 1])),
        make_weights(OTHER_SPEC, 5),
    ],
    ids=["damaged", "digest", "dtype", "hidden size", "encoder", "another task"],
)
def test_a_policy_that_cannot_be_used_is_refused_and_the_old_one_goes_on(learner, bad):
    swap = learner.start_swap()
    learner.push(bad)
    eventually(lambda: learner.service.refusals.counts["policy"] == 1)
    assert swap.policy.version == 2
    learner.push(make_weights(SPEC, version=6))
    eventually(lambda: swap.policy.version == 6)


def test_bytes_that_are_no_policy_are_refused(learner):
    swap = learner.start_swap()
    learner.send_bytes(topics.POLICY, b"\x00" * 100)
    eventually(lambda: learner.service.refusals.counts["policy"] == 1)
    assert swap.policy.version == 2


def test_an_actor_that_comes_late_gets_the_last_policy(learner):
    learner.push(make_weights(SPEC, version=3))
    learner.push(make_weights(SPEC, version=4))
    swap = learner.start_swap()
    eventually(lambda: swap.policy.version == 4)
