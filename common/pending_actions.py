"""What a slow link hides from the policy: the actions it has chosen that may not have been applied yet.

With a delay of up to k action cycles an observation is not all that the next one depends on: the robot will still obey
what was chosen on the k observations before. The observation together with those k actions is Markov again
(Katsikopoulos and Engelbrecht, "Markov Decision Processes With Delays and Asynchronous Cost Collection", 2003, for
constant delays and, with k their maximum, for random ones; Ramstedt and Pal, "Real-Time Reinforcement Learning", 2019,
for k = 1).

So with ``algorithm.pending_actions = k`` the proprioception of a TimeStep, as policy and learner see it, ends with k
actions: what the policy chose on the TimeStep before, on the one before that, and so on; zeros where it chose nothing,
and before the attempt. Which of them have been applied is not asked: all that are on their way are among them.

The one rule is used by the actor, which knows its answers, and by replay, to which each Experience tells the answer to
the TimeStep before; so both see the same, and no message carries it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from common.frame_stack import StepIdentity
from common.messages import Float32Array, TaskSpec

_MEMORY = 16
"""TimeSteps remembered at least."""


def observed_spec(spec: TaskSpec, pending_actions: int) -> TaskSpec:
    """Return the task as policy and learner see it: the proprioception of ``spec``, then that many actions."""
    if not pending_actions:
        return spec
    return replace(
        spec,
        proprioception_low=np.concatenate([spec.proprioception_low, np.tile(spec.action_low, pending_actions)]),
        proprioception_high=np.concatenate([spec.proprioception_high, np.tile(spec.action_high, pending_actions)]),
    )


class PendingActions:
    """Remembers what an actor chose on the recent TimeSteps of a bridge incarnation."""

    def __init__(self, count: int, action_size: int) -> None:
        """Args:
        count: k, actions in an observation, at least 1.
        action_size: A.
        """
        if count < 1:
            raise ValueError(f"count: expected at least 1, got {count}")
        self._count = count
        self._nothing = np.zeros(action_size, np.float32)
        self._memory = max(_MEMORY, 2 * count)
        self._origin: tuple[int, int] | None = None
        self._chosen: dict[int, Float32Array] = {}

    def note(self, incarnation: int, actor_incarnation: int, seq: int, chosen: Float32Array | None) -> None:
        """Take note of what an actor chose on the TimeStep ``seq`` of a bridge; None: nothing.

        Another bridge has other TimeSteps, and another actor does not know what this one chose: either forgets all.
        """
        if self._origin != (incarnation, actor_incarnation):
            self._origin = incarnation, actor_incarnation
            self._chosen = {}
        self._chosen[seq] = self._nothing if chosen is None else chosen
        while len(self._chosen) > self._memory:
            del self._chosen[min(self._chosen)]

    def observe(self, step: StepIdentity, proprioception: Float32Array) -> Float32Array:
        """(P,) -> (P + k A,): the TimeStep's proprioception, then what was chosen before it, the newest first."""
        before = self._before(step)
        parts = [self._chosen.get(seq, self._nothing) for seq in before]
        parts += [self._nothing] * (self._count - len(before))
        return np.concatenate([proprioception, *parts])

    def is_certain(self, step: StepIdentity) -> bool:
        """True if :meth:`note` was told of all TimeSteps that :meth:`observe` asks for; who chose them knows anyway."""
        return all(seq in self._chosen for seq in self._before(step))

    def _before(self, step: StepIdentity) -> range:
        """The TimeSteps before ``step`` in its attempt, newest first, at most k."""
        if self._origin is None or step.incarnation != self._origin[0]:
            return range(0)
        return range(step.seq - 1, step.seq - 1 - min(self._count, step.step_index), -1)
