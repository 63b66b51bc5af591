"""Episodes, attempts and steps (thesis 6.1), as arithmetic: no clock, no network, no task."""

from __future__ import annotations

from dataclasses import dataclass, replace

from common.messages import TaskSpec

STEP_REWARD_IN_RESET = -1.0
"""A step of a reset costs what every step of a minimum-time task costs."""


@dataclass(frozen=True)
class EpisodeResult:
    """A completed episode: goal to goal, or reset to reset for a task without goal."""

    episode: int
    undiscounted_return: float
    """Sum of rewards, resets included at -1 a step."""
    length: int
    """Action cycles, resets included."""
    attempts: int
    """Attempts with at least one action cycle."""
    steps: int
    """Action cycles of the run when the episode ended, resets included."""
    acted_steps: int
    """The same without resets."""


@dataclass(frozen=True)
class Totals:
    """What a run has counted so far; a restarted bridge goes on from here."""

    steps: int = 0
    acted_steps: int = 0
    episodes: int = 0
    """Completed episodes."""
    attempts: int = 0
    """Attempts begun."""


@dataclass
class CycleCounts:
    """How the action cycles of one incarnation went."""

    cycles: int = 0
    overruns: int = 0
    """Cycles that ended too late for the bridge's own reasons."""
    overruns_after_1000: int = 0
    skipped_cycles: int = 0
    """Whole cycles that passed unnoticed."""
    late_actions: int = 0
    """Actions that arrived after the end of the cycle they answer."""
    unanswered: int = 0
    """Cycles that ended without an action of their own."""
    refused_actions: int = 0
    """Actions that were not applied."""
    produced: int = 0
    """TimeSteps published."""


class Ledger:
    """Counts action cycles into attempts and episodes.

    An episode ends only at the goal. A time limit, or a stalled camera, calls a reset that takes ``reset_steps``
    cycles; they count into the episode's length and return and into the run's steps, never into a transition. A task
    without goal has one attempt per episode, and its resets count into the run's steps only.
    """

    def __init__(self, spec: TaskSpec, totals: Totals | None = None) -> None:
        self._spec = spec
        self.totals = totals or Totals()
        self.episode = self.totals.episodes
        """Number of the running attempt's episode; the TimeStep that ends an episode still belongs to it."""
        self.step_index = 0
        """Action cycles since the attempt began."""
        self._return = 0.0
        self._length = 0
        self._attempts = 0

    @property
    def attempt(self) -> int:
        """Number of the running attempt."""
        return self.totals.attempts - 1

    def begin_attempt(self) -> None:
        """Start to count a new attempt."""
        self.totals = replace(self.totals, attempts=self.totals.attempts + 1)
        self.episode = self.totals.episodes
        self.step_index = 0

    def end_cycle(self, reward: float, terminated: bool, cut_short: bool = False) -> tuple[bool, EpisodeResult | None]:
        """Count one action cycle; return whether the attempt is truncated, and the ended episode.

        The time limit truncates an attempt, or ``cut_short`` does: it cannot go on, for another reason than the goal.
        """
        self._attempts += self.step_index == 0
        self.step_index += 1
        self._count(reward, acted=True)
        truncated = not terminated and (cut_short or self.step_index >= self._spec.time_limit_steps)
        ended = terminated or (truncated and not self._spec.has_goal)
        return truncated, self._end_episode() if ended else None

    def end_reset_cycle(self) -> None:
        """Count one action cycle of a reset."""
        if self._spec.has_goal:
            self._count(STEP_REWARD_IN_RESET, acted=False)
        else:
            self.totals = replace(self.totals, steps=self.totals.steps + 1)

    def _count(self, reward: float, acted: bool) -> None:
        self._return += reward
        self._length += 1
        self.totals = replace(
            self.totals, steps=self.totals.steps + 1, acted_steps=self.totals.acted_steps + int(acted)
        )

    def _end_episode(self) -> EpisodeResult:
        result = EpisodeResult(
            episode=self.totals.episodes,
            undiscounted_return=self._return,
            length=self._length,
            attempts=self._attempts,
            steps=self.totals.steps,
            acted_steps=self.totals.acted_steps,
        )
        self.totals = replace(self.totals, episodes=self.totals.episodes + 1)
        self._return, self._length, self._attempts = 0.0, 0, 0
        return result
