"""``python -m experiments.distribution``: which distribution of the computations learns best, in virtual time.

Trains every configuration of a study with several seeds, and writes tables, figures and a README. What is finished is
kept: the same command goes on where it was interrupted.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from deploy.console import Console
from experiments.command_line import exit_code
from experiments.distribution.figures import draw_figures
from experiments.distribution.jobs import work
from experiments.distribution.plan import Plan
from experiments.distribution.report import table_text, write_report, write_tables
from experiments.distribution.results import collect
from experiments.distribution.sizes import SIZES, Size
from experiments.grid import Row, duration_text
from experiments.study import Study
from experiments.target_hits.choice import check_count, usable_cores
from experiments.workers import Key, Work

_NAME = "experiments.distribution"
_RESULTS = Path(__file__).parent / "results"


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


def main(arguments: Sequence[str] | None = None, sizes: Mapping[str, Size] = SIZES, do: Work = work) -> int:
    """Run a study from the command line; return the exit code.

    Args:
        arguments: of the command line.
        sizes: name -> study; the first is the default.
        do: does a job.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m {_NAME}", description="How SAC and PPO learn, distributed over hosts and networks."
    )
    parser.add_argument("--size", choices=sizes, default=next(iter(sizes)), help="of the study (default: %(default)s)")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="of the results (default: experiments/distribution/results/SIZE)"
    )
    parser.add_argument(
        "--workers", type=int, default=usable_cores(), metavar="N", help="processes (default: one a core, %(default)s)"
    )
    parser.add_argument("--plan", action="store_true", help="say what would be run and how long it takes; run nothing")
    options = parser.parse_args(arguments)
    console = Console()
    out: Path = options.out or _RESULTS / options.size

    def run() -> int:
        workers = check_count("--workers", options.workers)
        plan = Plan(sizes[options.size])
        if options.plan:
            console.line(plan.text(workers))
            return 0
        study = Study(
            _NAME,
            plan.jobs,
            plan.settings(),
            plan.size.expected_s,
            lambda rows, failures: write_results(plan.size, rows, failures, out.absolute(), console),
        )
        return study.run(out.absolute(), workers, console, do)

    return exit_code(_NAME, "--out", out, console, run)


if __name__ == "__main__":
    sys.exit(main())
