"""From the steps at which one run reached goals to its learning curve and its final performance.

An episode of a minimum-time task costs 1 a step, resets included (thesis 6.1), so its return is minus its length and
the steps at which goals were reached tell everything.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from deploy.episodes import GOAL_WINDOW_STEPS

FloatArray = npt.NDArray[np.float64]

POINTS_A_WINDOW = 5


def curve_steps(steps: int, window: int) -> FloatArray:
    """(n,) steps of a run at which its curve is given: five a window, from its first whole one to its end."""
    spacing = max(1, window // POINTS_A_WINDOW)
    return np.arange(steps, min(window, steps) - 1, -spacing, dtype=np.float64)[::-1]


def return_curve(goal_steps: Sequence[int], at: FloatArray, window: int) -> FloatArray:
    """Mean return of the episodes that ended in the ``window`` steps up to each of ``at``.

    Where none did, it is the return of the unfinished episode so far: minus the steps since the last goal. That is
    more than the episode's return will be, and at most minus the window: a run without goals is neither left out nor
    does it look good.

    Args:
        goal_steps: ascending.
        at: (n,) steps of the run.
        window: steps.
    """
    ends = np.asarray(goal_steps, dtype=np.float64)
    returns = -np.diff(ends, prepend=0.0)
    sums = np.concatenate([[0.0], np.cumsum(returns)])
    last = np.searchsorted(ends, at, side="right")
    first = np.searchsorted(ends, at - window, side="right")
    counts = last - first
    since = at - np.concatenate([[0.0], ends])[last]
    curve: FloatArray = np.where(counts > 0, (sums[last] - sums[first]) / np.maximum(counts, 1), -since)
    return curve


def final_steps_per_goal(goal_steps: Sequence[int], steps: int, window: int = GOAL_WINDOW_STEPS) -> float:
    """Steps per goal over a run's last ``window`` steps, resets included.

    A run without a goal in them counts as worse than any with one: with the steps since its last goal, or since its
    beginning if it never reached one; both are at least ``window``.
    """
    width = min(window, steps)
    goals = goals_within(goal_steps, steps, window)
    if goals:
        return width / goals
    return float(steps - (goal_steps[-1] if goal_steps else 0))


def goals_within(goal_steps: Sequence[int], steps: int, window: int = GOAL_WINDOW_STEPS) -> int:
    """Goals reached in a run's last ``window`` steps."""
    return sum(steps - window < at <= steps for at in goal_steps)
