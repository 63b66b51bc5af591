"""A grid of hit counts, run from a command line: progress, interruptions, failures, exit codes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from common.console import Console
from common.stop_signals import INTERRUPTED, StopSignals
from experiments.grid import GridRecord, failure_text, run_grid
from experiments.target_hits.jobs import relative_cost, work
from experiments.wording import counted
from experiments.workers import Key, WorkerPool


def count_grid(
    directory: Path,
    settings: Mapping[str, Any],
    keys: Sequence[Key],
    *,
    tasks: str,
    workers: int,
    console: Console,
    report: Callable[[GridRecord], int],
) -> int:
    """Do the jobs that have no row yet, report on all rows there are, and return the exit code.

    Args:
        directory: of the grid's record.
        settings: of :func:`experiments.target_hits.choice.record_settings`.
        keys: of the jobs.
        tasks: what is counted, to be read.
        workers: processes.
        console: where to tell.
        report: writes and tells what the record has so far; returns the exit code of a grid that is whole.
    """
    with (
        StopSignals() as stop,
        GridRecord(directory, settings) as record,
        WorkerPool(work, settings, workers) as pool,
    ):
        finished = sum(key in record.rows for key in keys)
        there = f", {finished} of them in {directory} already" if finished else ""
        console.line(f"{tasks}: {counted(len(keys), 'job')}{there}")
        failures = run_grid(
            record,
            keys,
            pool,
            progress=lambda progress: console.status(str(progress)),
            failed=lambda failure: console.error(failure_text(failure)),
            asked_to_stop=lambda: stop.asked,
            cost=relative_cost(settings),
        )
        code = report(record)
    if stop.asked:
        console.line("interrupted: the same command goes on from here")
        return INTERRUPTED
    if failures:
        console.error(
            f"{len(failures)} of {counted(len(keys), 'job')} failed (tracebacks: "
            f"{record.directory / 'failures.log'}); the same command tries them again"
        )
        return 1
    return code
