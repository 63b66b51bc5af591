"""``python -m experiments.minimum_time``: what learning makes of several time limits, and whether hits foretell it.

Trains every task of a study under its time limits with several seeds, counts the hits of the initial policies, and
writes tables, figures and a README. What is finished is kept: the same command goes on where it was interrupted.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from common.console import Console
from experiments.grid import Row, duration_text
from experiments.minimum_time.figures import draw_figures
from experiments.minimum_time.jobs import work
from experiments.minimum_time.plan import Plan
from experiments.minimum_time.report import table_text, write_report
from experiments.minimum_time.results import collect
from experiments.minimum_time.sizes import SIZES, Size
from experiments.minimum_time.tables import write_tables
from experiments.study_program import StudyProgram
from experiments.workers import Key, Work

_NAME = "experiments.minimum_time"


def write_results(
    size: Size, rows: Mapping[Key, Row], failures: Mapping[Key, str], out: Path, console: Console
) -> None:
    """Write tables, figures and README of the finished jobs, and show the tables."""
    study = collect(size, rows, failures)
    if not any(curve.runs for curve in study.curves):
        return
    paths = write_tables(out, study)
    figures = draw_figures(out, study)
    paths += [*figures, write_report(out, study, f"python -m {_NAME} --size {size.name}", figures)]
    console.line(table_text(study))
    console.line(f"training took {duration_text(sum(row.get('core_s', 0.0) for row in rows.values()))} of one core")
    for path in paths:
        console.line(str(path))


PROGRAM = StudyProgram(
    _NAME,
    "Learning curves under several time limits, and what the initial policy's hits foretell of them.",
    Path(__file__).parent / "results",
    Plan,
    write_results,
)


def main(arguments: Sequence[str] | None = None, sizes: Mapping[str, Size] = SIZES, do: Work = work) -> int:
    """Run the study; as :meth:`StudyProgram.main`."""
    return PROGRAM.main(arguments, sizes, do)


if __name__ == "__main__":
    sys.exit(main())
