"""A small study and what its jobs give; the workers are processes of their own, so they import the jobs from here."""

import os
import signal
from pathlib import Path

from experiments.distribution.configurations import SAC
from experiments.distribution.jobs import Job, work
from experiments.distribution.sizes import Panel, Size
from tests.experiments.fake_jobs import cores

SMALL_NETWORKS = (
    "algorithm.batch_size=8",
    "algorithm.hidden_size=32",
    "algorithm.min_size_to_sample=30",
    "algorithm.policy_push_interval=5",
    "algorithm.replay_capacity=500",
    "task.target_half_width=0.6",
    "task.target_speed=0.0",
)
BY_NAME = {configuration.name: configuration for configuration in SAC}
LAPTOP, REMOTE_LOCAL = BY_NAME["sac_laptop"], BY_NAME["sac_remote_local_bad"]
TINY = Size(
    "tiny", (Panel("both", "Two", "dot_reacher", (LAPTOP, REMOTE_LOCAL), 150, 1, window=50, overrides=SMALL_NETWORKS),)
)
"""Few enough steps to be really run."""
HAND_MADE = Size(
    "hand_made", (Panel("sac", "SAC", "dot_reacher", (BY_NAME["sac_workstation"], LAPTOP), 1000, 3, window=500),)
)


def hand_made(settings, key):
    """A goal every 20 steps on the laptop, every 10 elsewhere; the seeds differ by a few goals."""
    job = Job(*key)
    every = 20 if job.configuration == "sac_laptop" else 10
    return {
        "goal_steps": list(range(every, job.steps + 1 - every * job.seed, every)),
        "p50_ms": 2.0 + job.seed,
        "late": 0.01 * job.seed,
        "lost": job.seed,
        "age_ms": {"uplink": 0.5, "inference": 1.0, "downlink": 0.5},
        "updates": job.steps,
        "core_s": 0.5,
    }


def hand_made_with_cores(settings, key):
    """The same, and on which cores."""
    return hand_made(settings, key) | cores(settings, key)


def half_run(settings, job):
    """Leave a run's folder as one that was stopped in the middle does."""
    folder = Path(settings["runs"]) / job.folder
    folder.mkdir()
    (folder / "episodes.csv").write_text("episode,return,length,attempts,steps\n0,-9.0,9,1,", encoding="utf-8")


def crash_twice(settings, key):
    """One run raises, one is killed, as one that has taken too much memory is."""
    job = Job(*key)
    if (job.configuration, job.seed) == ("sac_laptop", 1):
        half_run(settings, job)
        raise ValueError("the robot fell over")
    if (job.configuration, job.seed) == ("sac_workstation", 2):
        half_run(settings, job)
        os.kill(os.getpid(), signal.SIGKILL)
    return hand_made(settings, key)


def interrupt(settings, key):
    """Do the first run; the second one is in the middle when Ctrl-C comes."""
    job = Job(*key)
    if job.configuration == LAPTOP.name:
        return work(settings, key)
    half_run(settings, job)
    os.kill(os.getppid(), signal.SIGINT)
    signal.pause()  # until the parent ends this process
