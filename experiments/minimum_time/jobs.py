"""One job of a study: a whole training run, or the initial policy's hits counted with one seed."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from common.config import parse_override
from common.errors import RelodError
from deploy.episodes import EpisodeTable
from experiments.run_folders import remove_rebuildable
from experiments.target_hits.counting import count_hits
from experiments.target_hits.initial_policy import initial_actions
from experiments.target_hits.jobs import stream
from experiments.target_hits.world import World
from experiments.train import train
from experiments.training import Training
from experiments.workers import Key
from services.robot_bridge.tasks import load_task

HITS, TRAINING = "hits", "training"
ZERO_HEAD, DEFAULT_HEAD = "zero", "default"
"""How the actor's last layer is initialised."""


class StudyError(RelodError):
    """A run of the study is not what it should be."""


@dataclass(frozen=True)
class Job:
    """What is to be done; all of its randomness follows from these values."""

    kind: str
    """:data:`HITS` or :data:`TRAINING`."""
    task: str
    preset: str
    """Of the task; empty: its default."""
    limit: int
    """Time limit, steps."""
    head: str
    """:data:`ZERO_HEAD` or :data:`DEFAULT_HEAD`."""
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
        parts = [self.task, self.preset, f"limit{self.limit}", f"{self.head}_head", f"{self.steps}steps"]
        name = "-".join([*filter(None, parts), f"seed{self.seed}"])
        return name if self.kind == TRAINING else f"{self.kind}-{name}"


def work(settings: Mapping[str, Any], key: Key) -> Mapping[str, Any]:
    """Do a job.

    Args:
        settings: ``runs``: folder of the runs' folders; ``overrides``: ``section.key=value`` for all runs.
        key: of the job.

    Returns:
        The row: ``hits``; or ``goal_steps``, the steps of the run at which goals were reached, and ``core_s``, what it
        took of a core.
    """
    job = Job(*key)  # type: ignore[arg-type]  # the keys are made by Job.key
    if job.kind == HITS and job.head == ZERO_HEAD:
        return {"hits": _count_hits(job, task_settings(settings["overrides"]))}
    overrides = list(settings["overrides"])
    if job.kind == HITS:
        # Whatever the policy is: the system itself counts, and never learns.
        overrides += [f"algorithm.min_size_to_sample={job.steps}", f"algorithm.replay_capacity={2 * job.steps}"]
    begun_s = time.process_time()
    goal_steps = _run(job, Path(settings["runs"]) / job.folder, overrides)
    if job.kind == HITS:
        return {"hits": len(goal_steps)}
    return {"goal_steps": goal_steps, "core_s": round(time.process_time() - begun_s, 1)}


def run_overrides(job: Job) -> tuple[str, ...]:
    """The settings that make a run this job's."""
    return (
        *([f"task.preset={job.preset}"] if job.preset else []),
        f"task.time_limit={job.limit}",
        f"algorithm.zero_initialised_head={'true' if job.head == ZERO_HEAD else 'false'}",
        "learner.threads=1",  # each worker has one core
    )


def task_settings(overrides: Iterable[str]) -> dict[str, Any]:
    """Of ``section.key=value``, what is the task's."""
    return {key: value for section, key, value in map(parse_override, overrides) if section == "task"}


def _count_hits(job: Job, settings: Mapping[str, Any]) -> int:
    of_world, of_policy = (np.random.default_rng(seeds) for seeds in stream(*job.key).spawn(2))
    task = load_task(job.task, job.preset, {**settings, "time_limit": job.limit}, rng=of_world)
    try:
        return count_hits(World(task), initial_actions(task.spec, of_policy), job.limit, job.steps)
    finally:
        task.close()


def _run(job: Job, run_dir: Path, overrides: list[str]) -> list[int]:
    """Run the whole system; return at which steps goals were reached."""
    training = Training(job.task, run_dir, seed=job.seed, steps=job.steps, overrides=(*run_overrides(job), *overrides))
    values = train(training)
    episodes = EpisodeTable(run_dir).update()
    if values["steps"] != job.steps or values["episodes"] != len(episodes):
        raise StudyError(
            f"{run_dir}: expected {job.steps} steps and {values['episodes']} rows in episodes.csv, "
            f"got {values['steps']} and {len(episodes)}"
        )
    before = 0
    for episode in episodes:
        if not episode.length == -episode.episode_return == episode.steps - before:
            raise StudyError(
                f"{run_dir}: expected -1 for each of an episode's steps, resets included; episode {episode.number} "
                f"has return {episode.episode_return}, length {episode.length} and ends at step {episode.steps}"
            )
        before = episode.steps
    remove_rebuildable(run_dir)
    return [episode.steps for episode in episodes]
