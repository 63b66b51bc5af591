"""A study made ready: its tasks exist, its jobs are known, and how long they take."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from common.algorithms.presets import resolve_config
from common.errors import ConfigError
from common.messages import TaskSpec
from experiments.grid import duration_text
from experiments.minimum_time.jobs import Job, task_settings
from experiments.minimum_time.sizes import Size, expected_s
from services.robot_bridge.tasks import load_task

_ALGORITHM = "sac"


class Plan:
    """What a study of some size comes to."""

    def __init__(self, size: Size) -> None:
        """Build each task once.

        Raises:
            ConfigError: a task or preset is not known, or a task has no goal.
        """
        self.size = size
        self.jobs = {job.key: job for job in size.jobs()}
        settings = task_settings(size.overrides)
        self._specs = {(panel.task, panel.preset): _spec(panel.task, panel.preset, settings) for panel in size.panels}

    def settings(self) -> dict[str, Any]:
        """What the rows depend on besides their keys, one name each: a setting that is new later adds to them."""
        settings: dict[str, Any] = {"overrides": list(self.size.overrides)}
        for (task, preset), spec in self._specs.items():
            sac = resolve_config(_ALGORITHM, spec.algorithm_presets[_ALGORITHM], {})
            values = {"reset_steps": spec.reset_steps, **{f"sac.{name}": value for name, value in asdict(sac).items()}}
            settings |= {f"{task} {preset}: {name}": value for name, value in values.items()}
        return settings

    def expected_s(self, job: Job) -> float:
        """Seconds that a job takes one core, roughly."""
        return expected_s(job, self._specs[job.task, job.preset].reset_steps)

    def text(self, workers: int) -> str:
        """What there is to do, and how long it will take."""
        groups: dict[Job, list[float]] = defaultdict(list)
        for job in self.jobs.values():
            groups[replace(job, seed=0)].append(self.expected_s(job))
        rows = [("job", "task", "preset", "limit", "head", "steps", "seeds", "one core")]
        for job, seconds in groups.items():
            what = (job.kind, job.task, job.preset, job.limit, job.head, job.steps)
            rows.append((*map(str, what), str(len(seconds)), duration_text(sum(seconds))))  # type: ignore[arg-type]
        widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
        lines = ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows]
        total_s = sum(map(sum, groups.values()))
        return "\n".join(
            [
                *lines,
                f"{len(self.jobs)} jobs, about {duration_text(total_s)} of one core, "
                f"{duration_text(total_s / workers)} with {workers} workers",
            ]
        )


def _spec(task: str, preset: str, settings: Mapping[str, Any]) -> TaskSpec:
    built = load_task(task, preset, settings, rng=np.random.default_rng(0))
    built.close()
    if not built.spec.has_goal:
        raise ConfigError(f"task {task} has no goal: there is nothing to compare time limits by")
    return built.spec
