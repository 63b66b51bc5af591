"""Tells when a simulated world cannot keep up with the clock."""

from __future__ import annotations

LAG_NS = 250_000_000
"""A world that is further behind at every look for :data:`TOLD_AFTER_NS` is too slow, or hangs. One whose computer was
suspended has caught up by then."""
TOLD_AFTER_NS = 1_000_000_000
TOLD_EVERY_NS = 10_000_000_000


class LagWatch:
    """Decides when a lag is worth a word. Pure: the caller tells the time."""

    def __init__(self) -> None:
        self._since_ns: int | None = None
        """First look at the lag that lasts; None while there is none."""
        self._told_ns: int | None = None

    def look(self, lag_ns: int, now_ns: int) -> bool:
        """Note how far the world is behind; True if people should be told now."""
        if lag_ns <= LAG_NS:
            self._since_ns = self._told_ns = None
            return False
        if self._since_ns is None:
            self._since_ns = now_ns
        next_ns = self._since_ns + TOLD_AFTER_NS if self._told_ns is None else self._told_ns + TOLD_EVERY_NS
        if now_ns < next_ns:
            return False
        self._told_ns = now_ns
        return True
