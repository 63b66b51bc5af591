"""Which transitions the learner gets, and how many minibatches of them."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from common.errors import ConfigError
from common.messages import Int64Array


class TransitionSource(Protocol):
    """What the sampler needs of a ring; :class:`common.frame_ring.RingView` has it."""

    def live_rows(self) -> tuple[int, int]: ...
    def valid_pairs(self, rows: Int64Array) -> npt.NDArray[np.bool_]: ...


class UpdateBudget:
    """How many updates the learner may do: the replay ratio times the transitions persisted since the minimum size.

    It grows with what is persisted, so it pauses whenever the robot does not act, as in resets. What a slow learner
    leaves unspent is kept up to a cap: it must not race through hours of debt later.
    """

    def __init__(self, replay_ratio: float, min_size_to_sample: int, max_surplus: float, persisted: int = 0) -> None:
        """Start with nothing owed.

        Args:
            replay_ratio: updates per transition.
            min_size_to_sample: the transition with this count is the first that earns updates.
            max_surplus: updates that may be owed at once, at least 1.
            persisted: transitions that are already in the ring; they earn nothing.

        Raises:
            ConfigError: a value is out of range.
        """
        if not (np.isfinite(replay_ratio) and replay_ratio >= 0):
            raise ConfigError(f"replay_ratio: expected a finite number of at least 0, got {replay_ratio}")
        if min_size_to_sample < 1:
            raise ConfigError(f"min_size_to_sample: expected at least 1, got {min_size_to_sample}")
        if not max_surplus >= 1:
            raise ConfigError(f"max_surplus: expected at least 1, got {max_surplus}")
        self._replay_ratio = replay_ratio
        self._min_size_to_sample = min_size_to_sample
        self._max_surplus = max_surplus
        self._persisted = persisted
        # Products of counts rather than a running sum, so that ten times a ratio of 0.1 is one update.
        self._base = 0.0
        self._earning = 0
        self._spent = 0

    @property
    def owed(self) -> float:
        """Updates earned and not spent, between 0 and the cap."""
        return max(0.0, self._base + self._replay_ratio * self._earning - self._spent)

    def add(self, transitions: int = 1) -> None:
        """Count transitions that were just persisted: rows that end a pair, not rows."""
        before = max(self._persisted, self._min_size_to_sample - 1)
        self._persisted += transitions
        self._earning += max(0, self._persisted - before)
        if self.owed > self._max_surplus:
            self._base, self._earning, self._spent = self._max_surplus, 0, 0

    def spend(self) -> bool:
        """Take one update out of the budget; False, and nothing happens, if less than one is owed."""
        if self.owed < 1.0:
            return False
        self._spent += 1
        return True


class TransitionSampler:
    """Draws transitions uniformly, with replacement, from those that are live."""

    ROUNDS = 4
    """Rounds of drawing rows at random; where so few of them end a transition, all are listed instead."""

    def __init__(self, rng: np.random.Generator) -> None:
        """Use a random generator."""
        self._rng = rng

    def sample(self, source: TransitionSource, batch_size: int) -> Int64Array | None:
        """Return (batch_size,) numbers of transitions' second rows; None if there is no transition."""
        first, end = source.live_rows()
        first += 1  # the row before must be there too
        if first >= end:
            return None
        rows = np.empty(0, np.int64)
        for _ in range(self.ROUNDS):
            drawn = self._rng.integers(first, end, size=batch_size)
            rows = np.concatenate([rows, drawn[source.valid_pairs(drawn)]])
            if len(rows) >= batch_size:
                return rows[:batch_size]
        every = np.arange(first, end)
        every = every[source.valid_pairs(every)]
        if not len(every):
            return None
        return np.concatenate([rows, self._rng.choice(every, size=batch_size - len(rows))])
