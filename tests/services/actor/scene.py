"""An actor whose policy tells what it saw, between a bridge and a replay that the test plays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from common import topics
from common.messages import Acknowledgement, Action, PolicyWeights, StreamHead
from common.policies import ChosenAction, Observation, pack_weights
from common.policies.weights import initial_parameters
from common.transport import InMemoryNetwork
from services.actor.actor import Actor
from services.actor.config import ActorSettings
from tests.helpers import make_spec, make_time_step
from tests.services.builders import Peer, SoloService

ACTOR = 50
"""The actor's incarnation."""
BRIDGE = 1
"""The bridge's incarnation in :func:`tests.helpers.make_time_step`."""


class TellingPolicy:
    """Remembers its observations; its action is a hundredth of the first proprioception."""

    def __init__(self, version=0) -> None:
        self.version = version
        self.observations: list[Observation] = []

    def act(self, observation, rng, deterministic=False) -> ChosenAction:
        self.observations.append(observation)
        return ChosenAction(np.full(2, observation.proprioception[0] / 100, np.float32), -0.25 * self.version)


class Scene:
    """The actor, not running: tests call ``take`` for a round of its loop."""

    def __init__(self, directory, spec=None, clock=None, pending_actions=0, **settings) -> None:
        self.spec = spec or make_spec()
        self.network = InMemoryNetwork()
        self.service = SoloService(topics.ACTOR, self.network, directory, clock, incarnation=ACTOR)
        self.policy = TellingPolicy()
        self.actor = Actor(
            self.service, self.spec, self.policy, ActorSettings(**settings), pending_actions=pending_actions
        )
        self.peer = Peer(self.network)
        self.actions = self.peer.messages(topics.ACTION)
        self.experiences = self.peer.messages(topics.EXPERIENCE)

    def time_step(self, seq, **changes):
        """A TimeStep of the scene's task."""
        return make_time_step(seq, self.spec, **changes)

    def take(self, *time_steps, topic=topics.TIME_STEP) -> list[Action]:
        """Let TimeSteps arrive together and the actor take them; return its new answers."""
        before = len(self.actions)
        for time_step in time_steps:
            self.peer.send(topic, self.time_step(time_step) if isinstance(time_step, int) else time_step)
        self.actor.take_time_steps()
        return self.actions[before:]

    def send_head(self, next_seq, oldest_seq=0) -> None:
        """Tell, as the bridge, what TimeSteps there are."""
        self.peer.send(topics.TIME_STEP_HEAD, StreamHead(BRIDGE, oldest_seq, next_seq))

    def acknowledge(self, next_seq, updates_owed=0.0) -> None:
        """Acknowledge experience as replay."""
        missing = np.zeros((0, 2), np.int64)
        self.peer.send(topics.EXPERIENCE_ACK, Acknowledgement(ACTOR, next_seq, missing, updates_owed))


def make_weights(spec, version, hidden_size=8, seed=0) -> PolicyWeights:
    """Return a policy as a learner pushes it."""
    strides = (1, 1, 1, 1) if spec.has_camera else ()
    return pack_weights(
        initial_parameters(spec, hidden_size, strides, np.random.default_rng(seed)),
        version=version,
        updates=version * 50,
        algorithm="sac",
        hidden_size=hidden_size,
        encoder_strides=strides,
        dtype="float32",
    )


def damaged(weights: PolicyWeights) -> PolicyWeights:
    """Return weights with one byte changed on the way."""
    buffer = weights.buffer.copy()
    buffer[3] ^= 1
    return replace(weights, buffer=buffer)
