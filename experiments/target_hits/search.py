"""How few steps it takes to reach the goal from one start: a search over plans.

The guideline wants time limits that exceed the minimum steps to the goal, before anything is learned. A simulated
task can be put back to the same start as often as one likes, so plans (a command for each step, decided beforehand)
can be tried: each that reaches the goal proves that it can be reached in so many steps. The search therefore never
promises too little: the true minimum is at most what it finds.

Two kinds of tries take turns, so that each gets half of the steps.

*Fresh* plans hold each component of the command for random times. In half of the plans it is at its bounds, since the
fastest way to a state is to command the bounds (Pontryagin's principle, for forces, torques and accelerations); in
the others it is what the initial policy draws, so that a plan that holds nothing is the initial policy. How long a
plan has to be is unknown, so lengths follow Luby's sequence, which is within a logarithmic factor of the best fixed
length whatever that is (Luby, Sinclair and Zuckerman, Optimal speedup of Las Vegas algorithms, Information Processing
Letters 47, 1993).

*Changed* plans are the best one with a few things different: something left out, held longer, moved or varied. One
that is as fast as the best replaces it, which lets the search drift along plans of equal length to where a shorter
one is near.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.errors import RelodError
from common.messages import Float32Array, TaskSpec
from experiments.target_hits.world import World

EFFORT = 100_000
"""Most steps that are simulated from one start."""
PATIENCE = 5
"""The search does not end before it has taken so many times the effort that its last improvement had taken, """
TRIES_IN_VAIN = 1_000
"""nor before it has tried so many plans of the best one's length in vain."""
SHORTEST_TRY = 8
"""Steps of the shortest fresh plan."""
_MOST_CHANGES = 3
_SMALLEST_VARIATION = 0.01
"""Of a command, as a share of half of its range."""


class NotRepeatableError(RelodError):
    """A task does not repeat itself from the same random numbers."""


@dataclass(frozen=True)
class Way:
    """What the search has found from one start."""

    steps: int | None
    """Steps of the shortest plan found that reaches the goal; None: none does."""
    effort: int
    """Steps simulated."""


def luby(index: int) -> int:
    """Term ``index``, from 1 on, of 1 1 2 1 1 2 4 1 1 2 1 1 2 4 8 ..."""
    while True:
        power = index.bit_length()
        if index == (1 << power) - 1:
            return 1 << (power - 1)
        index -= (1 << (power - 1)) - 1


def shortest_way(world: World, restart: Callable[[], None], rng: np.random.Generator, most_effort: int = EFFORT) -> Way:
    """Search for the shortest plan from a start.

    Args:
        world: the task.
        restart: puts it to the start, the same each time.
        rng: of the plans.
        most_effort: steps to simulate at most.

    Raises:
        NotRepeatableError: the shortest plan, tried again, does something else.
    """
    plans = _Plans(world.spec, rng)
    best: Float32Array | None = None
    spent_fresh = spent_changed = tries = 0
    enough = most_effort
    while (spent := spent_fresh + spent_changed) < most_effort:
        if best is not None and (len(best) == 1 or spent >= enough):
            break
        fresh = best is None or spent_fresh <= spent_changed
        if fresh:
            tries += 1
            length = SHORTEST_TRY * luby(tries)
            plan = plans.fresh(length if best is None else min(length, len(best) - 1))
        else:
            assert best is not None
            plan = plans.changed(best)
        plan = plan[: most_effort - spent]
        restart()
        reached = _follow(world, plan)
        taken = len(plan) if reached is None else reached
        spent_fresh, spent_changed = spent_fresh + taken * fresh, spent_changed + taken * (not fresh)
        if reached is not None:
            if best is None or reached < len(best):
                enough = max(PATIENCE * (spent + taken), spent + taken + TRIES_IN_VAIN * reached)
            best = plan[:reached]
    if best is not None:
        restart()
        if _follow(world, best) != len(best):
            raise NotRepeatableError(
                f"task {world.spec.task} does not repeat itself from the same start and random numbers, so its "
                "minimum steps cannot be searched for; all its randomness has to come from the generator it is given"
            )
    return Way(None if best is None else len(best), spent_fresh + spent_changed)


def _follow(world: World, plan: Float32Array) -> int | None:
    """Steps after which the goal was reached; None: not by this plan."""
    reaches_goal = world.reaches_goal
    for number, action in enumerate(plan, start=1):
        if reaches_goal(action):
            return number
    return None


class _Plans:
    """Draws plans: arrays (steps, A), physical units. Inside, the bounds are -1 and 1."""

    def __init__(self, spec: TaskSpec, rng: np.random.Generator) -> None:
        self._size, self._rng = len(spec.action_low), rng
        self._centre = (spec.action_high.astype(np.float64) + spec.action_low) / 2
        self._half_width = (spec.action_high.astype(np.float64) - spec.action_low) / 2

    def fresh(self, steps: int) -> Float32Array:
        return self._physical(self._held(steps))

    def changed(self, plan: Float32Array) -> Float32Array:
        """A plan of the same length."""
        unit = (plan - self._centre) / self._half_width
        for _ in range(int(self._rng.integers(1, _MOST_CHANGES + 1))):
            self._change(unit)
        return self._physical(unit)

    def _held(self, steps: int) -> np.ndarray:
        """Each component changes at random times, on average every so often that it could be any time scale."""
        rng = self._rng
        hold = np.exp(rng.uniform(0.0, np.log(steps + 1)))
        at_bounds = rng.random() < 0.5
        unit = np.empty((steps, self._size))
        for component in range(self._size):
            changes = rng.random(steps) < 1 / hold
            piece = np.cumsum(changes)
            unit[:, component] = self._values(int(piece[-1]) + 1, at_bounds)[piece]
        return unit

    def _values(self, count: int, at_bounds: bool) -> np.ndarray:
        if at_bounds:
            return np.where(self._rng.random(count) < 0.5, -1.0, 1.0)
        return np.tanh(self._rng.standard_normal(count))

    def _change(self, unit: np.ndarray) -> None:
        """Change a stretch of the plan in place, for one component of the command or for all."""
        rng, length = self._rng, len(unit)
        begin = int(rng.integers(length))
        steps = min(int(np.exp(rng.uniform(0.0, np.log(length + 1)))), length - begin)
        one = int(rng.integers(self._size))
        columns = slice(None) if rng.random() < 0.5 else slice(one, one + 1)
        stretch = unit[begin : begin + steps, columns]
        match int(rng.integers(5)):
            case 0:  # leave it out, and hold a command elsewhere for as long
                rest = np.delete(unit[:, columns], slice(begin, begin + steps), axis=0)
                if len(rest):
                    at = int(rng.integers(len(rest) + 1))
                    held = np.repeat(rest[max(at - 1, 0)][None], steps, axis=0)
                    unit[:, columns] = np.insert(rest, at, held, axis=0)
            case 1:  # one command for all of it
                stretch[:] = self._values(stretch.shape[1], at_bounds=rng.random() < 0.5)
            case 2:  # something new
                stretch[:] = self._held(steps)[:, columns]
            case 3:  # a little more or less of everything
                size = np.exp(rng.uniform(np.log(_SMALLEST_VARIATION), 0.0))
                stretch[:] = np.clip(stretch + size * rng.standard_normal(stretch.shape[1]), -1.0, 1.0)
            case _:  # one step of it, at another time
                moved = unit[begin, columns].copy()
                rest = np.delete(unit[:, columns], begin, axis=0)
                unit[:, columns] = np.insert(rest, int(rng.integers(length)), moved, axis=0)

    def _physical(self, unit: np.ndarray) -> Float32Array:
        plan: Float32Array = (self._centre + self._half_width * unit).astype(np.float32)
        return plan
