"""The ring's file itself: made whole or not at all, and written by one process at a time."""

from __future__ import annotations

import errno
import fcntl
import os
from pathlib import Path

from common.errors import RingError
from common.frame_ring.layout import RingLayout


def create_ring_file(path: str, sizes: RingLayout) -> None:
    """Make an empty ring; ``path`` appears only when it is complete.

    Raises:
        RingError: there is no room for it.
        OSError: it cannot be made for another reason.
    """
    partial = f"{path}.partial"
    descriptor = os.open(partial, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
    try:
        # Not a sparse file: a mapped page that finds no room later kills the process without an exception.
        os.posix_fallocate(descriptor, 0, sizes.file_bytes)
        os.pwrite(descriptor, sizes.header(), 0)
        os.fsync(descriptor)
        os.rename(partial, path)
    except BaseException as error:
        os.ftruncate(descriptor, 0)  # gives back what was allocated, or the text below would count it as in use
        Path(partial).unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EFBIG, errno.EDQUOT):
            room = os.statvfs(os.path.dirname(path) or ".")
            raise RingError(
                f"{path}: the experience ring needs {sizes.file_bytes} bytes, {room.f_bavail * room.f_frsize} are free "
                f"({error.strerror}); make room, choose another run directory, or a smaller replay capacity"
            ) from error
        raise
    finally:
        os.close(descriptor)


def lock_ring_file(path: str, descriptor: int) -> None:
    """Become the only writer of an open ring until its descriptor is closed.

    Raises:
        RingError: another process writes it.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise RingError(f"{path}: another process writes this experience ring; stop it first") from error
