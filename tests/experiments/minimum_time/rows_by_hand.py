"""A small study and what its jobs give; the workers are processes of their own, so they import the jobs from here."""

import os
import signal
from pathlib import Path

from experiments.minimum_time.jobs import DEFAULT_HEAD, HITS, ZERO_HEAD, Job, work
from experiments.minimum_time.sizes import Figure, Panel, Size

SMALL_NETWORKS = (
    "algorithm.batch_size=8",
    "algorithm.hidden_size=32",
    "algorithm.min_size_to_sample=30",
    "algorithm.policy_push_interval=5",
    "algorithm.replay_capacity=500",
    "task.target_half_width=0.6",
    "task.target_speed=0.0",
)
TINY = Size(
    name="tiny",
    figures=(Figure("learning_curves", "Two limits", (Panel("dot_reacher", "demo", (10, 50), steps=150, seeds=2),)),),
    hit_seeds=2,
    window=50,
    overrides=SMALL_NETWORKS,
)
"""Few enough steps to be really run."""
HAND_MADE = Size(
    name="hand_made",
    figures=(
        Figure("learning_curves", "Limits", (Panel("dot_reacher", "demo", (2, 10, 50), steps=2000, seeds=3),)),
        Figure("heads", "Heads", (Panel("dot_reacher", "demo", (50,), 2000, 3, (ZERO_HEAD, DEFAULT_HEAD)),)),
    ),
    hit_seeds=4,
    window=500,
)

HITS_OF_LIMIT = {2: 10, 10: 20, 50: 30}
GOAL_EVERY = {2: 500, 10: 100, 50: 10}


def hand_made(settings, key):
    """Hits and goals that grow with the limit; the default head reaches a goal half as often."""
    job = Job(*key)
    if job.kind == HITS:
        return {"hits": HITS_OF_LIMIT[job.limit] + job.seed}
    every = GOAL_EVERY[job.limit] * (1 if job.head == ZERO_HEAD else 2)
    # The seeds' last 1000 steps hold the same number of goals, but begin at different steps.
    return {"goal_steps": list(range(every - job.seed, job.steps + 1, every)), "core_s": 0.5}


def hand_made_rows(size):
    """Key -> row of all jobs."""
    return {job.key: hand_made({}, job.key) for job in size.jobs()}


def half_run(settings, job):
    """Leave a run's folder as one that was stopped in the middle does."""
    folder = Path(settings["runs"]) / job.folder
    folder.mkdir()
    (folder / "episodes.csv").write_text("episode,return,length,attempts,steps\n0,-9.0,9,1,", encoding="utf-8")


def crash_twice(settings, key):
    """One run raises, one is killed, as one that has taken too much memory is."""
    job = Job(*key)
    if job.kind != HITS and job.head == ZERO_HEAD and (job.limit, job.seed) in ((10, 1), (50, 2)):
        half_run(settings, job)
        if job.limit == 10:
            raise ValueError("the robot fell over")
        os.kill(os.getpid(), signal.SIGKILL)
    return hand_made(settings, key)


def interrupt(settings, key):
    """Do the first run; the second one is in the middle when Ctrl-C comes."""
    job = Job(*key)
    if job.limit == 10:
        return work(settings, key)
    half_run(settings, job)
    os.kill(os.getppid(), signal.SIGINT)
    signal.pause()  # until the parent ends this process
