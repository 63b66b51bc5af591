"""What a learner leaves on disk: the policy, and everything the next update depends on. Never pickle."""

from __future__ import annotations

import io
import logging
import threading
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from common.algorithms.base import Algorithm, Arrays
from common.errors import ConfigError, ServiceError
from common.record import write_atomically

logger = logging.getLogger(__name__)

POLICY_FILE, CHECKPOINT_FILE = "policy.msgpack", "checkpoint.npz"
_VERSION_KEY = "policy_version"


class CheckpointWriter:
    """Writes the newest checkpoint on a thread of its own; one that comes while another is written replaces it."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self.failure: str | None = None
        """Why the newest checkpoint could not be written, if it could not."""
        self._wake = threading.Condition()
        self._pending: tuple[int, bytes, Arrays] | None = None
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="checkpoint", daemon=True)
        self._thread.start()

    def write(self, version: int, policy: bytes, state: Arrays) -> None:
        """Take over a checkpoint to write: policy version, encoded policy, and what the next update depends on.

        Raises:
            ServiceError: the state is not finite; the checkpoint before it stays, to go on from.
        """
        for name, values in state.items():
            if values.dtype.kind == "f" and not np.isfinite(values).all():
                raise ServiceError(
                    f"{name} is not finite: learning has diverged; {self._directory} keeps the checkpoint before"
                )
        with self._wake:
            self._pending = (version, policy, state)
            self._wake.notify()

    def close(self) -> None:
        """Write what is pending, then stop."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._wake:
                while self._pending is None and not self._stopping:
                    self._wake.wait()
                pending, self._pending = self._pending, None
            if pending is None:
                return
            version, policy, state = pending
            try:
                write_atomically(self._directory / POLICY_FILE, policy)
                buffer = io.BytesIO()
                np.savez(buffer, **{_VERSION_KEY: np.int64(version)}, **state)  # type: ignore[arg-type]
                write_atomically(self._directory / CHECKPOINT_FILE, buffer.getvalue())
                self.failure = None
            except OSError as error:
                self.failure = f"{self._directory}: the checkpoint cannot be written: {error.strerror}"
                logger.error("%s", self.failure)


def restore(directory: Path, algorithm: Algorithm) -> int:
    """Continue from the run's checkpoint if there is one; return the policy version it had reached, else 0."""
    path = directory / CHECKPOINT_FILE
    if not path.exists():
        return 0
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            state = dict(arrays)
        version = int(state.pop(_VERSION_KEY))
        algorithm.load_state_dict(state)
    except (OSError, ValueError, KeyError, EOFError, TypeError, BadZipFile) as error:
        raise ConfigError(f"{path}: cannot go on from this checkpoint: {error}; remove it to begin anew") from error
    logger.info("going on from update %d, policy version %d", algorithm.updates, version)
    return version
