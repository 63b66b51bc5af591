"""Ours against the baseline: each side in its own process, rounds in turn, medians."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.side_process import SideError, SideProcess
from benchmarks.table import Budget, Row, judge


@dataclass(frozen=True)
class Side:
    """One way of doing the same thing."""

    function: str
    """``MODULE:FUNCTION`` that prepares it, see :mod:`benchmarks.side_program`."""
    options: Mapping[str, Any] = field(default_factory=dict)
    tolerance: float = 1e-3
    """How far its result may be from the baseline's, as a share of the largest number in that."""


@dataclass(frozen=True)
class RowPlan:
    """A row that a comparison will yield."""

    name: str
    """What is measured, and its unit."""
    budget: Budget
    ours: str
    """Name of our side."""
    baseline: str | None = None
    """Name of the side it is compared with; None for an absolute budget."""


@dataclass(frozen=True)
class Comparison:
    """Sides that are measured in turn, and the rows that follow."""

    sides: Mapping[str, Side]
    plans: tuple[RowPlan, ...]
    rounds: int
    """Rounds of each side; the machine's other work changes from one to the next."""

    def only(self, wanted: Callable[[str], bool]) -> Comparison | None:
        """Return what is left if only rows with a ``wanted`` name are kept; None if that is nothing."""
        plans = tuple(plan for plan in self.plans if wanted(plan.name))
        needed = {side for plan in plans for side in (plan.ours, plan.baseline)}
        sides = {name: side for name, side in self.sides.items() if name in needed}
        return replace(self, sides=sides, plans=plans) if plans else None

    def quick(self) -> Comparison:
        """Return the same with a single round: does it run? Its numbers mean little."""
        return replace(self, rounds=1)


def run(comparison: Comparison, progress: Callable[[str], None]) -> list[Row]:
    """Measure and judge.

    Raises:
        SideError: a side failed, or the sides' results differ.
        UnavailableError: this computer lacks what a side needs.
    """
    with ExitStack() as resources:
        scratch = Path(resources.enter_context(TemporaryDirectory(prefix="relod-bench-")))
        processes: dict[str, SideProcess] = {}
        for name, side in comparison.sides.items():
            progress(f"preparing {name}")
            processes[name] = resources.enter_context(SideProcess(side.function, side.options, scratch))
            processes[name].wait_until_ready()
        check_agreement(comparison, {name: process.result for name, process in processes.items()})
        rounds: dict[str, list[float]] = {name: [] for name in processes}
        for number in range(comparison.rounds):
            progress(f"round {number + 1} of {comparison.rounds}")
            for name, process in processes.items():
                rounds[name].append(median(process.measure()))
    return rows_of(comparison.plans, rounds)


def rows_of(plans: Iterable[RowPlan], rounds: Mapping[str, Sequence[float]]) -> list[Row]:
    """Return the rows of what each side measured: side -> one number per round."""
    medians = {name: median(numbers) for name, numbers in rounds.items()}
    return [
        judge(plan.name, plan.budget, medians[plan.ours], None if plan.baseline is None else medians[plan.baseline])
        for plan in plans
    ]


def check_agreement(comparison: Comparison, results: Mapping[str, Sequence[float]]) -> None:
    """Fail unless every side computed what its baseline computed: only the same work may be compared.

    Raises:
        SideError: naming the sides and the numbers that differ most.
    """
    for plan in comparison.plans:
        if plan.baseline is None:
            continue
        ours, theirs = results[plan.ours], results[plan.baseline]
        if len(ours) != len(theirs):
            raise SideError(f"{plan.ours} gave {len(ours)} results, {plan.baseline} {len(theirs)}: not the same work")
        largest = max((abs(value) for value in theirs), default=0.0)
        tolerance = comparison.sides[plan.ours].tolerance * largest
        for mine, other in zip(ours, theirs, strict=True):
            if not abs(mine - other) <= tolerance:
                raise SideError(
                    f"{plan.ours} computed {mine:g}, {plan.baseline} {other:g}: expected the same within {tolerance:g}"
                )
