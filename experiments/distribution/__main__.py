"""``python -m experiments.distribution``: which distribution of the computations learns best.

Trains every configuration of a study with several seeds, and writes tables, figures and a README. What is finished is
kept: the same command goes on where it was interrupted.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from common.console import Console
from experiments.distribution.figures import draw_figures
from experiments.distribution.jobs import work
from experiments.distribution.plan import Plan
from experiments.distribution.report import table_text, write_report, write_tables
from experiments.distribution.results import collect
from experiments.distribution.sizes import SIZES, Size
from experiments.grid import Row, duration_text
from experiments.study_program import StudyProgram
from experiments.workers import Key, Work

_NAME = "experiments.distribution"


def write_results(
    size: Size, rows: Mapping[Key, Row], failures: Mapping[Key, str], out: Path, console: Console
) -> None:
    """Write tables, figures and README of the finished jobs, and show the tables."""
    study = collect(size, rows, failures)
    if not any(result.runs for result in study.configurations):
        return
    paths = write_tables(out, study)
    figures = draw_figures(out, study)
    paths += [*figures, write_report(out, study, f"python -m {_NAME} --size {size.name}", figures)]
    console.line(table_text(study))
    core_s = sum(run.row["core_s"] for result in study.configurations for run in result.runs)
    console.line(f"training took {duration_text(core_s)} of one core")
    for path in paths:
        console.line(str(path))


PROGRAM = StudyProgram(
    _NAME,
    "How SAC and PPO learn, distributed over hosts and networks.",
    Path(__file__).parent / "results",
    Plan,
    write_results,
    real_time=lambda size: size.real_time,
)


def main(arguments: Sequence[str] | None = None, sizes: Mapping[str, Size] = SIZES, do: Work = work) -> int:
    """Run the study; as :meth:`StudyProgram.main`."""
    return PROGRAM.main(arguments, sizes, do)


if __name__ == "__main__":
    sys.exit(main())
