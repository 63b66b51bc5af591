"""Replay: keeps experience in the ring, acknowledges what is kept, and gives out minibatches on credit.

::

    Experience ─▶ in order, once ─▶ ring ─▶ Acknowledgement
                                     │
                      Credit ─▶ store ─▶ Minibatch
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from common import topics
from common.algorithms.config import AlgorithmConfig
from common.codec import encode
from common.errors import MessageError
from common.frame_ring import RING_FILE, RingWriter
from common.inbox import Inbox
from common.journal import OrderedReceiver
from common.messages import Credit, Experience, StreamHead, TaskSpec
from common.service import Service
from services.replay.config import ReplaySettings
from services.replay.minibatch_senders import ArraySender, MinibatchSender, RowSender
from services.replay.store_table import open_store

logger = logging.getLogger(__name__)

ACKNOWLEDGE_S = 0.1
"""Period of the acknowledgement to the actor."""
ACTOR_LOST_AFTER_S = 5.0
"""At the end, what an actor still owes is waited for this long: it may be behind a network outage."""


class Replay:
    """Owns the experience ring; the only one who writes it."""

    def __init__(self, service: Service, spec: TaskSpec, algorithm: AlgorithmConfig, settings: ReplaySettings) -> None:
        self._service, self._settings = service, settings
        self._ring = RingWriter.create_or_reopen(
            Path(service.run.directory) / RING_FILE,
            spec,
            algorithm.replay_capacity,
            settings.frames_per_row,
            algorithm.pending_actions,
        )
        self._persisted = self._ring.persisted_counts()
        self._transitions = self._ring.transitions_appended
        self._store = open_store(
            algorithm,
            self._ring,
            max_surplus=settings.max_surplus,
            rng=np.random.default_rng([service.run.seed, service.incarnation]),
            learner_version=lambda: int(service.peer_counter(topics.LEARNER, "policy_version")),
        )
        self._receiver: OrderedReceiver[Experience] = OrderedReceiver()
        self._experiences = [
            self._inbox(topic, Experience, dimensions=spec.dimensions, capacity=1024)
            for topic in (topics.EXPERIENCE, topics.EXPERIENCE_RESENT)
        ]
        self._heads = self._inbox(topics.EXPERIENCE_HEAD, StreamHead)
        self._credits = self._inbox(topics.CREDIT, Credit)
        self._ack_publisher = service.transport.publisher(topics.EXPERIENCE_ACK)
        # In lockstep the actor goes by what is owed: it must not hear of it a hundred steps later.
        self._ack_period_ns = 0 if spec.pacing == "lockstep" else round(ACKNOWLEDGE_S * 1e9)
        self._next_ack_ns = 0
        self._minibatches: MinibatchSender = (
            RowSender(service)
            if settings.access == "map"
            else ArraySender(service, self._ring, round(settings.message_mib * 2**20))
        )
        self._credit = Credit(0, 0, 0)
        self._sent = 0
        self._sent_once = 0
        self._sent_total = 0
        self._produced_seen: dict[int, int] = {}
        self._copies_refused = 0
        if self._ring.rows_appended:
            logger.info("the ring already holds %d experiences: going on", self._ring.rows_appended)
        service.counters = self.counters
        service.details = self.details
        service.serve_commands({})

    def run(self) -> None:
        """Serve actor and learner until the run is finished and nothing is on its way any more."""
        service = self._service
        service.state = "running"
        try:
            while not service.stopping.is_set() and service.finished is None:
                with service.wake:
                    if not self._has_work():
                        service.clock.wait(service.wake, ACKNOWLEDGE_S)
                self.step()
            service.drain(self._is_drained, self._keep)
        finally:
            self._minibatches.stop()
            self._ring.close()

    def step(self) -> None:
        """Handle all that has come."""
        self._take_experience()
        self._serve_credit()
        self._acknowledge()

    def counters(self) -> dict[str, float]:
        """Counts for the heartbeat and the record."""
        return {
            "rows": sum(list(self._persisted.values())),
            "transitions": self._transitions,
            "minibatches": self._sent_total,
            **self._store.counters(),
            "lost": self._receiver.lost,
            "duplicates": self._receiver.duplicates + self._copies_refused,
        }

    def details(self) -> dict[str, Any]:
        """What of each bridge incarnation's TimeSteps has been persisted, and what is known to have existed."""
        return {
            "persisted": {str(name): count for name, count in list(self._persisted.items())},
            "produced_seen": {str(name): count for name, count in list(self._produced_seen.items())},
        }

    def _inbox(self, topic: topics.Topic, expected: Any, **options: Any) -> Inbox[Any]:
        service = self._service
        return Inbox(service.transport, topic, expected, service.wake, service.clock, service.refusals, **options)

    def _has_work(self) -> bool:
        return any([*self._experiences, self._heads, self._credits])

    # ------------------------------------------------------------------ experience

    def _keep(self) -> None:
        self._take_experience()
        self._acknowledge()

    def _take_experience(self) -> None:
        for inbox in self._experiences:
            for experience, _ in inbox.take():
                self._receiver.accept(experience.actor_incarnation, experience.seq, experience)
        for head, _ in self._heads.take():
            self._receiver.note_head(head)
        for experience in self._receiver.take_ready():
            self._append(experience)

    def _acknowledge(self) -> None:
        now_ns = self._service.clock.now_ns()
        if now_ns >= self._next_ack_ns and (ack := self._receiver.acknowledgement(self._store.owed)):
            self._next_ack_ns = now_ns + self._ack_period_ns
            self._ack_publisher.put(encode(ack))

    def _append(self, experience: Experience) -> None:
        step = experience.time_step
        seen = self._produced_seen.get(step.incarnation, 0)
        self._produced_seen[step.incarnation] = max(seen, step.seq + 1)
        if self._ring.contains(step.incarnation, step.seq):
            # A restarted actor sends again what its predecessor had sent and not yet told the bridge.
            self._copies_refused += 1
            return
        try:
            row = self._ring.append(experience)
        except MessageError as error:
            self._service.refusals.refuse(topics.EXPERIENCE.name, error)
            return
        self._persisted[step.incarnation] = self._persisted.get(step.incarnation, 0) + 1
        self._transitions = self._ring.transitions_appended
        self._store.note_row(row)

    # ------------------------------------------------------------------ minibatches

    def _serve_credit(self) -> None:
        if arrived := self._credits.take_newest():
            self._take_credit(arrived.message)
        while self._sent < self._credit.want_total and self._send_minibatch():
            pass

    def _take_credit(self, credit: Credit) -> None:
        if credit.learner_incarnation < self._credit.learner_incarnation:
            return
        if credit.learner_incarnation > self._credit.learner_incarnation:
            logger.info("a learner has joined")
            self._sent = self._sent_once = credit.received_total
            self._minibatches.forget()
            self._store.note_new_learner()
        elif credit.received_total < self._sent and self._minibatches.quiet_s() > self._minibatches.lost_after_s:
            self._sent = credit.received_total
        self._credit = credit

    def _send_minibatch(self) -> bool:
        again = self._sent < self._sent_once
        rows = self._store.next_rows(again=again)
        if rows is None or not self._minibatches.send(rows, self._credit.learner_incarnation, self._sent):
            return False
        self._store.note_sent(again=again)
        self._sent += 1
        self._sent_once = max(self._sent_once, self._sent)
        self._sent_total += 1
        return True

    def _is_drained(self) -> bool:
        finished = self._service.finished
        if finished is None:
            return True
        if self._persisted.get(finished.incarnation, 0) >= finished.produced:
            return True
        # Something is missing that will not come: the actor has nothing more, or is gone for good.
        drained = self._service.peer_state(topics.ACTOR) == "drained" and self._receiver.received_all
        return drained or self._service.peer_age_s(topics.ACTOR) > ACTOR_LOST_AFTER_S
