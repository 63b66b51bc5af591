"""Running a study: what is finished is kept, what crashes is told and left out, and the same command goes on."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Generic, TypeVar

from common.console import Console
from common.stop_signals import INTERRUPTED, StopSignals
from experiments.grid import GridError, GridRecord, Row, run_grid
from experiments.run_folders import FolderJob, keep_crashed, remove_half_finished, runs_folder
from experiments.workers import JobFailure, Key, Work, WorkerPool

AJob = TypeVar("AJob", bound=FolderJob)

SO_FAR = "so_far"
"""In the runs' folder: the results of an interrupted study."""


class Study(Generic[AJob]):
    """Jobs whose rows and runs' folders are kept below one folder."""

    def __init__(
        self,
        name: str,
        jobs: Mapping[Key, AJob],
        settings: Mapping[str, Any],
        cost: Callable[[AJob], float],
        write_results: Callable[[Mapping[Key, Row], Mapping[Key, str], Path], None],
    ) -> None:
        """Args:
        name: of the program.
        jobs: key -> job, in the order in which they are begun.
        settings: what the rows depend on besides their keys.
        cost: of a job compared to another, for the expected time.
        write_results: is given the rows of the finished jobs, why others have none, and the folder to write into.
        """
        self._name, self._jobs, self._settings = name, jobs, settings
        self._cost, self._write_results = cost, write_results

    def run(self, out: Path, workers: int, console: Console, do: Work, *, pinned: bool) -> int:
        """Run what is not finished, write the results; return the exit code.

        The results of an interrupted study go to :data:`SO_FAR`: what ``out`` has from a whole one stays.

        Args:
            out: below which all is kept.
            workers: processes at a time.
            console: where it is told.
            do: does a job.
            pinned: see :class:`WorkerPool`; what a job starts stays on its core too.
        """
        runs, failures = runs_folder(out), dict[Key, str]()

        def report_failure(failure: JobFailure) -> None:
            job = self._jobs[failure.key]
            failures[failure.key] = f"crashed: {failure.reason}"
            kept = keep_crashed(runs, job)
            console.error(
                f"{self._name}: {job.folder} crashed: {failure.reason}; the rest goes on; "
                f"traceback: {runs / 'failures.log'}" + (f"; its record: {kept}" if kept else "")
            )

        with StopSignals() as stop, GridRecord(runs, self._settings) as record:
            for name in remove_half_finished(runs, self._jobs.values(), record.rows):
                console.line(f"{name} was interrupted: removed, it begins again")
            console.line(f"{self._finished(record)} of {len(self._jobs)} jobs are finished; results go to {out}")
            with WorkerPool(do, {**self._settings, "runs": str(runs)}, workers, pinned=pinned) as pool:
                run_grid(
                    record,
                    list(self._jobs),
                    pool,
                    progress=lambda progress: console.status(str(progress)),
                    failed=report_failure,
                    asked_to_stop=lambda: stop.asked,
                    cost=lambda key: self._cost(self._jobs[key]),
                )
            whole = not stop.asked or self._finished(record) == len(self._jobs)
            self._write_results(record.rows, failures, out if whole else runs / SO_FAR)
            if whole:
                shutil.rmtree(runs / SO_FAR, ignore_errors=True)
            if failures:
                console.error(
                    f"{self._name}: {len(failures)} of {len(self._jobs)} jobs crashed and are missing in the results; "
                    "the same command tries them again"
                )
            if stop.asked:
                console.line(
                    f"interrupted: {self._finished(record)} of {len(self._jobs)} jobs are kept; "
                    "the same command goes on"
                )
                return INTERRUPTED
        return 1 if failures else 0

    def _finished(self, record: GridRecord) -> int:
        return sum(key in record.rows for key in self._jobs)


def refuse_foreign(out: Path) -> None:
    """Raise GridError if a folder holds something, but no study: its files may have the names of the results'."""
    if not out.is_dir() or (runs_folder(out) / "settings.json").exists():
        return
    names = sorted({path.name for path in out.iterdir()} - {runs_folder(out).name})
    if names:
        raise GridError(
            f"{out} holds other files ({', '.join(names[:3])}): expected an empty folder, or one with the "
            f"{runs_folder(out).name}/ of this study; choose another folder with --out"
        )
