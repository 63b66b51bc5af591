"""The table that the benchmarks end in: what was measured, against what budget, and whether it holds."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Literal

DIGITS = 4
"""Significant digits of the numbers in the table; budgets are judged before rounding."""


@dataclass(frozen=True)
class Budget:
    """What a row has to keep: a bound of a ratio, or of our own number where there is no baseline."""

    relation: Literal["<", "<=", ">="]
    limit: float
    unit: str = "x"
    """``x`` for a ratio; else the unit of an absolute budget."""

    def holds(self, value: float) -> bool:
        """Return True if ``value`` keeps the budget; what is not a number does not."""
        if self.relation == ">=":
            return value >= self.limit
        return value < self.limit if self.relation == "<" else value <= self.limit

    def __str__(self) -> str:
        return f"{self.relation} {self.limit:g}{'' if self.unit == 'x' else ' '}{self.unit}"


@dataclass(frozen=True)
class Row:
    """One row of the table, and of ``bench.json``."""

    name: str
    """What was measured, and its unit."""
    ours: float | None
    """None if it could not be measured."""
    baseline: float | None
    """The plain side's number; None for an absolute budget."""
    ratio: float | None
    """How many times less than the baseline (``>=`` budgets), or the share of it (``<=``); None without baseline."""
    budget: str
    ok: bool


def judge(name: str, budget: Budget, ours: float, baseline: float | None = None) -> Row:
    """Return the row of a measurement.

    Args:
        name: what was measured, and its unit.
        budget: for the ratio if there is a baseline, else for ``ours``.
        ours: our side's number.
        baseline: the plain side's; both are costs (time, bytes), so less is better.
    """
    if baseline is None:
        return Row(name, _rounded(ours), None, None, str(budget), budget.holds(ours))
    numerator, denominator = (baseline, ours) if budget.relation == ">=" else (ours, baseline)
    ratio = numerator / denominator if denominator else math.nan
    return Row(name, _rounded(ours), _rounded(baseline), _rounded(ratio), str(budget), budget.holds(ratio))


def unmeasured(name: str, budget: Budget) -> Row:
    """Return the row of a measurement that failed: a budget nobody has measured does not hold."""
    return Row(name, None, None, None, str(budget), ok=False)


def exit_code(rows: Iterable[Row]) -> int:
    """Return 0 if every budget holds, else 1."""
    return 0 if all(row.ok for row in rows) else 1


def to_json(rows: Sequence[Row]) -> str:
    """Return the rows as JSON: a list of objects with the fields of :class:`Row`."""
    return json.dumps([asdict(row) for row in rows], indent=1, allow_nan=False) + "\n"


def to_text(rows: Sequence[Row]) -> str:
    """Return the table for the terminal."""
    header = ("name", "ours", "baseline", "ratio", "budget", "ok")
    cells = [header, *(_cells(row) for row in rows)]
    widths = [max(len(line[column]) for line in cells) for column in range(len(header))]
    left = (0, 4, 5)
    lines = [
        "  ".join(
            cell.ljust(width) if column in left else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in cells
    ]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])


def _cells(row: Row) -> tuple[str, ...]:
    numbers = ["-" if value is None else f"{value:.9g}" for value in (row.ours, row.baseline)]
    ratio = "-" if row.ratio is None else f"{row.ratio:g}x"
    return (row.name, *numbers, ratio, row.budget, "yes" if row.ok else "NO")


def _rounded(value: float) -> float | None:
    return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
