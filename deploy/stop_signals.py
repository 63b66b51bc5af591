"""Ctrl-C as a fact to look at between two actions, instead of an exception in the middle of one."""

from __future__ import annotations

import signal
import time
from types import FrameType, TracebackType
from typing import Any, Self

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""
_NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopSignals:
    """Notes SIGINT, SIGTERM and SIGHUP (a closed terminal) while entered. For the main thread.

    The first counts, more change nothing.
    """

    def __init__(self) -> None:
        self.asked_s: float | None = None
        """When the first came, monotonic; None before."""
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        for number in _NUMBERS:
            self._previous[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    @property
    def asked(self) -> bool:
        """True once a signal has come."""
        return self.asked_s is not None

    def _note(self, number: int, frame: FrameType | None) -> None:
        # Nothing that takes a lock: this runs in the middle of whatever the main thread is doing.
        if self.asked_s is None:
            self.asked_s = time.monotonic()
