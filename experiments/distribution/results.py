"""What a study has found so far, put together from the rows of its jobs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.distribution.configurations import QUESTIONS, Configuration, Question
from experiments.distribution.sizes import Panel, Size
from experiments.grid import Row
from experiments.intervals import Interval, interval, mean_and_half_width
from experiments.minimum_time.curves import curve_steps, return_curve
from experiments.workers import Key

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class RunResult:
    """A finished run."""

    seed: int
    steps: int
    row: Row

    @property
    def goals(self) -> int:
        """In the whole run."""
        return len(self.row["goal_steps"])

    @property
    def steps_per_goal(self) -> float:
        """Over the run; without a goal, as if there had been one at its end, which is at most what is true."""
        return self.steps / max(self.goals, 1)


@dataclass(frozen=True)
class ConfigurationResult:
    """The runs of one configuration."""

    panel: Panel
    configuration: Configuration
    runs: tuple[RunResult, ...]
    missing: Mapping[int, str]
    """Seed -> why there is no run."""

    @property
    def steps_per_goal(self) -> Interval:
        """Mean over the seeds."""
        return interval([run.steps_per_goal for run in self.runs])

    @property
    def without_goal(self) -> int:
        """Runs that reached none."""
        return sum(run.goals == 0 for run in self.runs)

    def mean(self, column: str) -> Interval:
        """Of a column of the rows."""
        return interval([float(run.row[column]) for run in self.runs])

    @property
    def lost(self) -> int:
        """Time steps of all runs."""
        return sum(int(run.row["lost"]) for run in self.runs)

    @property
    def at(self) -> FloatArray:
        """(n,) steps at which the curve is given."""
        return curve_steps(self.panel.steps, self.panel.window)

    @cached_property
    def curve(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(n,) each: geometric mean of the steps per goal in the window before each of :attr:`at`, and its 95 % band.

        By the logarithms: before the first goals runs differ by factors, not by steps.
        """
        lengths = np.stack([-return_curve(run.row["goal_steps"], self.at, self.panel.window) for run in self.runs])
        mean, half = mean_and_half_width(np.log(lengths))
        return np.exp(mean), np.exp(mean - half), np.exp(mean + half)


@dataclass(frozen=True)
class Answer:
    """How two configurations compare."""

    question: Question
    pairs: int
    """Seeds that both have."""
    ratio: float
    """Of the steps per goal: geometric mean over the pairs; above 1: worse than what it is held against."""
    low: float
    """Of its 95 % interval; NaN for one pair."""
    high: float
    ratio_of_means: float
    """Over all seeds of either: what the question's bar is about."""
    keeps_bar: bool | None
    """None: there is no bar."""

    @property
    def verdict(self) -> str:
        """What that is enough to say."""
        if math.isnan(self.low) or self.low <= 1.0 <= self.high:
            return "cannot be told apart"
        return "needs more steps per goal" if self.low > 1.0 else "needs fewer steps per goal"


def _answer(question: Question, result: ConfigurationResult, against: ConfigurationResult) -> Answer | None:
    """The answer; None where no seed is common to both."""
    left, right = ({run.seed: run.steps_per_goal for run in each.runs} for each in (result, against))
    seeds = sorted(left.keys() & right.keys())
    if not seeds:
        return None
    logarithm = interval([math.log(left[seed] / right[seed]) for seed in seeds])
    mean, other = result.steps_per_goal, against.steps_per_goal
    return Answer(
        question,
        len(seeds),
        *(math.exp(value) for value in (logarithm.mean, logarithm.low, logarithm.high)),
        ratio_of_means=mean.mean / other.mean,
        keeps_bar=None if question.bar is None else question.bar.holds(mean, other),
    )


@dataclass(frozen=True)
class PanelResult:
    """All configurations of a panel."""

    panel: Panel
    configurations: tuple[ConfigurationResult, ...]

    @property
    def measured(self) -> list[ConfigurationResult]:
        """Those with runs."""
        return [result for result in self.configurations if result.runs]

    @property
    def answers(self) -> list[Answer]:
        """To the questions about this panel's configurations."""
        results = {result.configuration.name: result for result in self.measured}
        return [
            answer
            for question in QUESTIONS
            if {question.configuration, question.against} <= set(results)
            and (answer := _answer(question, results[question.configuration], results[question.against]))
        ]


@dataclass(frozen=True)
class StudyResult:
    """All of it."""

    size: Size
    panels: tuple[PanelResult, ...]

    @property
    def configurations(self) -> list[ConfigurationResult]:
        """Of all panels, each once: two may show the same runs."""
        results: dict[tuple[str, str, int], ConfigurationResult] = {}
        for panel in self.panels:
            for result in panel.configurations:
                results.setdefault((result.configuration.name, result.panel.task, result.panel.steps), result)
        return list(results.values())


def collect(size: Size, rows: Mapping[Key, Row], failures: Mapping[Key, str]) -> StudyResult:
    """Put a study's results together.

    Args:
        size: what was to be done.
        rows: of the finished jobs.
        failures: why a job has no row.
    """

    def result(panel: Panel, configuration: Configuration) -> ConfigurationResult:
        jobs = [panel.job(configuration, seed) for seed in range(panel.seeds)]
        return ConfigurationResult(
            panel,
            configuration,
            tuple(RunResult(job.seed, job.steps, rows[job.key]) for job in jobs if job.key in rows),
            {job.seed: failures.get(job.key, "not run yet") for job in jobs if job.key not in rows},
        )

    return StudyResult(
        size,
        tuple(PanelResult(panel, tuple(result(panel, each) for each in panel.configurations)) for panel in size.panels),
    )


def run_rows(study: StudyResult) -> list[dict[str, Any]]:
    """Rows of ``results.csv``: one a run, also of those that failed."""
    rows: list[dict[str, Any]] = []
    for result in study.configurations:
        of_all = {
            "configuration": result.configuration.name,
            "task": result.panel.task,
            "steps": result.panel.steps,
        }
        for run in result.runs:
            rows.append(
                {
                    **of_all,
                    "seed": run.seed,
                    "goals": run.goals,
                    "steps_per_goal": f"{run.steps_per_goal:.3f}",
                    "observation_to_action_p50_ms": f"{run.row['p50_ms']:.3f}",
                    "late_share": f"{run.row['late']:.5f}",
                    "lost": run.row["lost"],
                    "updates": run.row["updates"],
                    **{f"{part}_ms": run.row["age_ms"][part] for part in ("uplink", "inference", "downlink")},
                    "status": "finished",
                }
            )
        rows += [{**of_all, "seed": seed, "status": reason} for seed, reason in result.missing.items()]
    return sorted(rows, key=lambda row: row["status"] != "finished")  # The first one names the columns.


def curve_rows(study: StudyResult) -> list[dict[str, Any]]:
    """Rows of ``curves.csv``: one a point of a learning curve."""
    return [
        {
            "configuration": result.configuration.name,
            "task": result.panel.task,
            "step": int(at),
            "runs": len(result.runs),
            "steps_per_goal": f"{mean:.3f}",
            "low": "" if math.isnan(low) else f"{low:.3f}",
            "high": "" if math.isnan(high) else f"{high:.3f}",
        }
        for result in study.configurations
        if result.runs
        for at, mean, low, high in zip(result.at, *result.curve, strict=True)
    ]
