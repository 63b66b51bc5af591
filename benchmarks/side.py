"""What a side of a comparison gives to be measured."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from common.errors import RelodError


class UnavailableError(RelodError):
    """This computer lacks what the measurement needs, for example a GL library; the message names it."""


@dataclass(frozen=True)
class Prepared:
    """A side that is ready to be measured."""

    measure: Callable[[], list[float]]
    """Does one round and returns its numbers, e.g. the duration of each call."""
    result: list[float] = field(default_factory=list)
    """What the side computed before it was measured; both sides of a comparison must agree on it."""


def repeated(call: Callable[[], object], count: int, unit_s: float = 1e-3) -> Callable[[], list[float]]:
    """Return a round of ``count`` calls: the duration of each, in units of ``unit_s`` seconds.

    Durations are processor time, of all threads there may be: what one thread takes on a core of its own, even where
    other programs compute at the same time.
    """

    def measure() -> list[float]:
        durations = []
        for _ in range(count):
            begun = time.process_time()
            call()
            durations.append((time.process_time() - begun) / unit_s)
        return durations

    return measure
