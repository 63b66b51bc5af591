"""Target hits as a table: for a spreadsheet, and for reading."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.target_hits.jobs import HitCount


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
    lines = [f"target hits of the initial policy in {steps} steps, resets included: mean ± standard error (seeds)"]
    for task in dict.fromkeys(cell.task for cell in of):
        lines += ["", f"{task:>24}"]
        for cell in of:
            if cell.task == task:
                lines.append(f"{cell.limit:>16} steps  {hits_text(cell.mean, cell.standard_error)} ({cell.seeds})")
    return "\n".join(lines)


def hits_text(mean: float, error: float) -> str:
    """A mean and its standard error, aligned."""
    return f"{mean:6.1f} ± {'  -' if math.isnan(error) else f'{error:3.1f}'}"
