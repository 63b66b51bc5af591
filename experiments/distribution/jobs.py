"""One job of the study: a whole training run, in virtual or in real time."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

from common.errors import RelodError
from deploy.episodes import EpisodeTable
from experiments.distribution.real_time import launch
from experiments.run_folders import remove_rebuildable
from experiments.train import train
from experiments.training import Training
from experiments.workers import Key

ONE_THREAD = ("learner.threads=1",)
"""Each worker has one core; and the number of threads changes the last bits of sums."""


class DistributionError(RelodError):
    """A run of the study is not what it should be."""


@dataclass(frozen=True)
class Job:
    """A run; with the settings, all of its randomness follows from these values."""

    configuration: str
    """Name."""
    task: str
    steps: int
    """Resets included."""
    seed: int

    @property
    def key(self) -> Key:
        """The grid's key."""
        return astuple(self)

    @property
    def folder(self) -> str:
        """Name of the run's folder."""
        return f"{self.configuration}-{self.task}-{self.steps}steps-seed{self.seed}"

    @property
    def setting(self) -> str:
        """Under which name the settings have what is run."""
        return f"{self.task} {self.steps} steps: {self.configuration}"


def training_of(job: Job, run: Mapping[str, Any], run_dir: Path) -> Training:
    """What to train.

    Args:
        job: the run.
        run: ``algorithm``, ``mode``, ``network``, ``host`` and ``overrides``, as in a configuration.
        run_dir: of its record.
    """
    return Training(
        task=job.task,
        run_dir=run_dir,
        algorithm=run["algorithm"],
        seed=job.seed,
        steps=job.steps,
        overrides=(*ONE_THREAD, *run["overrides"]),
        host_budget=run["host"],
        mode=run["mode"],
        network=run["network"],
    )


def work(settings: Mapping[str, Any], key: Key) -> Mapping[str, Any]:
    """Do a job.

    Args:
        settings: ``runs``: folder of the runs' folders; under :attr:`Job.setting`: what :func:`training_of` takes, and
            ``real_time`` if it is to be run so.
        key: of the job.

    Returns:
        The row: ``goal_steps``, the steps of the run at which goals were reached; ``p50_ms`` from observation to
        action; ``late``, share of the cycles whose action came after their end; ``lost``, time steps; ``age_ms``,
        medians of an action's age, part by part; ``updates``; ``core_s``, what it took of a core.
    """
    job = Job(*key)  # type: ignore[arg-type]  # the keys are made by Job.key
    run_dir = Path(settings["runs"]) / job.folder
    begun_s = _core_s()
    run = settings[job.setting]
    values = (launch if run.get("real_time") else train)(training_of(job, run, run_dir))
    episodes = EpisodeTable(run_dir).update()
    if values["steps"] != job.steps or values["episodes"] != len(episodes):
        raise DistributionError(
            f"{run_dir}: expected {job.steps} steps and {values['episodes']} rows in episodes.csv, "
            f"got {values['steps']} and {len(episodes)}"
        )
    remove_rebuildable(run_dir)
    return {
        "goal_steps": [episode.steps for episode in episodes],
        "p50_ms": values["observation_to_action_ms"]["p50"],
        "late": values["late_actions"] / values["cycles"],
        "lost": values["experience"]["lost"],
        "age_ms": values["action_age_ms"],
        "updates": values["updates"],
        "core_s": round(_core_s() - begun_s, 1),
    }


def _core_s() -> float:
    """Processor time of this process and of those that it has started and seen end."""
    return sum(os.times()[:4])
