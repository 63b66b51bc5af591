"""Processes that do a grid's jobs. One that dies costs its job, not the grid."""

from __future__ import annotations

import contextlib
import ctypes
import json
import multiprocessing
import os
import signal
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from multiprocessing import connection, resource_tracker
from types import TracebackType
from typing import Any, Self

Key = tuple[str | int, ...]
Work = Callable[[Mapping[str, Any], Key], Mapping[str, Any]]
"""Does one job: (settings, key) -> row of plain values. A module's function: the workers import it."""

_LEFT_TO_THE_CALLER = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""What a terminal, ``timeout`` or a job scheduler sends to a whole process group to end it."""
_PR_SET_PDEATHSIG = 1
_POLL_S = 0.2
_TERMINATION_S = 2.0
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
"""Each worker has a core; threads of their libraries would only take turns on it."""


@dataclass(frozen=True)
class FinishedJob:
    """A job that gave a row."""

    key: Key
    row: Mapping[str, Any]


@dataclass(frozen=True)
class JobFailure:
    """A job that gave none."""

    key: Key
    reason: str
    """One line."""
    details: str = ""
    """Traceback, if there was an exception."""


class WorkerPool:
    """Starts its processes when there is work for them. Use it in a ``with`` block.

    Processes are spawned, not forked: a fork would copy whatever threads and graphics contexts the caller has.
    """

    def __init__(self, work: Work, settings: Mapping[str, Any], workers: int, *, pinned: bool = False) -> None:
        """Args:
        work: does a job.
        settings: handed to every job; they have to be picklable.
        workers: processes at a time.
        pinned: each process stays on a core of its own, where there are enough: for jobs of threads that take turns,
            as in simulated time, which need a quarter less time if none of them has to wake another core.
        """
        self._work, self._settings, self._size = work, settings, workers
        cores = sorted(os.sched_getaffinity(0))
        self._cores = cores[:workers] if pinned and len(cores) >= workers else []
        self._workers: list[_Worker] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for worker in self._workers:
            worker.end()
        self._workers.clear()

    def run(
        self, jobs: Iterable[Key], asked_to_stop: Callable[[], bool] = lambda: False
    ) -> Iterator[FinishedJob | JobFailure | None]:
        """Do the jobs; yield how each ended, as it ends, and None now and then in between."""
        waiting = deque(jobs)
        while not asked_to_stop():
            self._hand_out(waiting)
            busy = [worker for worker in self._workers if worker.key is not None]
            if not busy:
                return
            # A worker that dies closes its end of the pipe, so this wakes up for that as well.
            ready = set(connection.wait([worker.pipe for worker in busy], timeout=_POLL_S))
            for worker in busy:
                if worker.pipe in ready:
                    yield self._receive(worker)
            if not ready:
                yield None

    def _hand_out(self, waiting: deque[Key]) -> None:
        for worker in self._workers:
            if worker.key is None and waiting:
                worker.begin(waiting.popleft())
        while waiting and len(self._workers) < self._size:
            taken = {worker.core for worker in self._workers}
            core = next((core for core in self._cores if core not in taken), None)
            self._workers.append(_Worker(self._work, self._settings, core))
            self._workers[-1].begin(waiting.popleft())

    def _receive(self, worker: _Worker) -> FinishedJob | JobFailure:
        outcome = worker.receive()
        if outcome is None:
            assert worker.key is not None
            self._workers.remove(worker)
            return JobFailure(worker.key, f"its process died: {worker.fate()}")
        return outcome


class _Worker:
    """One process and the job it is at."""

    def __init__(self, work: Work, settings: Mapping[str, Any], core: int | None) -> None:
        self.core = core
        """That it stays on; None: it runs where there is room."""
        context = multiprocessing.get_context("spawn")
        self.pipe, far_end = context.Pipe()
        self.key: Key | None = None
        self._process = context.Process(
            target=_serve, args=(far_end, work, settings, core, os.getpid()), name="grid worker", daemon=True
        )
        with _environment(_ONE_THREAD), _deaf_to_what_ends_a_group():
            self._process.start()
        far_end.close()  # Ours only: the pipe then ends with the process.

    def begin(self, key: Key) -> None:
        self.key = key
        # One that died while it was idle is noticed when its answer is waited for.
        with contextlib.suppress(OSError):
            self.pipe.send(key)

    def receive(self) -> FinishedJob | JobFailure | None:
        """How the job ended; None: with the process."""
        try:
            outcome: FinishedJob | JobFailure = self.pipe.recv()
        except (EOFError, OSError):
            return None
        self.key = None
        return outcome

    def fate(self) -> str:
        """How the process ended, after its pipe has."""
        self._process.join(_TERMINATION_S)
        self.end()
        return _exit_text(self._process.exitcode)

    def end(self) -> None:
        """End the process, whatever it is doing."""
        self.pipe.close()
        if self.key is None:  # It ends by itself when it finds the pipe closed.
            self._process.join(_TERMINATION_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _serve(
    pipe: connection.Connection, work: Work, settings: Mapping[str, Any], core: int | None, parent_pid: int
) -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if core is not None:
        os.sched_setaffinity(0, {core})  # Before it has threads, which inherit it.
    if os.getppid() == parent_pid:  # Else it was gone before the line above.
        do_jobs(pipe, work, settings)


def do_jobs(pipe: connection.Connection, work: Work, settings: Mapping[str, Any]) -> None:
    """Do the jobs whose keys come through a pipe, send back how each ended, until nobody is at its other end."""
    # A pipe that is closed over there ends it (EOFError); so it does with an answer unread, or before one (OSError).
    with contextlib.suppress(EOFError, OSError):
        while True:
            key = pipe.recv()
            pipe.send(_outcome(work, settings, key))


def _outcome(work: Work, settings: Mapping[str, Any], key: Key) -> FinishedJob | JobFailure:
    try:
        # As the record will keep it: what cannot be kept is this job's failure.
        return FinishedJob(key, json.loads(json.dumps(dict(work(settings, key)), allow_nan=False)))
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        return JobFailure(key, reason, traceback.format_exc())


@contextlib.contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Set variables for the processes started meanwhile; what is set already stays."""
    added = {name: value for name, value in values.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


@contextlib.contextmanager
def _deaf_to_what_ends_a_group() -> Iterator[None]:
    """Processes started meanwhile never see Ctrl-C and its like, which all of a group get: this one decides."""
    resource_tracker.ensure_running()  # It would be started with the first process, and unblock signals when it is.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _LEFT_TO_THE_CALLER)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)  # One that came meanwhile comes now.


def _exit_text(code: int | None) -> str:
    if code is not None and code < 0:
        return f"killed by {signal.Signals(-code).name}"
    return f"exit code {code}"
