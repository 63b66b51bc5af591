"""What takes most of a program's start, done where Ctrl-C can end it, or is held back."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from types import FrameType
from typing import NoReturn, TypeVar

from common.algorithms import load_algorithm
from common.stop_signals import StopSignals

Made = TypeVar("Made")


def uninterrupted(make: Callable[[], Made]) -> Made:
    """Return what ``make`` makes; Ctrl-C meanwhile is a KeyboardInterrupt at its end. For the main thread.

    In the middle of it, while compiled code is imported, it would be an ImportError.
    """
    with StopSignals() as stop:
        made = make()
    if stop.asked:
        raise KeyboardInterrupt
    return made


def load_libraries(algorithm: str, stop: StopSignals) -> None:
    """Import torch, and what torch imports itself for its first optimiser, for an algorithm.

    The services would do so in threads of their own, where nothing can interrupt it. For the main thread.

    Args:
        algorithm: its name.
        stop: entered; what it would note ends this call instead, in the middle of what it does.

    Raises:
        KeyboardInterrupt: stopped, before or meanwhile.
    """
    if stop.asked:
        raise KeyboardInterrupt
    with _interruptible():
        _load(algorithm)


def _load(algorithm: str) -> None:
    load_algorithm(algorithm)
    import torch

    torch.optim.Adam([torch.zeros(1)])


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Have signals that ask to stop raise KeyboardInterrupt."""
    came = False

    def interrupt(number: int, frame: FrameType | None) -> NoReturn:
        nonlocal came
        came = True
        raise KeyboardInterrupt

    previous = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    if came:  # In a place from which Python lets no exception out.
        raise KeyboardInterrupt
