"""Actions in: which TimeStep each one answers, whether it is late, and whether it may still be applied."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from common import topics
from common.inbox import Arrived, Inbox
from common.messages import Action, TaskSpec, TimeStep
from common.service import Service
from services.robot_bridge.bookkeeping import CycleCounts

REMEMBERED_STEPS = 256
"""An action that answers an older TimeStep than this is not even counted as late."""


@dataclass
class PublishedStep:
    """When a TimeStep was published, when the cycle that it began ended, and whether an answer has come."""

    published_ns: int
    end_ns: int | None = None
    answered: bool = False


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
        self._actor_incarnation = 0

    def __bool__(self) -> bool:
        """True if an action is waiting."""
        return bool(self._inbox)

    def expect(self, time_step: TimeStep) -> None:
        """A TimeStep was published: it may be answered, unless it ends its attempt."""
        if not time_step.is_last:
            self._published[time_step.seq] = PublishedStep(time_step.published_ns)
        self._published.pop(time_step.seq - REMEMBERED_STEPS, None)

    def end_cycle(self, seq: int, now_ns: int) -> None:
        """The cycle that TimeStep ``seq`` began has ended: answers from now on are late."""
        self._published[seq].end_ns = now_ns

    def take(self) -> Iterator[tuple[Arrived[Action], int]]:
        """Actions of the newest actor that have come, each with the time when what it answers was published."""
        for arrived in self._inbox.take():
            step = self._find(arrived.message)
            if step is None:
                self._counts.refused_actions += 1
                continue
            if not step.answered:
                self._record(step, arrived)
            yield arrived, step.published_ns

    def _find(self, action: Action) -> PublishedStep | None:
        """The answered TimeStep; None for an earlier bridge's, one too old to know, and for a superseded actor."""
        step = self._published.get(action.answered_seq)
        if step is None or action.incarnation != self._service.incarnation:
            return None
        if action.actor_incarnation < self._actor_incarnation:
            return None
        self._actor_incarnation = action.actor_incarnation
        return step

    def _record(self, step: PublishedStep, arrived: Arrived[Action]) -> None:
        step.answered = True
        late = step.end_ns is not None and arrived.at_ns > step.end_ns
        self._counts.late_actions += late
        self._service.record.row(
            "actions",
            {
                "incarnation": arrived.message.incarnation,
                "answered_seq": arrived.message.answered_seq,
                "published_ns": step.published_ns,
                "arrived_ns": arrived.at_ns,
                "late": int(late),
            },
        )
