"""What a program says: lines, and one status line that a terminal rewrites."""

from __future__ import annotations

import io
import os
import shutil
import sys
import time
from collections.abc import Callable
from typing import TextIO

PLAIN_PERIOD_S = 10.0
"""Between two status lines where they cannot be rewritten: a file, a pipe."""


class Console:
    """Writes to the terminal; goes silent, and does not fail, when nobody reads any more."""

    def __init__(
        self,
        out: TextIO | None = None,
        errors: TextIO | None = None,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        # A program that was started with its outputs closed has none.
        self._out = out or sys.stdout or io.StringIO()
        self._errors = errors or sys.stderr or io.StringIO()
        self._now_s = now_s
        self._rewrites = self._out.isatty()
        self._status_shown = False
        self._next_plain_s = float("-inf")

    def status(self, text: str) -> None:
        """Show the state of things: now in a terminal, every :data:`PLAIN_PERIOD_S` elsewhere."""
        if self._rewrites:
            width = shutil.get_terminal_size().columns
            self._status_shown = True
            self._write(self._out, f"\r{text[: width - 1]}\x1b[K")
        elif self._now_s() >= self._next_plain_s:
            self._next_plain_s = self._now_s() + PLAIN_PERIOD_S
            self._write(self._out, f"{text}\n")

    def line(self, text: str) -> None:
        """Say something that stays."""
        self._clear()
        self._write(self._out, f"{text}\n")

    def error(self, text: str) -> None:
        """Say on the error output that something went wrong."""
        self._clear()
        self._write(self._errors, f"{text}\n")

    def _clear(self) -> None:
        if self._status_shown:
            self._status_shown = False
            self._write(self._out, "\r\x1b[K")

    def _write(self, stream: TextIO, text: str) -> None:
        try:
            try:
                stream.write(text)
            except UnicodeEncodeError as error:  # an output that is not UTF-8: everything else can still be read
                stream.write(text.encode(error.encoding, "replace").decode(error.encoding))
            stream.flush()
        except (OSError, ValueError) as error:
            # `launch | tee` and Ctrl-C: tee is gone first, and the run's record still has to be completed.
            _silence(stream)
            if stream is self._out and isinstance(error, OSError) and not isinstance(error, BrokenPipeError):
                self._write(self._errors, f"nothing more is shown: the output cannot be written: {error.strerror}\n")


def _silence(stream: TextIO) -> None:
    try:
        descriptor = stream.fileno()
    except (OSError, ValueError):
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, descriptor)
    os.close(nowhere)
