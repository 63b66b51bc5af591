"""Stops the robot when no fresh action comes; e-stop and pause latch until they are lifted."""

from __future__ import annotations


class Watchdog:
    """Decides whether the robot may move. Pure: the caller tells the time and stops the robot."""

    def __init__(self, stop_after_ns: int) -> None:
        self._stop_after_ns = stop_after_ns
        self._fresh_ns = 0
        self._expired = False
        self.latched: str | None = None
        """``e_stop`` or ``pause`` until :meth:`release`."""
        self.stops = 0
        """How often the robot has been stopped for want of a fresh action."""

    @property
    def stopped(self) -> bool:
        """True while the robot must not move."""
        return self._expired or self.latched is not None

    @property
    def deadline_ns(self) -> int:
        """When the robot will have to stop if nothing fresh comes."""
        return self._fresh_ns + self._stop_after_ns

    def restart(self, now_ns: int) -> None:
        """Start to count now: an attempt begins."""
        self._fresh_ns = now_ns
        self._expired = False

    def accept(self, observed_ns: int, now_ns: int) -> bool:
        """True if an action that answers an observation of ``observed_ns`` may be applied now.

        An answer to an observation older than the watchdog's time is not fresh: it comes out of a buffer that an
        outage has filled, and the world it answers is gone.
        """
        if self.latched is not None or now_ns - observed_ns > self._stop_after_ns:
            return False
        self._fresh_ns = now_ns
        self._expired = False
        return True

    def expire(self, now_ns: int) -> bool:
        """True once, when the time without a fresh action is up: the robot has to stop now."""
        if self.stopped or now_ns < self.deadline_ns:
            return False
        self._expired = True
        self.stops += 1
        return True

    def latch(self, reason: str) -> None:
        """Keep the robot stopped; an emergency stop is not weakened to a pause."""
        self.latched = "e_stop" if "e_stop" in (reason, self.latched) else reason

    def release(self, now_ns: int) -> None:
        """Lift what :meth:`latch` set."""
        self.latched = None
        self.restart(now_ns)
