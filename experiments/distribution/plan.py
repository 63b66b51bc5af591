"""A study made ready: its hosts, networks and tasks exist, and what its runs depend on is known."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from common.algorithms.presets import resolve_config
from common.errors import ConfigError
from common.topics import LEARNER
from deploy.hosts import load_host
from experiments.distribution.jobs import Job, training_of
from experiments.distribution.sizes import Size
from experiments.grid import duration_text
from experiments.training import plan_training
from services.robot_bridge.tasks import load_task


class Plan:
    """What a study of some size comes to."""

    def __init__(self, size: Size) -> None:
        """Plan each configuration once.

        Raises:
            ConfigError: a task, host, network or setting is not known, or a task has no goal.
        """
        self.size = size
        self.jobs = {job.key: job for job in size.jobs()}
        self._settings: dict[str, Any] = {}
        for job in {job.setting: job for job in self.jobs.values()}.values():
            self._settings |= self._settings_of(job)

    def settings(self) -> dict[str, Any]:
        """What the rows depend on besides their keys, one name each: a configuration that is new adds to them."""
        return dict(self._settings)

    def expected_s(self, job: Job) -> float:
        """Seconds that a job takes one core, roughly."""
        return self.size.expected_s(job)

    def text(self, workers: int) -> str:
        """What there is to do, and how long it will take."""
        seconds: Counter[str] = Counter()
        for job in self.jobs.values():
            seconds[job.setting] += round(self.expected_s(job))
        runs = Counter(job.setting for job in self.jobs.values())
        lines = [f"{name}, {runs[name]} seeds: {duration_text(of_one)} of one core" for name, of_one in seconds.items()]
        total_s = sum(seconds.values())
        lines.append(
            f"{len(self.jobs)} jobs, about {duration_text(total_s)} of one core, "
            f"{duration_text(total_s / workers)} with {workers} workers"
        )
        return "\n".join(lines)

    def _settings_of(self, job: Job) -> dict[str, Any]:
        panel, configuration = self.size.panel_of(job)
        run = asdict(configuration)
        run["overrides"] = [*configuration.overrides, *panel.overrides]
        if panel.real_time:
            run["real_time"] = True
        planned = plan_training(training_of(job, run, Path("runs")))
        algorithm = planned.configurations[LEARNER].algorithm
        task = load_task(job.task, "", {}, rng=np.random.default_rng(0))
        task.close()
        if not task.spec.has_goal:
            raise ConfigError(f"task {job.task} has no goal: there are no steps per goal to compare")
        preset = algorithm.preset or task.spec.algorithm_presets[algorithm.name]
        return {
            job.setting: run,
            f"{job.setting}: {algorithm.name}": asdict(resolve_config(algorithm.name, preset, algorithm.overrides)),
            f"host {configuration.host}": asdict(load_host(configuration.host)),
            **({f"network {planned.network}": planned.conditions.to_table()} if planned.conditions else {}),
        }
