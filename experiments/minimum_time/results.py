"""What a study has found so far, put together from the rows of its jobs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from experiments.grid import Row
from experiments.intervals import Interval, interval, mean_and_half_width
from experiments.minimum_time.curves import curve_steps, final_steps_per_goal, goals_within, return_curve
from experiments.minimum_time.sizes import Figure, Panel, Size
from experiments.workers import Key

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class RunResult:
    """A finished run."""

    seed: int
    steps: int
    goal_steps: tuple[int, ...]
    """Steps of the run at which goals were reached."""

    @property
    def goals(self) -> int:
        """In the whole run."""
        return len(self.goal_steps)

    @property
    def last_goals(self) -> int:
        """In the last 1000 steps."""
        return goals_within(self.goal_steps, self.steps)

    @property
    def steps_per_goal(self) -> float:
        """Final performance; see :func:`final_steps_per_goal`."""
        return final_steps_per_goal(self.goal_steps, self.steps)


@dataclass(frozen=True)
class Band:
    """A mean with its 95 % band (Student's t), point by point; NaN around a single run."""

    mean: FloatArray
    """(n,)"""
    low: FloatArray
    """(n,)"""
    high: FloatArray
    """(n,)"""


@dataclass(frozen=True)
class CurveResult:
    """One task, time limit and head: its runs, and the hits of its initial policy."""

    panel: Panel
    limit: int
    head: str
    window: int
    runs: tuple[RunResult, ...]
    """Finished ones."""
    missing: Mapping[int, str]
    """Seed -> why there is no run."""
    hits: Mapping[int, int]
    """Seed -> hits in 20 000 steps."""

    @property
    def final(self) -> Interval:
        """Steps per goal at the end."""
        return interval([run.steps_per_goal for run in self.runs])

    @property
    def goals(self) -> Interval:
        """Goals of a whole run."""
        return interval([run.goals for run in self.runs])

    @property
    def without_goal(self) -> int:
        """Runs that reached no goal in their last 1000 steps."""
        return sum(run.last_goals == 0 for run in self.runs)

    @cached_property
    def at(self) -> FloatArray:
        """(n,) steps at which the curve is given."""
        return curve_steps(self.panel.steps, self.window)

    @cached_property
    def curve(self) -> Band:
        """Mean return over the runs, as the thesis shows it."""
        mean, half = mean_and_half_width(self._returns)
        return Band(mean, mean - half, mean + half)

    @cached_property
    def geometric_curve(self) -> Band:
        """Geometric mean return over the runs: one hapless run does not outweigh all others."""
        mean, half = mean_and_half_width(np.log(-self._returns))
        return Band(-np.exp(mean), -np.exp(mean + half), -np.exp(mean - half))

    @cached_property
    def _returns(self) -> FloatArray:
        """(runs, n)"""
        return np.stack([return_curve(run.goal_steps, self.at, self.window) for run in self.runs])


@dataclass(frozen=True)
class PanelResult:
    """The curves of one panel."""

    panel: Panel
    curves: tuple[CurveResult, ...]

    @property
    def title(self) -> str:
        """The task, and its preset where it has several."""
        return f"{self.panel.task} ({self.panel.preset})" if self.panel.preset else self.panel.task

    @property
    def compares_heads(self) -> bool:
        """Whether the curves differ in the initialisation of the head."""
        return len(self.panel.heads) > 1

    @property
    def comparable(self) -> list[CurveResult]:
        """Curves with runs and hits."""
        return [curve for curve in self.curves if curve.runs and curve.hits]


@dataclass(frozen=True)
class StudyResult:
    """All of it."""

    size: Size
    figures: tuple[tuple[Figure, tuple[PanelResult, ...]], ...]

    @property
    def panels(self) -> list[PanelResult]:
        """Of all figures."""
        return [panel for _, panels in self.figures for panel in panels]

    @property
    def curves(self) -> list[CurveResult]:
        """All curves, one that is in several figures once."""
        curves = {
            (c.panel.task, c.panel.preset, c.limit, c.head, c.panel.steps): c for p in self.panels for c in p.curves
        }
        return list(curves.values())


def collect(size: Size, rows: Mapping[Key, Row], failures: Mapping[Key, str]) -> StudyResult:
    """Put a study's results together.

    Args:
        size: what was to be done.
        rows: of the finished jobs.
        failures: why a job has no row.
    """

    def curve_result(panel: Panel, limit: int, head: str) -> CurveResult:
        trainings = size.training_jobs(panel, limit, head)
        return CurveResult(
            panel=panel,
            limit=limit,
            head=head,
            window=size.window,
            runs=tuple(
                RunResult(job.seed, job.steps, tuple(rows[job.key]["goal_steps"]))
                for job in trainings
                if job.key in rows
            ),
            missing={job.seed: failures.get(job.key, "not run yet") for job in trainings if job.key not in rows},
            hits={
                job.seed: int(rows[job.key]["hits"]) for job in size.hits_jobs(panel, limit, head) if job.key in rows
            },
        )

    return StudyResult(
        size,
        tuple(
            (
                figure,
                tuple(
                    PanelResult(panel, tuple(curve_result(panel, limit, head) for limit, head in panel.curves))
                    for panel in figure.panels
                ),
            )
            for figure in size.figures
        ),
    )
