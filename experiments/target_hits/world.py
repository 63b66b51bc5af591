"""A task in lockstep, reduced to what counting and searching need: start, act, reached or not."""

from __future__ import annotations

from common.errors import RelodError
from common.messages import Float32Array
from services.robot_bridge.tasks import Task

REWARD = -1.0
"""Of each step (thesis 6.1). The hits and the guideline are about nothing else."""


class NotMinimumTimeError(RelodError):
    """A task gives another reward than :data:`REWARD`."""


class World:
    """Drives a task by one action cycle a step. The sensors are never read: only what judges by images renders any."""

    def __init__(self, task: Task) -> None:
        self.spec = task.spec
        self._command, self._advance_to, self._outcome = task.command, task.advance_to, task.outcome
        self._task = task
        self._cycle_ns = round(task.spec.action_cycle_time_s * 1e9)
        self._now_ns = 0
        task.advance_to(0)

    def begin_episode(self) -> None:
        """Draw a new goal and a new start."""
        self._task.begin_episode()

    def begin_attempt(self) -> None:
        """Keep the goal, draw a new start.

        The world does not move during a reset: the start is drawn anew, whatever was before it. Whoever counts steps
        adds the reset's.
        """
        self._task.begin_attempt()

    def reaches_goal(self, action: Float32Array) -> bool:
        """Act for one cycle; return whether the goal is reached at its end.

        Raises:
            NotMinimumTimeError: the reward is not that of a minimum-time task.
        """
        self._command(action)
        self._now_ns += self._cycle_ns
        self._advance_to(self._now_ns)
        outcome = self._outcome()
        if outcome.reward != REWARD:  # NaN is not, either.
            raise NotMinimumTimeError(
                f"task {self.spec.task} gave a reward of {outcome.reward} in step {self._now_ns // self._cycle_ns}"
                f"{', which reached the goal' if outcome.terminated else ''}: expected {REWARD:g} in every step, that "
                "which reaches the goal as well; of any other reward, target hits and the guideline for the time "
                "limit say nothing"
            )
        return outcome.terminated
