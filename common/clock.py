"""Time: a clock that can be injected, and the keeper of absolute deadlines."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol


class Clock(Protocol):
    """Time, and every way to wait for it or for someone.

    Services wait through their clock only, on conditions and in threads of its making. A simulated clock then decides
    who runs when, and a run of all services is the same each time.
    """

    def now_ns(self) -> int:
        """Monotonic time, nanoseconds."""
        ...

    def wait_until(self, deadline_ns: int, condition: threading.Condition) -> bool:
        """Wait on the held ``condition`` until it is notified (True) or the deadline has passed (False)."""
        ...

    def wait(self, condition: threading.Condition, timeout_s: float | None = None) -> bool:
        """Wait on the held ``condition`` until it is notified (True) or ``timeout_s`` is over (False)."""
        ...

    def condition(self) -> threading.Condition:
        """Make a condition to wait on."""
        ...

    def thread(self, target: Callable[[], None], name: str) -> threading.Thread:
        """Make a thread that does not keep the process alive; not started."""
        ...


class _SystemThreads:
    """Waiting, conditions and threads of the operating system."""

    def wait(self, condition: threading.Condition, timeout_s: float | None = None) -> bool:
        return condition.wait(timeout_s)

    def condition(self) -> threading.Condition:
        return threading.Condition()

    def thread(self, target: Callable[[], None], name: str) -> threading.Thread:
        return threading.Thread(target=target, name=name, daemon=True)


class SystemClock(_SystemThreads):
    """The computer's monotonic clock."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def wait_until(self, deadline_ns: int, condition: threading.Condition) -> bool:
        remaining_s = (deadline_ns - time.monotonic_ns()) / 1e9
        return remaining_s > 0 and condition.wait(remaining_s)


class SkewedClock:
    """Shows another time than the clock beneath, as another computer's does: off by an offset, faster by a drift.

    What waits, waits on the clock beneath, for the time that this one shows.
    """

    def __init__(self, beneath: Clock, offset_s: float = 0.0, drift_ppm: float = 0.0) -> None:
        self._beneath = beneath
        self._rate = 1.0 + drift_ppm * 1e-6
        self._begun_ns = beneath.now_ns()
        self._offset_ns = round(offset_s * 1e9)

    def now_ns(self) -> int:
        """See :class:`Clock`."""
        passed_ns = self._beneath.now_ns() - self._begun_ns
        return self._begun_ns + self._offset_ns + math.floor(passed_ns * self._rate)

    def jump(self, seconds: float) -> None:
        """Show a time that much later, or earlier, from now on."""
        self._offset_ns += round(seconds * 1e9)

    def wait_until(self, deadline_ns: int, condition: threading.Condition) -> bool:
        """See :class:`Clock`."""
        passed_ns = (deadline_ns - self._begun_ns - self._offset_ns) / self._rate
        return self._beneath.wait_until(self._begun_ns + math.ceil(passed_ns), condition)

    def wait(self, condition: threading.Condition, timeout_s: float | None = None) -> bool:
        """See :class:`Clock`."""
        return self._beneath.wait(condition, None if timeout_s is None else timeout_s / self._rate)

    def condition(self) -> threading.Condition:
        """See :class:`Clock`."""
        return self._beneath.condition()

    def thread(self, target: Callable[[], None], name: str) -> threading.Thread:
        """See :class:`Clock`."""
        return self._beneath.thread(target, name)


class FakeClock(_SystemThreads):
    """A clock that stands still until it is told; waiting for a deadline moves it straight there.

    What waits for a while only, in the background, waits in real time.
    """

    def __init__(self, now_ns: int = 1_000_000_000) -> None:
        self._now_ns = now_ns

    def now_ns(self) -> int:
        return self._now_ns

    def advance(self, seconds: float) -> None:
        """Move time on."""
        self._now_ns += round(seconds * 1e9)

    def advance_to(self, now_ns: int) -> None:
        """Move time on to ``now_ns``; never back."""
        self._now_ns = max(self._now_ns, now_ns)

    def wait_until(self, deadline_ns: int, condition: threading.Condition) -> bool:
        self.advance_to(deadline_ns)
        return False


@dataclass(frozen=True)
class Lateness:
    """How one deadline was met."""

    late_ns: int
    """Time by which it was missed; 0 or less if it was met."""
    overrun: bool
    """Missed by more than the tolerated share of the period."""
    skipped: int
    """Whole periods that passed unnoticed and were given up."""


class CycleKeeper:
    """Absolute deadlines of a periodic loop: being late once does not shift the deadlines after it.

    If more than a whole period is missed, the keeper gives up those periods instead of hurrying after them.
    """

    def __init__(self, period_ns: int, tolerance: float = 0.1) -> None:
        if period_ns <= 0:
            raise ValueError(f"period_ns: expected more than 0, got {period_ns}")
        self.period_ns = period_ns
        self._tolerance_ns = round(period_ns * tolerance)
        self.deadline_ns = 0
        """End of the cycle that is running."""

    def start(self, now_ns: int) -> None:
        """Begin the first cycle now."""
        self.deadline_ns = now_ns + self.period_ns

    def next(self, now_ns: int) -> Lateness:
        """End the running cycle, which should be at its deadline, and begin the next one."""
        late_ns = now_ns - self.deadline_ns
        skipped = max(0, late_ns) // self.period_ns
        self.deadline_ns += (1 + skipped) * self.period_ns
        return Lateness(late_ns, late_ns > self._tolerance_ns, skipped)

    def stretch(self, now_ns: int) -> None:
        """Let the running cycle last longer: it ended now, later than its deadline, on purpose."""
        self.deadline_ns = max(self.deadline_ns, now_ns)
