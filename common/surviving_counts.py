"""Counts that outlive their process: kept in memory that the operating system owns, for the record to read.

A part of the record is up to a second old when its service is killed. What must be exact even then, such as how many
TimeSteps a bridge has published, is also written here, each time it changes: one page of a file on a memory file
system. A mapped file on a disk would do for the reader, but writing to it can wait for the disk, in the action cycle.
"""

from __future__ import annotations

import fcntl
import logging
import mmap
import os
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

logger = logging.getLogger(__name__)

MEMORY_FILE_SYSTEM = Path("/dev/shm")
"""Where Linux keeps files in memory; without it the counts are only as good as the last part."""


class SurvivingCounts:
    """Named integers of one incarnation. Their file is locked for as long as the process lives."""

    def __init__(self, service: str, incarnation: int, names: Sequence[str], folder: Path = MEMORY_FILE_SYSTEM) -> None:
        self.names = tuple(names)
        self.path: Path | None = folder / f"relod-{service}-{incarnation}-{os.getpid()}"
        """None where there is no memory file system: the counts then end with the process."""
        self._format = struct.Struct(f"<{len(self.names)}q")
        self._file = -1
        try:
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # A page that is not there yet would be an end without a word (SIGBUS) on a full file system.
            os.posix_fallocate(self._file, 0, self._format.size)
            self._map = mmap.mmap(self._file, self._format.size)
        except OSError as error:
            logger.warning("%s: %s; if this service is killed, its last second is not counted", self.path, error)
            self.close()
            self._map = mmap.mmap(-1, self._format.size)

    def set(self, values: Iterable[int]) -> None:
        """Replace all counts, in the order of their names; takes about a microsecond and waits for nothing."""
        self._format.pack_into(self._map, 0, *values)

    def description(self) -> dict[str, Any] | None:
        """What the part of the record says of them, for :func:`with_surviving_counts`."""
        return None if self.path is None else {"path": str(self.path), "names": self.names}

    def close(self) -> None:
        """Remove the file; for when the last part has been written."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
        if self.path is not None:
            self.path.unlink(missing_ok=True)
            self.path = None


def with_surviving_counts(part: Mapping[str, Any]) -> dict[str, Any]:
    """Return a part with the newer counts of its service, running or killed; the same part where there are none."""
    counts = _read(part)
    return dict(part) if counts is None else {**part, "counters": {**part.get("counters", {}), **counts}}


def settle(part: Mapping[str, Any], write: Callable[[dict[str, Any]], None]) -> None:
    """Hand the complete part of a service that was killed to ``write``, and remove its counts' file.

    Does nothing if the service lives, or ran on another computer.
    """
    if _read(part) is None:
        return
    path = part["surviving_counts"]["path"]
    file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        # Whoever lives still holds the lock.
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        pass
    else:
        complete = with_surviving_counts(part)
        del complete["surviving_counts"]
        write(complete)
        Path(path).unlink(missing_ok=True)
    finally:
        os.close(file)


def _read(part: Mapping[str, Any]) -> dict[str, int] | None:
    description = part.get("surviving_counts")
    if not description or part.get("state") == "stopped":
        return None
    names = description["names"]
    try:
        values = struct.unpack(f"<{len(names)}q", Path(description["path"]).read_bytes())
    except (OSError, struct.error):
        return None  # on another computer, or settled
    return dict(zip(names, values, strict=True))
