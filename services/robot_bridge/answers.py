"""Actions in: which TimeStep each one answers, whether it is late, and how old it was when it was applied."""

from __future__ import annotations

import logging
from collections.abc import Iterator

from common import topics
from common.inbox import Arrived, Inbox
from common.messages import Action, TaskSpec, TimeStep
from common.service import Service
from services.robot_bridge.action_age import PublishedStep, age_parts_us
from services.robot_bridge.bookkeeping import CycleCounts

logger = logging.getLogger(__name__)

REMEMBERED_STEPS = 256
"""An action that answers an older TimeStep than this is not even counted as late."""
RECORDED_ACTIONS = 1_000_000
"""Rows of ``actions.csv`` that one bridge writes at most: eleven hours at 40 ms a cycle, about 90 MB."""


class Answers:
    """Matches actions with the TimeSteps of this incarnation."""

    def __init__(self, service: Service, spec: TaskSpec, counts: CycleCounts) -> None:
        self._service, self._counts = service, counts
        self._inbox = Inbox(
            service.transport,
            topics.ACTION,
            Action,
            service.wake,
            service.clock,
            service.refusals,
            dimensions=spec.dimensions,
            capacity=16,
        )
        self._published: dict[int, PublishedStep] = {}
        self._captured_ns: int | None = None
        # In lockstep the world, and with it the camera, has a time of its own.
        self._cameras_go_by_the_clock = spec.has_camera and spec.pacing == "realtime"
        self._recorded = 0
        self._actor_incarnation = 0

    def __bool__(self) -> bool:
        """True if an action is waiting."""
        return bool(self._inbox)

    def expect(self, time_step: TimeStep, sent_ns: int) -> None:
        """A TimeStep was given to the network: it may be answered, unless it ends its attempt."""
        if self._cameras_go_by_the_clock and len(time_step.frame_capture_ns):
            self._captured_ns = int(time_step.frame_capture_ns[-1])
        if not time_step.is_last:
            self._published[time_step.seq] = PublishedStep(time_step.published_ns, sent_ns, self._captured_ns)
        self._published.pop(time_step.seq - REMEMBERED_STEPS, None)

    def end_cycle(self, seq: int, now_ns: int) -> None:
        """The cycle that TimeStep ``seq`` began has ended: answers from now on are late."""
        self._published[seq].end_ns = now_ns

    def take(self) -> Iterator[tuple[Arrived[Action], PublishedStep]]:
        """Actions of the newest actor that have come, each with what it answers."""
        for arrived in self._inbox.take():
            step = self._find(arrived.message)
            if step is None:
                self._counts.refused_actions += 1
                continue
            yield arrived, step

    def _find(self, action: Action) -> PublishedStep | None:
        """The answered TimeStep; None for an earlier bridge's, one too old to know, and for a superseded actor."""
        step = self._published.get(action.answered_seq)
        if step is None or action.incarnation != self._service.incarnation:
            return None
        if action.actor_incarnation < self._actor_incarnation:
            return None
        self._actor_incarnation = action.actor_incarnation
        return step

    def record(self, arrived: Arrived[Action], step: PublishedStep, applied_ns: int | None) -> None:
        """Note the first answer to a TimeStep; ``applied_ns`` is None if it was not applied."""
        if step.answered:
            return
        step.answered = True
        late = step.end_ns is not None and arrived.at_ns > step.end_ns
        self._counts.late_actions += late
        self._recorded += 1
        if self._recorded > RECORDED_ACTIONS:
            if self._recorded == RECORDED_ACTIONS + 1:
                logger.warning("actions.csv has %d rows of this bridge: no more are added", RECORDED_ACTIONS)
            return
        self._service.record.row(
            "actions",
            {
                "incarnation": arrived.message.incarnation,
                "answered_seq": arrived.message.answered_seq,
                "published_ns": step.published_ns,
                "arrived_ns": arrived.at_ns,
                "late": int(late),
                **age_parts_us(step, arrived, applied_ns),
            },
        )
