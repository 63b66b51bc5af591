"""A task in lockstep, reduced to what counting and searching need: start, act, reached or not."""

from __future__ import annotations

from common.messages import Float32Array
from services.robot_bridge.tasks import Task


class World:
    """Drives a task by one action cycle a step. The sensors are never read: no image is ever rendered."""

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
        """Act for one cycle; return whether the goal is reached at its end."""
        self._command(action)
        self._now_ns += self._cycle_ns
        self._advance_to(self._now_ns)
        return self._outcome().terminated
