"""The folder of a study: results on top, what is behind them in ``runs/``, which git ignores.

``runs/`` holds the record of the grid (:mod:`experiments.grid`) and a folder for each run, with all of its record but
the experience itself.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Protocol

from experiments.workers import Key

_CRASHED = ".crashed"
_REBUILDABLE = ("ring", "checkpoint.npz")
"""Files of a finished run that nobody asks for any more, up to gigabytes each."""


class FolderJob(Protocol):
    """A job with a folder of its own."""

    @property
    def key(self) -> Key:
        """The grid's key."""

    @property
    def folder(self) -> str:
        """Name of its folder."""


def runs_folder(out: Path) -> Path:
    """Where the record and the runs' folders are."""
    return out / "runs"


def remove_rebuildable(run_dir: Path) -> None:
    """Remove what takes most of a finished run's space."""
    for name in _REBUILDABLE:
        (run_dir / name).unlink(missing_ok=True)


def remove_half_finished(runs: Path, jobs: Iterable[FolderJob], finished: Collection[Key]) -> list[str]:
    """Remove the folders of runs that were interrupted; return their names.

    A run cannot go on from its middle: it begins again, and gives what it would have given.
    """
    names = [job.folder for job in jobs if job.key not in finished and (runs / job.folder).exists()]
    for name in names:
        shutil.rmtree(runs / name)
    return names


def keep_crashed(runs: Path, job: FolderJob) -> Path | None:
    """Set a crashed run's folder aside, in place of that of an earlier crash; return where it is, if there is one."""
    folder, kept = runs / job.folder, runs / f"{job.folder}{_CRASHED}"
    if not folder.exists():
        return None
    if kept.exists():
        shutil.rmtree(kept)
    folder.rename(kept)
    return kept
