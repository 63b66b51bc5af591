"""New policies for the actor: received and decoded off the hot path, swapped in between two actions."""

from __future__ import annotations

import logging

from common import topics
from common.codec import encode
from common.errors import MessageError
from common.inbox import Inbox
from common.messages import PolicyAcknowledgement, PolicyWeights, TaskSpec
from common.policies import policy_from_weights
from common.policies.base import Policy
from common.service import Service

logger = logging.getLogger(__name__)


class PolicySwap:
    """Holds the newest usable policy; a thread of its own turns received weights into it."""

    def __init__(self, service: Service, spec: TaskSpec, initial: Policy) -> None:
        self.policy = initial
        """The policy to act with; replaced as a whole."""
        self.received = 0
        """Policies swapped in."""
        self._service, self._spec = service, spec
        self._wake = service.clock.condition()
        self._stopping = False
        self._inbox = Inbox(
            service.transport, topics.POLICY, PolicyWeights, self._wake, service.clock, service.refusals
        )
        self._ack_publisher = service.transport.publisher(topics.POLICY_ACK)
        self._thread = service.clock.thread(self._run, "policy weights")

    def start(self) -> None:
        """Begin to receive."""
        self._thread.start()

    def stop(self) -> None:
        """Stop receiving."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._wake:
                while not (self._inbox or self._stopping):
                    self._service.clock.wait(self._wake)
                if self._stopping:
                    return
            arrived = self._inbox.take_newest()
            if arrived is None:
                continue
            self._ack_publisher.put(encode(PolicyAcknowledgement(arrived.message.version)))
            if arrived.message.version > self.policy.version:
                self._swap(arrived.message)

    def _swap(self, weights: PolicyWeights) -> None:
        try:
            self.policy = policy_from_weights(self._spec, weights)
            self.received += 1
        except MessageError as error:
            self._service.refusals.refuse(topics.POLICY.name, error)
