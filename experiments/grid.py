"""A grid of independent jobs whose results outlive whatever interrupts them.

A job has a key, e.g. ``("reacher_easy", 50, 3)``, and gives one row of plain values. The rows are kept in a folder:

======================  ================================================================================
``settings.json``       what every row depends on besides its key
``results.jsonl``       one line per finished job, on the disk before the next one counts as finished
``failures.log``        tracebacks of the jobs that failed; they are tried again the next time
======================  ================================================================================

Whoever runs the grid again in the same folder goes on where it stopped. A job must take all its randomness from its
key and the settings; then the rows are the same for any number of workers and any order.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from common.errors import ConfigError, RelodError
from common.record import write_atomically
from experiments.wording import plural
from experiments.workers import JobFailure, Key, WorkerPool

Row = Mapping[str, Any]

_KEY = "key"
_ANOTHER_FOLDER = "choose another folder with --out"
"""All programs that have a grid have that option."""


class GridError(RelodError):
    """A grid's folder cannot be used."""


class GridRecord:
    """The folder of a grid, open for one program at a time. Use it in a ``with`` block."""

    def __init__(self, directory: Path, settings: Mapping[str, Any]) -> None:
        """Open ``directory``, or make it.

        Args:
            directory: of the record.
            settings: name -> plain value, of all that changes the rows. Names that the folder does not know yet are
                added to it: a grid may grow.

        Raises:
            GridError: another program uses it, or a file in it cannot be understood.
            ConfigError: it holds rows of other settings.
        """
        self.directory = directory
        self.rows: dict[Key, Row] = {}
        """Every finished job there is, also those of earlier calls."""
        _refuse_foreign(directory)
        directory.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as stack:
            lock = stack.enter_context((directory / ".lock").open("w"))
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise GridError(
                    f"{directory}: another program is working there; wait for it, or {_ANOTHER_FOLDER}"
                ) from None
            self._settle_settings(settings)
            self._file = stack.enter_context((directory / "results.jsonl").open("a+b"))
            self._read_rows()
            self._open_files = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open_files.close()

    def add(self, key: Key, row: Row) -> None:
        """Keep a finished job's row."""
        line = json.dumps({_KEY: list(key), **row}, allow_nan=False)
        self._file.write(line.encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())
        self.rows[key] = row

    def add_failure(self, failure: JobFailure) -> None:
        """Keep what is known of a failed job."""
        with (self.directory / "failures.log").open("a", encoding="utf-8") as file:
            file.write(f"{key_text(failure.key)}: {failure.reason}\n{failure.details}\n")

    def _settle_settings(self, settings: Mapping[str, Any]) -> None:
        path, results = self.directory / "settings.json", self.directory / "results.jsonl"
        wanted = json.loads(json.dumps(settings))
        known: dict[str, Any] = {}
        if not path.exists() and results.exists() and results.stat().st_size:
            raise GridError(f"{path} is missing, so nobody knows what the results there are of; {_ANOTHER_FOLDER}")
        if path.exists():
            try:
                known = dict(json.loads(path.read_text(encoding="utf-8")))
            except (ValueError, TypeError) as error:
                raise GridError(f"{path} cannot be understood: {error}; {_ANOTHER_FOLDER}") from error
        different = [
            text for name, value in wanted.items() if name in known for text in _differences(name, known[name], value)
        ]
        if different:
            raise ConfigError(
                f"{self.directory} holds results of other settings ({'; '.join(different)}): "
                f"ask for the same, or {_ANOTHER_FOLDER}"
            )
        if set(wanted) - set(known):
            write_atomically(path, json.dumps({**known, **wanted}, indent=1, sort_keys=True) + "\n")

    def _read_rows(self) -> None:
        self._file.seek(0)
        *lines, torn = self._file.read().split(b"\n")
        if torn:  # Whoever wrote it was stopped in the middle: the job counts as not done.
            self._file.truncate(sum(len(line) + 1 for line in lines))
        for number, line in enumerate(lines, start=1):
            try:
                row = dict(json.loads(line))
                key = tuple(row.pop(_KEY))
            except (ValueError, TypeError, KeyError) as error:
                path = self.directory / "results.jsonl"
                raise GridError(f"{path}, line {number} cannot be understood: {error!r}; delete the line") from error
            self.rows[key] = row


def _differences(name: str, there: Any, now: Any) -> list[str]:
    """What two values of a setting differ in, to be read."""
    if isinstance(there, dict) and isinstance(now, dict):
        keys = dict.fromkeys([*there, *now])
        return [text for key in keys for text in _differences(f"{name}, {key}", there.get(key), now.get(key))]
    return [] if there == now else [f"{name}: {there!r} there, now {now!r}"]


def _refuse_foreign(directory: Path) -> None:
    """Raise GridError if the folder holds something, but not a grid's record."""
    if not directory.is_dir():
        return
    names = {path.name for path in directory.iterdir()} - {".lock"}
    if names and not names & {"settings.json", "results.jsonl"}:
        raise GridError(
            f"{directory} holds other files ({', '.join(sorted(names)[:3])}): expected an empty folder, or one with "
            f"results of this program: {_ANOTHER_FOLDER}"
        )


@dataclass(frozen=True)
class GridProgress:
    """Where a grid stands."""

    finished: int
    """Jobs of this call with a row, or failed."""
    jobs: int
    """Jobs of this call."""
    left_s: float | None
    """Expected time to the end, seconds; None: nothing to judge it by."""

    def __str__(self) -> str:
        left = "" if self.left_s is None else f", {duration_text(self.left_s)} left"
        return f"{self.finished}/{self.jobs} {plural(self.jobs, 'job')}{left}"


def run_grid(
    record: GridRecord,
    jobs: Iterable[Key],
    pool: WorkerPool,
    *,
    progress: Callable[[GridProgress], None] = lambda progress: None,
    failed: Callable[[JobFailure], None] = lambda failure: None,
    asked_to_stop: Callable[[], bool] = lambda: False,
    cost: Callable[[Key], float] = lambda key: 1.0,
) -> Sequence[JobFailure]:
    """Run the jobs that have no row yet; return those that failed.

    Args:
        record: what is finished, and where to keep what will be.
        jobs: keys, in the order in which they are begun.
        pool: who does the work.
        progress: is told after each job, and now and then in between.
        failed: is told of each failure at once; the rest goes on.
        asked_to_stop: True ends the call soon; jobs begun and not finished are lost.
        cost: of a job compared to another, for the expected time.
    """
    wanted = list(dict.fromkeys(jobs))
    left = [key for key in wanted if key not in record.rows]
    costs = {key: cost(key) for key in left}
    remaining = _RemainingTime(sum(costs.values()))
    failures: list[JobFailure] = []

    def tell() -> None:
        progress(GridProgress(len(wanted) - len(costs), len(wanted), remaining.left_s()))

    for outcome in pool.run(left, asked_to_stop):
        if isinstance(outcome, JobFailure):
            record.add_failure(outcome)
            failures.append(outcome)
            failed(outcome)
        elif outcome is not None:
            record.add(outcome.key, outcome.row)
        if outcome is not None:
            remaining.finished(costs.pop(outcome.key))
        tell()
    return failures


def failure_text(failure: JobFailure) -> str:
    """That a job has failed, to be read while the others are at work."""
    return f"{key_text(failure.key)} failed: {failure.reason}; the rest goes on"


def key_text(key: Key) -> str:
    """A job's key, to be read."""
    return " ".join(str(part) for part in key)


def duration_text(seconds: float) -> str:
    """A duration, to be read: ``12 s``, ``3 min``, ``2.5 h``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


class _RemainingTime:
    """Judged by the cost of what was finished since this was made."""

    def __init__(self, cost: float) -> None:
        self._left, self._finished = cost, 0.0
        self._begun_s = time.monotonic()

    def finished(self, cost: float) -> None:
        self._left -= cost
        self._finished += cost

    def left_s(self) -> float | None:
        if not self._finished:
            return None
        return max(self._left, 0.0) * (time.monotonic() - self._begun_s) / self._finished
