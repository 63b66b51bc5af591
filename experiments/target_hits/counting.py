"""Target hits of the initial policy: how difficult a minimum-time task is (thesis 6.2, figures 7.2 and 8.4)."""

from __future__ import annotations

from collections.abc import Iterator

from common.messages import Float32Array
from experiments.target_hits.world import World

STEPS = 20_000
"""Steps in which hits are counted, resets included."""


def count_hits(world: World, actions: Iterator[Float32Array], limit: int, steps: int = STEPS) -> int:
    """Count how often the goal is reached within ``steps``.

    An attempt that has not reached the goal after ``limit`` steps is reset, which takes ``reset_steps`` more of the
    steps; the goal stays. Where it is reached, the next episode begins at no cost.

    Args:
        world: the task, just built.
        actions: what to do, one a step.
        limit: time limit, steps.
        steps: to count in.
    """
    reaches_goal, reset_steps = world.reaches_goal, world.spec.reset_steps
    used = hits = attempt_steps = 0
    world.begin_episode()
    while used < steps:
        used += 1
        attempt_steps += 1
        if reaches_goal(next(actions)):
            hits += 1
            attempt_steps = 0
            world.begin_episode()
        elif attempt_steps == limit:
            used += reset_steps
            attempt_steps = 0
            world.begin_attempt()
    return hits


def acted_share(limit: int, reset_steps: int) -> float:
    """Share of the steps in which the robot acts if it never reaches the goal; the rest are resets."""
    return limit / (limit + reset_steps)
