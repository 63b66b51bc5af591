"""Target hits as a table: for a spreadsheet, and for reading."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.target_hits.jobs import HitCount
from experiments.wording import counted, plural

TRIVIAL_ADVICE = (
    "There is nothing to learn, under any limit. Check the task's termination: does an attempt end as terminated only "
    "where the goal is reached, and do starts lie away from it?"
)


@dataclass(frozen=True)
class Cell:
    """A bar of figures 7.2 and 8.4."""

    task: str
    limit: int
    """Time limit, steps."""
    mean: float
    """Hits."""
    standard_error: float
    """Of the mean; NaN with a single seed."""
    seeds: int


def cells(counts: Iterable[HitCount]) -> list[Cell]:
    """Summarise over seeds; tasks by name, limits ascending."""
    hits: dict[tuple[str, int], list[int]] = defaultdict(list)
    for count in counts:
        hits[count.task, count.limit].append(count.hits)
    return [
        Cell(task, limit, float(np.mean(values)), standard_error(values), len(values))
        for (task, limit), values in sorted(hits.items())
    ]


def standard_error(values: Sequence[int]) -> float:
    """Of the mean; NaN for fewer than two values."""
    return float(np.std(values, ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else math.nan


def csv_text(counts: Iterable[HitCount]) -> str:
    """``hits.csv``: one row a job, in the order given; it depends on the jobs alone."""
    rows = [f"{count.task},{count.limit},{count.seed},{count.hits}" for count in counts]
    return "\n".join(["task,limit,seed,hits", *rows]) + "\n"


def table_text(of: Sequence[Cell], steps: int) -> str:
    """The cells, a task a block."""
    lines = [
        f"target hits of the initial policy in {counted(steps, 'step')}, resets included: mean ± standard error (seeds)"
    ]
    for task in dict.fromkeys(cell.task for cell in of):
        lines += ["", f"{task:>24}"]
        for cell in of:
            if cell.task == task:
                steps_text = f"{cell.limit:>16} {plural(cell.limit, 'step'):<5}"
                lines.append(f"{steps_text}  {hits_text(cell.mean, cell.standard_error)} ({cell.seeds})")
    return "\n".join(lines)


def notes(of: Iterable[Cell], steps: int) -> list[str]:
    """What the numbers alone do not say: a sentence for each task that is done as soon as it begins."""
    fastest: dict[str, Cell] = {}
    for cell in of:
        if cell.mean > steps / 2 and (cell.task not in fastest or cell.mean > fastest[cell.task].mean):
            fastest[cell.task] = cell
    return [
        f"{task} is trivial: under {counted(cell.limit, 'step')} the untrained policy reaches the goal every "
        f"{steps / cell.mean:.1f} steps. {TRIVIAL_ADVICE}"
        for task, cell in fastest.items()
    ]


def hits_text(mean: float, error: float) -> str:
    """A mean and its standard error, aligned."""
    return f"{mean:6.1f} ± {'  -' if math.isnan(error) else f'{error:3.1f}'}"
