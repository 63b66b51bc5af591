"""What a comparison is held to, and whether the mean steps per goal of two configurations keep it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from experiments.intervals import Interval


class Bar(Protocol):
    """A claim about the means of two configurations, with their 95 % intervals."""

    def holds(self, mean: Interval, against: Interval) -> bool:
        """Whether the claim is true of these means."""

    def text(self) -> str:
        """What is claimed, for a table."""


@dataclass(frozen=True)
class AtMost:
    """The first mean is at most ``factor`` times the second."""

    factor: float

    def holds(self, mean: Interval, against: Interval) -> bool:
        return mean.mean <= self.factor * against.mean

    def text(self) -> str:
        return f"<= {self.factor:g}x"


@dataclass(frozen=True)
class Equivalent:
    """The means differ by at most ``share`` of the second one."""

    share: float

    def holds(self, mean: Interval, against: Interval) -> bool:
        return abs(mean.mean - against.mean) <= self.share * against.mean

    def text(self) -> str:
        return f"within {100 * self.share:g} %"


@dataclass(frozen=True)
class ClearlyAbove:
    """The first mean is above the second one, and their intervals do not touch."""

    def holds(self, mean: Interval, against: Interval) -> bool:
        return mean.low > against.high

    def text(self) -> str:
        return "above, intervals apart"
