"""Ctrl-C as a fact to look at between two actions, instead of an exception in the middle of one."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any, Self

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""
_NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_ECHO_S = 0.5
"""What comes within this of the first is the first once more: ``timeout`` sends it to the process and to its group."""


class StopSignals:
    """Notes SIGINT, SIGTERM and SIGHUP (a closed terminal) while entered. For the main thread.

    The first counts. Another one is for those who do not bound what an end in order takes.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self.asked_s: float | None = None
        """When the first came, monotonic; None before."""
        self.asked_again = False
        """True once another has come: whoever asks does not want to wait."""
        self._now_s = now_s
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
        now_s = self._now_s()
        if self.asked_s is None:
            self.asked_s = now_s
        elif now_s - self.asked_s >= _ECHO_S:
            self.asked_again = True
