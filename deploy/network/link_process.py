"""The launcher's handle on the process that moves a link's traffic."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from deploy.network.conditions import NetworkConditions
from deploy.network.errors import LinkFailedError, LinkUnavailable
from deploy.network.part import NetworkPart

_REPOSITORY = Path(__file__).resolve().parents[2]
_READY_TIMEOUT_S = 15.0
_STOP_TIMEOUT_S = 3.0


class LinkProcess:
    """The launcher's handle on a link process: start it, hear that it is ready, end it."""

    def __init__(self, module: str, conditions: NetworkConditions, run_dir: Path, seed: int) -> None:
        self._module = module
        self._conditions = conditions
        self._seed = seed
        self._part_path = run_dir / "network.json"
        self._log_path = run_dir / "network.log"
        self._process: subprocess.Popen[bytes] | None = None
        self._start_monotonic_ns = 0

    def start(self, arguments: Sequence[str]) -> dict[str, Any]:
        """Start the process and return what it says when it is ready.

        It ends with the thread that calls this, at the latest: call it from the main thread.
        """
        self._part_path.parent.mkdir(parents=True, exist_ok=True)
        command = [
            *(sys.executable, "-m", self._module),
            *("--part", str(self._part_path), "--seed", str(self._seed), "--parent-pid", str(os.getpid())),
            *arguments,
        ]
        # A session of its own: Ctrl-C on the launcher must not cut the link before the services have said
        # goodbye.
        with self._log_path.open("wb") as log, tempfile.TemporaryFile("w+") as table:
            # A file, and not an argument nor a pipe: the rows of a trace may be more than either takes.
            json.dump(self._conditions.to_table(), table)
            table.seek(0)
            self._process = subprocess.Popen(
                command,
                stdin=table,
                stdout=subprocess.PIPE,
                stderr=log,
                env={**os.environ, "PYTHONPATH": python_path()},
                start_new_session=True,
            )
        ready = self._wait_until_ready(self._process)
        self._start_monotonic_ns = self.part().start_monotonic_ns
        return ready

    def part(self) -> NetworkPart:
        """The link's part of the record: about a second old, and final once the process has been stopped."""
        try:
            return NetworkPart.read(self._part_path)
        except FileNotFoundError as error:
            raise LinkFailedError(f"{self._part_path}: not there; the link has never been up") from error

    def failure(self) -> str | None:
        """Why the process has ended by itself; None if it has not, or was stopped."""
        if self._process is None or self._process.poll() is None:
            return None
        return f"{self._module} ended with exit code {self._process.returncode}: {self._log_tail()}"

    def over(self) -> str | None:
        """See :func:`trace_over`; None once the process was stopped."""
        if self._process is None:
            return None
        return trace_over(self._conditions, time.monotonic_ns() - self._start_monotonic_ns)

    def stop(self) -> None:
        """End the process; harmless if it has ended or was never started."""
        process, self._process = self._process, None
        if process is None:
            return
        process.terminate()
        try:
            process.wait(_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        finally:
            if process.stdout is not None:
                process.stdout.close()

    def _wait_until_ready(self, process: subprocess.Popen[bytes]) -> dict[str, Any]:
        assert process.stdout is not None
        deadline = time.monotonic() + _READY_TIMEOUT_S
        line = b""
        while not line.endswith(b"\n"):
            left_s = deadline - time.monotonic()
            if left_s <= 0 or not select.select([process.stdout], [], [], left_s)[0]:
                raise LinkUnavailable(f"{self._module} was not ready after {_READY_TIMEOUT_S} s: {self._log_tail()}")
            data = os.read(process.stdout.fileno(), 65536)
            if not data:
                raise LinkUnavailable(f"{self._module} ended before it was ready: {self._log_tail()}")
            line += data
        ready: dict[str, Any] = json.loads(line)
        return ready

    def _log_tail(self) -> str:
        try:
            lines = self._log_path.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        except OSError:
            lines = []
        return f"{lines[-1]} (all of it: {self._log_path})" if lines else f"it left nothing in {self._log_path}"


def trace_over(conditions: NetworkConditions, age_ns: int) -> str | None:
    """That a trace which stops is over for a link that started so long ago; None if none is.

    The link itself goes on with the last values: the services can still say goodbye.
    """
    if conditions.stops is None:
        return None
    end_s, trace = conditions.stops
    if age_ns < end_s * 1e9:
        return None
    return f"the trace {trace.name} is over after {end_s:g} s, and trace_end = 'stop'; 'loop' begins it again"


def python_path() -> str:
    """``PYTHONPATH`` of a process that runs this project's modules, wherever it is started."""
    inherited = os.environ.get("PYTHONPATH")
    return f"{_REPOSITORY}{os.pathsep}{inherited}" if inherited else str(_REPOSITORY)
