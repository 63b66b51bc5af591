"""The command line that the studies have in common: a size, a folder, a number of processes, or only the plan."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from common.console import Console
from common.options import output_folder
from experiments.command_line import exit_code
from experiments.grid import Row
from experiments.run_folders import FolderJob
from experiments.study import Study, refuse_foreign
from experiments.target_hits.choice import MOST_WORKERS, check_count, usable_cores
from experiments.workers import Key, Work

ASize = TypeVar("ASize")
AJob = TypeVar("AJob", bound=FolderJob)


class StudyPlan(Protocol[AJob]):
    """A study made ready."""

    @property
    def jobs(self) -> Mapping[Key, AJob]:
        """In the order in which they are begun."""

    def settings(self) -> Mapping[str, Any]:
        """What the rows depend on besides their keys."""

    def expected_s(self, job: AJob) -> float:
        """Seconds that a job takes one core, roughly."""

    def text(self, workers: int) -> str:
        """What there is to do, and how long it will take."""


WriteResults = Callable[[ASize, Mapping[Key, Row], Mapping[Key, str], Path, Console], None]
"""Writes tables, figures and README of the finished jobs into a folder, and shows the tables.

Given the size, rows of the finished jobs, why others have none, the folder, and where to show.
"""


@dataclass(frozen=True)
class StudyProgram(Generic[ASize, AJob]):
    """``python -m NAME``."""

    name: str
    description: str
    results: Path
    """Below it, by the sizes' names, what is not sent elsewhere by ``--out``."""
    plan: Callable[[ASize], StudyPlan[AJob]]
    write_results: WriteResults[ASize]
    real_time: Callable[[ASize], bool] = lambda size: False
    """Whether a size's jobs go by the clock. Then one is done at a time, on all cores; else each has a core."""

    def main(self, arguments: Sequence[str] | None, sizes: Mapping[str, ASize], work: Work) -> int:
        """Run a study from the command line; return the exit code.

        Args:
            arguments: of the command line.
            sizes: name -> study; the first is the default.
            work: does a job.
        """
        options = self._parser(sizes).parse_args(arguments)
        console = Console()
        size = sizes[options.size]
        out: Path = options.out or self.results / options.size
        folder = out.absolute()

        def run() -> int:
            workers = check_count("--workers", options.workers, MOST_WORKERS)
            real_time = self.real_time(size)
            if real_time:
                workers = 1
            plan = self.plan(size)
            if options.plan:
                console.line(plan.text(workers))
                return 0
            study = Study(
                self.name,
                plan.jobs,
                plan.settings(),
                plan.expected_s,
                lambda rows, failures, into: self.write_results(size, rows, failures, into, console),
            )
            if folder != (self.results / options.size).absolute():  # there, published results are to be replaced
                refuse_foreign(folder)
            return study.run(folder, workers, console, work, pinned=not real_time)

        return exit_code(self.name, "--out", out, console, run)

    def _parser(self, sizes: Mapping[str, ASize]) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(prog=f"python -m {self.name}", description=self.description)
        parser.add_argument(
            "--size", choices=sizes, default=next(iter(sizes)), help="of the study (default: %(default)s)"
        )
        default = f"{self.results.parent.parent.name}/{self.results.parent.name}/{self.results.name}/SIZE"
        parser.add_argument("--out", type=output_folder, metavar="DIR", help=f"of the results (default: {default})")
        parser.add_argument(
            "--workers",
            type=int,
            default=usable_cores(),
            metavar="N",
            help="processes (default: one a core, %(default)s)",
        )
        parser.add_argument(
            "--plan", action="store_true", help="say what would be run and how long it takes; run nothing"
        )
        return parser
