"""The actor: answers the newest observation at once, and sends experience on to replay.

::

    TimeStep ─▶ newest? ─▶ observation ─▶ policy ─▶ Action          (this loop)
        └────▶ in order, once, with extras ─▶ Experience            (services.actor.forwarding)
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from common import topics
from common.codec import encode
from common.errors import MessageError
from common.frame_stack import FrameStack, Stack
from common.inbox import Arrived, Inbox
from common.messages import Action, PolicyExtras, TaskSpec, TimeStep, UInt8Array
from common.pending_actions import PendingActions, observed_spec
from common.policies.base import ChosenAction, Observation, Policy
from common.service import Service
from services.actor.config import ActorSettings
from services.actor.forwarding import ExperienceForwarder
from services.actor.weights import PolicySwap

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Computed:
    """An action that may not be answered with yet: a slower computer would still be computing it."""

    arrived: Arrived[TimeStep]
    chosen: ChosenAction
    policy_version: int
    began_ns: int
    due_ns: int


class Actor:
    """Acts with the newest policy on the newest observation until the run is finished."""

    def __init__(
        self,
        service: Service,
        spec: TaskSpec,
        initial: Policy,
        settings: ActorSettings,
        *,
        pending_actions: int = 0,
    ) -> None:
        """Args:
        service: the process's.
        spec: the task, as the bridge tells it.
        initial: what acts until a policy comes.
        settings: of the actor.
        pending_actions: of the algorithm.
        """
        self._service, self._spec, self._settings = service, spec, settings
        self._rng = np.random.default_rng([service.run.seed, service.incarnation])
        self._forwarder = ExperienceForwarder(service, settings)
        self._swap = PolicySwap(service, observed_spec(spec, pending_actions), initial)
        self._action_publisher = service.transport.publisher(topics.ACTION)
        self._time_steps, self._resent = (
            Inbox(
                service.transport,
                topic,
                TimeStep,
                service.wake,
                service.clock,
                service.refusals,
                dimensions=spec.dimensions,
                capacity=1024,
            )
            for topic in (topics.TIME_STEP, topics.TIME_STEP_RESENT)
        )
        self._stack: FrameStack[UInt8Array] | None = FrameStack(spec.frame_stack) if spec.has_camera else None
        self._pending = PendingActions(pending_actions, spec.dimensions.A) if pending_actions else None
        self._newest: tuple[int, int] = (-1, -1)
        self._last_answer = b""
        self._unanswered: tuple[Arrived[TimeStep], Observation] | None = None
        self._computed: Computed | None = None
        self._actions = 0
        service.counters = self.counters
        service.serve_commands({})

    def run(self) -> None:
        """Act until the bridge says that the run is finished; then see everything off to replay."""
        service = self._service
        self._forwarder.start()
        self._swap.start()
        service.state = "running"
        try:
            while not service.stopping.is_set() and service.finished is None:
                with service.wake:
                    if not (self._time_steps or self._resent):
                        self._wait()
                self.take_time_steps()
            self._drain()
        finally:
            self._swap.stop()
            self._forwarder.stop()

    def take_time_steps(self) -> None:
        """Act on the newest TimeStep that has come; hand all of them on."""
        arrived = sorted(self._time_steps.take() + self._resent.take(), key=lambda a: _order(a.message))
        stack = None
        for item in arrived:
            stack = self._add_frames(item.message)
        if arrived:
            self._see(arrived[-1], stack)
        self._act()
        for item in arrived:
            self._forwarder.add(item.message)

    def counters(self) -> dict[str, float]:
        """Counts for the heartbeat and the record."""
        return {
            "actions": self._actions,
            "policy_version": self._swap.policy.version,
            "policies_received": self._swap.received,
            **self._forwarder.counters(),
        }

    def _add_frames(self, time_step: TimeStep) -> Stack[UInt8Array] | None:
        if self._stack is None or time_step.incarnation < self._newest[0]:
            return None  # A bridge's last words must not displace the frames of its successor.
        try:
            return self._stack.add(time_step, time_step.frame_ids.tolist(), list(time_step.pixels))
        except MessageError as error:
            self._service.refusals.refuse(topics.TIME_STEP.name, error)
            return None

    def _wait(self) -> None:
        """For the next message, or until a computed action is due; holds ``wake``."""
        service = self._service
        if self._computed:
            service.clock.wait_until(self._computed.due_ns, service.wake)
        else:
            service.clock.wait(service.wake, 0.1)

    def _see(self, newest: Arrived[TimeStep], stack: Stack[UInt8Array] | None) -> None:
        """Take note of what is to be answered next."""
        order = _order(newest.message)
        if order == self._newest and self._last_answer:
            # Published again: the bridge has not seen the answer.
            self._action_publisher.put(self._last_answer)
        if order <= self._newest:
            return
        self._newest, self._last_answer, self._unanswered = order, b"", None
        if newest.message.is_last or (stack is None and self._spec.has_camera):
            return
        frames = np.array(stack.frames) if stack else None
        proprioception = newest.message.proprioception
        if self._pending:
            proprioception = self._pending.observe(newest.message, proprioception)
        self._unanswered = newest, Observation(frames, proprioception, newest.message.action)

    def _act(self) -> None:
        """Answer with what has been computed, if it is due; only then compute the next action."""
        if self._computed and self._service.clock.now_ns() >= self._computed.due_ns:
            self._answer(self._computed)
            self._computed = None
        if self._unanswered is None or self._computed:
            return
        (arrived, observation), self._unanswered = self._unanswered, None
        if self._spec.pacing == "lockstep":
            self._wait_for_updates()
        policy, clock = self._swap.policy, self._service.clock
        began_ns = clock.now_ns()
        computed = Computed(
            arrived,
            policy.act(observation, self._rng),
            policy.version,
            began_ns,
            due_ns=began_ns + round(self._settings.min_inference_s * 1e9),
        )
        if clock.now_ns() >= computed.due_ns:
            self._answer(computed)
        else:
            self._computed = computed
        # Not only when it is sent: the next TimeStep may come before, and its Experience must know of it.
        self._remember(computed)

    def _answer(self, computed: Computed) -> None:
        time_step, chosen = computed.arrived.message, computed.chosen
        sent_ns = self._service.clock.now_ns()
        offset_ns, offset_bound_ns = self._service.bridge_offset(sent_ns)
        answer = encode(
            Action(
                actor_incarnation=self._service.incarnation,
                incarnation=time_step.incarnation,
                answered_seq=time_step.seq,
                action=chosen.action,
                log_probability=chosen.log_probability,
                policy_version=computed.policy_version,
                received_ns=computed.arrived.at_ns,
                began_ns=computed.began_ns,
                sent_ns=sent_ns,
                offset_ns=offset_ns,
                offset_bound_ns=offset_bound_ns,
            )
        )
        self._action_publisher.put(answer)
        self._actions += 1
        if _order(time_step) == self._newest:
            self._last_answer = answer

    def _remember(self, computed: Computed) -> None:
        time_step, chosen = computed.arrived.message, computed.chosen
        extras = PolicyExtras(chosen.action, chosen.log_probability, computed.policy_version)
        self._forwarder.remember_answer(time_step, extras)
        if self._pending:
            self._pending.note(time_step.incarnation, self._service.incarnation, time_step.seq, chosen.action)

    def _wait_for_updates(self) -> None:
        """In lockstep the world waits until the learner has spent the budget."""
        service = self._service
        while self._forwarder.updates_owed_at_most > self._settings.lockstep_surplus:
            if service.stopping.is_set() or service.finished is not None:
                return
            with service.wake:
                service.clock.wait(service.wake, 0.05)

    def _drain(self) -> None:
        finished = self._service.finished

        def is_drained() -> bool:
            return finished is None or self._forwarder.is_drained(finished.incarnation, finished.produced)

        self._service.drain(is_drained, self.take_time_steps)


def _order(time_step: TimeStep) -> tuple[int, int]:
    """A newer bridge's TimeSteps come after an older one's."""
    return time_step.incarnation, time_step.seq
