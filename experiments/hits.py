"""``python -m experiments.hits --task T``: how often does the initial policy reach the goal, under each time limit?

The question before any learning (thesis 6.2, 7.3; figures 7.2 and 8.4): tanh of N(0, 1) acts for 20 000 steps, resets
included, and the target hits are counted. ``DIR`` then holds ``hits.csv``, ``hits.png`` and what is needed to go on:
the same command finishes an interrupted grid, and more tasks, limits or seeds are added to what is there.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from common.console import Console
from common.record import write_atomically
from experiments.command_line import exit_code
from experiments.grid import GridRecord
from experiments.loading import uninterrupted
from experiments.target_hits.choice import (
    MOST_SEEDS,
    MOST_WORKERS,
    add_options,
    check_count,
    check_limits,
    choose_task,
    record_settings,
)
from experiments.target_hits.counted_grid import count_grid
from experiments.target_hits.counting import STEPS
from experiments.target_hits.figure import draw_hits
from experiments.target_hits.jobs import all_keys, hit_counts
from experiments.target_hits.table import cells, csv_text, notes, table_text

SEEDS = 30


def main(arguments: Sequence[str] | None = None) -> int:
    """Count from the command line; return the exit code."""
    options = _parser().parse_args(arguments)
    console = Console()
    return exit_code("experiments.hits", "--out", options.out, console, lambda: _count(options, console))


def _count(options: argparse.Namespace, console: Console) -> int:
    limits = check_limits(options.limits)
    seeds = range(check_count("--seeds", options.seeds, MOST_SEEDS))
    steps = check_count("--steps", options.steps)
    workers = check_count("--workers", options.workers, MOST_WORKERS)
    names = list(dict.fromkeys(options.task))
    choices = uninterrupted(lambda: [choose_task(name, options.preset, options.set) for name in names])
    settings = record_settings(choices, steps=steps)
    return count_grid(
        options.out,
        settings,
        all_keys((choice.name for choice in choices), limits, seeds),
        tasks=", ".join(f"{choice.name} ({choice.preset})" for choice in choices),
        workers=workers,
        console=console,
        report=lambda record: write_results(record, steps, console),
    )


def write_results(record: GridRecord, steps: int, console: Console) -> int:
    """Write and show what the record has so far; return the exit code, 0."""
    counts = hit_counts(record.rows)
    if not counts:
        return 0
    path = record.directory / "hits.csv"
    write_atomically(path, csv_text(counts))
    summary = cells(counts)
    draw_hits(record.directory / "hits.png", summary, steps, show_sufficient=steps == STEPS)
    console.line(table_text(summary, steps))
    for note in notes(summary, steps):
        console.line(f"\n{note}")
    console.line(f"\n{path}, {record.directory / 'hits.png'}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m experiments.hits",
        description="Count how often the initial policy reaches the goal under each time limit.",
        epilog="example: python -m experiments.hits --task dot_reacher --limits 10 50 500 --seeds 10 --out runs/dot",
    )
    parser.add_argument(
        "--task", nargs="+", required=True, metavar="T", help="task ids, or id=module:Class for a task of your own"
    )
    parser.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help="for each limit (default: %(default)s)")
    parser.add_argument(
        "--steps", type=int, default=STEPS, metavar="N", help="in which hits are counted (default: %(default)s)"
    )
    add_options(parser, "runs/hits")
    return parser


if __name__ == "__main__":
    sys.exit(main())
