"""``python -m experiments.minimum_time``: what learning makes of several time limits, and whether hits foretell it.

Trains every task of a study under its time limits with several seeds, counts the hits of the initial policies, and
writes tables, figures and a README. What is finished is kept: the same command goes on where it was interrupted.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from deploy.console import Console
from experiments.command_line import exit_code
from experiments.grid import Row, duration_text
from experiments.minimum_time.figures import draw_figures
from experiments.minimum_time.jobs import work
from experiments.minimum_time.plan import Plan
from experiments.minimum_time.report import table_text, write_report
from experiments.minimum_time.results import collect
from experiments.minimum_time.sizes import SIZES, Size
from experiments.minimum_time.tables import write_tables
from experiments.study import Study
from experiments.target_hits.choice import check_count, usable_cores
from experiments.workers import Key, Work

_NAME = "experiments.minimum_time"
_RESULTS = Path(__file__).parent / "results"


def run_study(plan: Plan, out: Path, workers: int, console: Console, do: Work = work) -> int:
    """Run what is not finished, write the results of all that is; return the exit code."""
    study = Study(
        _NAME,
        plan.jobs,
        plan.settings(),
        plan.expected_s,
        lambda rows, failures: write_results(plan.size, rows, failures, out, console),
    )
    return study.run(out, workers, console, do)


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


def main(arguments: Sequence[str] | None = None, sizes: Mapping[str, Size] = SIZES, do: Work = work) -> int:
    """Run a study from the command line; return the exit code.

    Args:
        arguments: of the command line.
        sizes: name -> study; the first is the default.
        do: does a job.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m {_NAME}",
        description="Learning curves under several time limits, and what the initial policy's hits foretell of them.",
    )
    parser.add_argument("--size", choices=sizes, default=next(iter(sizes)), help="of the study (default: %(default)s)")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="of the results (default: experiments/minimum_time/results/SIZE)"
    )
    parser.add_argument(
        "--workers", type=int, default=usable_cores(), metavar="N", help="processes (default: one a core, %(default)s)"
    )
    parser.add_argument("--plan", action="store_true", help="say what would be run and how long it takes; run nothing")
    options = parser.parse_args(arguments)
    console = Console()
    out: Path = options.out or _RESULTS / options.size

    def study() -> int:
        workers = check_count("--workers", options.workers)
        plan = Plan(sizes[options.size])
        if options.plan:
            console.line(plan.text(workers))
            return 0
        return run_study(plan, out.absolute(), workers, console, do)

    return exit_code(_NAME, "--out", out, console, study)


if __name__ == "__main__":
    sys.exit(main())
