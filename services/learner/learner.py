"""The learner: updates the policy from minibatches and pushes it to the actor, as fast as the budget allows."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from pathlib import Path

from common import topics
from common.algorithms.base import Algorithm
from common.algorithms.config import AlgorithmConfig
from common.minibatch import Minibatch
from common.service import Service
from services.learner.checkpoint import CheckpointWriter
from services.learner.config import LearnerSettings
from services.learner.minibatches import MinibatchSource
from services.learner.policy_pushes import PolicyPusher

logger = logging.getLogger(__name__)

METRICS_S = 1.0
"""Period in which losses are read off the algorithm."""
LAST_UPDATE_S = 20.0
"""Longest that a running update is gone on with once the run's steps are done: the others, who wait for
:data:`~common.service.DRAIN_TIMEOUT_S`, are to see the learner save."""


class Learner:
    """Runs the algorithm until the run is finished, then saves."""

    def __init__(
        self,
        service: Service,
        algorithm: Algorithm,
        config: AlgorithmConfig,
        settings: LearnerSettings,
        source: MinibatchSource,
        policy_version: int,
    ) -> None:
        self._service, self._algorithm, self._config = service, algorithm, config
        self._source = source
        self._pusher = PolicyPusher(service, settings.push_share)
        self._checkpoints = CheckpointWriter(Path(service.run.directory))
        self._checkpoint_ns = round(settings.checkpoint_s * 1e9)
        self._min_update_ns = round(settings.min_update_s * 1e9)
        self._policy_version = policy_version
        self._metrics: dict[str, float] = {}
        self._rate = 0.0
        self._checkpoint_asked = threading.Event()
        service.counters = self.counters
        service.serve_commands({"checkpoint": self._ask_checkpoint})

    def run(self) -> None:
        """Update until the bridge says that the run is finished; then save."""
        service, clock = self._service, self._service.clock
        self._source.start()
        service.state = "running"
        if self._policy_version:
            self._push()
        next_checkpoint_ns = clock.now_ns() + self._checkpoint_ns
        measured_ns, measured_updates = clock.now_ns(), self._algorithm.updates
        try:
            while not service.stopping.is_set() and service.finished is None:
                minibatch = self._source.get(timeout_s=0.1)
                if minibatch is not None:
                    self._update(minibatch)
                now_ns = clock.now_ns()
                if now_ns - measured_ns >= METRICS_S * 1e9:
                    self._rate = (self._algorithm.updates - measured_updates) / (now_ns - measured_ns) * 1e9
                    measured_ns, measured_updates = now_ns, self._algorithm.updates
                    self._metrics = self._algorithm.metrics()
                if now_ns >= next_checkpoint_ns or self._checkpoint_asked.is_set():
                    self._checkpoint_asked.clear()
                    next_checkpoint_ns = now_ns + self._checkpoint_ns
                    self._save()
            self._save()
            service.drain(lambda: True, lambda: None)
        finally:
            self._source.stop()
            self._pusher.close()
            self._checkpoints.close()
        if service.failure is None:
            service.failure = self._checkpoints.failure

    def counters(self) -> dict[str, float]:
        """Counts and losses for the heartbeat and the record."""
        return {
            "updates": self._algorithm.updates,
            "updates_per_s": self._rate,
            "policy_version": self._policy_version,
            "policy_pushes": self._pusher.pushes,
            "pushes_skipped": self._pusher.skipped,
            "push_bytes_per_s": self._pusher.bytes_per_s,
            "minibatches_dropped": self._source.dropped,
            **self._metrics,
        }

    def _update(self, minibatch: Minibatch) -> None:
        due_ns = self._service.clock.now_ns() + self._min_update_ns
        slices = self._algorithm.update_in_slices(minibatch)
        if slices is None:
            self._algorithm.update(minibatch)
        elif not self._complete(slices):
            return
        self._wait_until(due_ns)
        if self._algorithm.updates % self._config.policy_push_interval == 0:
            self._push()

    def _complete(self, slices: Iterator[None]) -> bool:
        """Update, unless the end cannot wait for it: then the algorithm is what it was before, and False returned."""
        service, clock = self._service, self._service.clock
        before, give_up_ns = self._algorithm.state_dict(), None
        for _ in slices:
            if service.finished is not None and give_up_ns is None:
                give_up_ns = clock.now_ns() + round(LAST_UPDATE_S * 1e9)
            if service.ends_early or (give_up_ns is not None and clock.now_ns() >= give_up_ns):
                self._algorithm.load_state_dict(before)
                logger.info("update %d is given up: the end does not wait for it", self._algorithm.updates + 1)
                return False
        return True

    def _wait_until(self, due_ns: int) -> None:
        """A slower computer would still be updating."""
        service, clock = self._service, self._service.clock
        while clock.now_ns() < due_ns and not service.stopping.is_set() and service.finished is None:
            with service.wake:
                clock.wait_until(due_ns, service.wake)

    def _push(self) -> None:
        # A learner without its predecessor's last version must not fall behind what the actor already has.
        known = int(self._service.peer_counter(topics.ACTOR, "policy_version"))
        self._policy_version = max(self._policy_version, known) + 1
        self._pusher.push(self._policy_version, self._encoded_policy(self._policy_version))

    def _encoded_policy(self, version: int) -> bytes:
        return self._algorithm.encoded_policy(version, self._config.weights_dtype)

    def _save(self) -> None:
        version = max(1, self._policy_version)
        self._checkpoints.write(version, self._encoded_policy(version), self._algorithm.state_dict())

    def _ask_checkpoint(self) -> str:
        self._checkpoint_asked.set()
        return "a checkpoint will be written after the running update"
