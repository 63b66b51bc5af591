"""``python -m experiments.robot_hits``: is a simulated robot's task as difficult as the real robot's was?

The thesis counted the target hits of the initial policy on the real robots (table 8.1). The same count on the
simulated ones, images and masks included, has to come out in the same range. Exit code 1 if the mean over seeds lies
outside of a range that is required; the ranges are of 20 000 steps, and after another number nothing is judged. ``DIR``
then holds ``hits.csv`` and ``robot_hits.txt``; the same command finishes an interrupted count.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from common.console import Console
from common.errors import ConfigError
from common.options import output_folder
from common.record import write_atomically
from experiments.command_line import exit_code
from experiments.grid import GridRecord
from experiments.loading import uninterrupted
from experiments.target_hits.choice import (
    MOST_SEEDS,
    MOST_WORKERS,
    TaskChoice,
    check_count,
    choose_task,
    record_settings,
    usable_cores,
)
from experiments.target_hits.counted_grid import count_grid
from experiments.target_hits.counting import STEPS
from experiments.target_hits.jobs import HitCount, hit_counts, hits_key
from experiments.target_hits.table import cells, csv_text, hits_text

SEEDS = 5
"""As many as the thesis's runs of each robot."""


@dataclass(frozen=True)
class ThesisHits:
    """A cell of table 8.1, and the range in which the simulated robot has to be."""

    task: str
    limit_s: float
    """Time limit, seconds."""
    thesis: str
    """Mean +- standard error over five runs."""
    low: float = -math.inf
    high: float = math.inf

    @property
    def required(self) -> bool:
        """True if there is a range; otherwise the count is only reported."""
        return math.isfinite(self.low)


TABLE = (
    ThesisHits("ur5_visual_reacher_min_time", 6.0, "14.4 ± 2.5", 10, 19),
    ThesisHits("franka_visual_reacher", 3.0, "12.6 ± 1.0", 8, 18),
    ThesisHits("franka_visual_reacher", 6.0, "13.0 ± 2.1"),
    ThesisHits("franka_visual_reacher", 30.0, "7.8 ± 0.9"),
    ThesisHits("create_reacher", 15.0, "18.8 ± 3.9", 13, 26),
    ThesisHits("vector_charger_detector", 30.0, "11.0 ± 1.1", 7, 16),
)
"""Table 8.1, the robots that are simulated."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Count from the command line; return the exit code."""
    options = _parser().parse_args(arguments)
    console = Console()
    return exit_code("experiments.robot_hits", "--out", options.out, console, lambda: _count(options, console, TABLE))


def _count(options: argparse.Namespace, console: Console, table: Sequence[ThesisHits]) -> int:
    seeds = range(check_count("--seeds", options.seeds, MOST_SEEDS))
    steps = check_count("--steps", options.steps)
    workers = check_count("--workers", options.workers, MOST_WORKERS)
    rows = chosen_rows(table, options.task)
    choices = uninterrupted(lambda: {row.task: choose_task(row.task) for row in rows})
    limits = {row: limit_steps(row, choices[row.task]) for row in rows}

    def report(record: GridRecord) -> int:
        counts = hit_counts(record.rows)
        text = report_text(limits, counts, steps)
        write_atomically(record.directory / "hits.csv", csv_text(counts))
        write_atomically(record.directory / "robot_hits.txt", f"{text}\n")
        console.line(f"{text}\n\n{record.directory / 'robot_hits.txt'}")
        good_enough = all(inside(row, limit, counts) for row, limit in limits.items())
        return 0 if good_enough or steps != STEPS else 1

    return count_grid(
        options.out,
        record_settings(list(choices.values()), steps=steps),
        [hits_key(row.task, limit, seed) for seed in seeds for row, limit in limits.items()],
        tasks=", ".join(f"{row.task} {row.limit_s:g} s" for row in rows),
        workers=workers,
        console=console,
        report=report,
    )


def chosen_rows(table: Sequence[ThesisHits], tasks: Sequence[str] | None) -> list[ThesisHits]:
    """The rows of these tasks; of all tasks if None are named.

    Raises:
        ConfigError: a task is not in the table.
    """
    known = list(dict.fromkeys(row.task for row in table))
    for task in tasks or ():
        if task not in known:
            raise ConfigError(f"--task {task}: expected one of {', '.join(known)}, the robots of table 8.1")
    return [row for row in table if not tasks or row.task in tasks]


def limit_steps(row: ThesisHits, choice: TaskChoice) -> int:
    """The row's time limit in action cycles of the task."""
    task = choice.build(np.random.default_rng(0))
    task.close()
    return round(row.limit_s / task.spec.action_cycle_time_s)


def inside(row: ThesisHits, limit: int, counts: Sequence[HitCount]) -> bool:
    """Whether the mean lies in the row's range, if one is required."""
    (cell,) = cells(count for count in counts if (count.task, count.limit) == (row.task, limit)) or (None,)
    return not row.required or (cell is not None and row.low <= cell.mean <= row.high)


def report_text(limits: dict[ThesisHits, int], counts: Sequence[HitCount], steps: int) -> str:
    """What was counted, beside the thesis."""
    lines = [
        f"target hits of the initial policy in {steps} steps, resets included: mean ± standard error (seeds)",
        "",
        f"{'task':<30}{'limit':>7}  {'here':<20}{'thesis':<14}required",
    ]
    for row, limit in limits.items():
        found = cells(count for count in counts if (count.task, count.limit) == (row.task, limit))
        here = f"{hits_text(found[0].mean, found[0].standard_error)} ({found[0].seeds})" if found else "not counted"
        verdict = "yes" if inside(row, limit, counts) else "NO"
        required = f"{row.low:g} to {row.high:g}" if row.required else "-"
        if row.required and steps == STEPS:
            required += f": {verdict}"
        lines.append(f"{row.task:<30}{row.limit_s:>5g} s  {here:<20}{row.thesis:<14}{required}")
    if steps != STEPS:
        lines += ["", f"the thesis's counts and the ranges are of {STEPS} steps: nothing is judged"]
    return "\n".join(lines)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m experiments.robot_hits",
        description="Count the initial policy's target hits on the simulated robots; compare with table 8.1.",
        epilog="example: python -m experiments.robot_hits --task ur5_visual_reacher_min_time --workers 1",
    )
    parser.add_argument("--task", nargs="+", metavar="T", help="task ids (default: all of table 8.1)")
    parser.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help="of each task (default: %(default)s)")
    parser.add_argument(
        "--steps", type=int, default=STEPS, metavar="N", help="in which hits are counted (default: %(default)s)"
    )
    parser.add_argument(
        "--workers", type=int, default=usable_cores(), metavar="N", help="processes (default: one a core, %(default)s)"
    )
    parser.add_argument(
        "--out", type=output_folder, default="runs/robot_hits", metavar="DIR", help="folder (default: %(default)s)"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
