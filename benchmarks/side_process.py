"""Starts a side of a comparison and asks it for rounds."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.side import UnavailableError
from common.errors import RelodError

ROOT = Path(__file__).parents[1]
TIMEOUT_S = 240.0
"""Longest time that a preparation or a round may take."""
END_S = 5.0
"""Longest time that a side may take to end after its last round."""

_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
_NOT_INHERITED = ("MALLOC_", "GLIBC_TUNABLES", "PYTHONMALLOC", "OMP_", "KMP_", "GOMP_", "RUST_LOG")
"""Settings of the caller's shell that would tune one side's allocator or threads."""


class SideError(RelodError):
    """A side could not be measured."""


class SideProcess:
    """A running side. Close it, or use it as a context manager."""

    def __init__(self, function: str, options: Mapping[str, Any], scratch: Path | None = None) -> None:
        """Start ``MODULE:FUNCTION`` with keyword ``options``; :meth:`wait_until_ready` before the first round.

        Args:
            function: what prepares the side, see :mod:`benchmarks.side_program`.
            options: of the function.
            scratch: directory for its temporary files; None: the system's.
        """
        self.result: list[float] = []
        self._function = function
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  # close() closes it
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.side_program", function, json.dumps(options)],
            cwd=ROOT,
            env=side_environment(os.environ) | ({"TMPDIR": str(scratch)} if scratch else {}),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            bufsize=0,
            # A group of its own: the terminal's Ctrl-C reaches only who started it, and it ends with its children.
            start_new_session=True,
        )

    def __enter__(self) -> SideProcess:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self._kill()
        self.close()

    def wait_until_ready(self) -> None:
        """Wait until it is prepared.

        Raises:
            SideError: it failed, or took too long.
            UnavailableError: this computer lacks what it needs.
        """
        self.result = self._answer()["result"]

    def measure(self) -> list[float]:
        """Let it do one round and return the numbers.

        Raises:
            SideError: it failed, or took too long.
        """
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # the answer tells why
            self._process.stdin.write(b"\n")
        samples: list[float] = self._answer()["samples"]
        return samples

    def close(self) -> None:
        """End it and whatever it has started."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._kill()
        self._process.stdout.close()
        self._errors.close()

    def _kill(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def _answer(self) -> dict[str, Any]:
        output = self._process.stdout
        assert output is not None
        if not select.select([output], [], [], TIMEOUT_S)[0]:
            raise SideError(f"{self._function}: no answer within {TIMEOUT_S:g} s")
        line = output.readline()
        if not line:
            raise SideError(f"{self._function}: ended with exit code {self._process.wait()}: {self._last_words()}")
        answer: dict[str, Any] = json.loads(line)
        if "unavailable" in answer:
            raise UnavailableError(answer["unavailable"])
        if "error" in answer:
            raise SideError(f"{self._function}: {answer['error']}")
        return answer

    def _last_words(self) -> str:
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing"


def side_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of every side: one thread, the C library's allocator as it comes."""
    kept = {name: value for name, value in environment.items() if not name.startswith(_NOT_INHERITED)}
    return kept | _ONE_THREAD
