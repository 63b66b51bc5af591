"""Runs of the study through the launcher."""

from pathlib import Path

import pytest

from experiments.distribution.configurations import SAC
from experiments.distribution.jobs import work
from experiments.distribution.plan import Plan
from experiments.distribution.real_time import LaunchError, command_line, launch
from experiments.distribution.sizes import REAL, Panel, Size
from experiments.training import Training
from tests.experiments.distribution.studies_by_hand import SMALL_NETWORKS

BY_NAME = {configuration.name: configuration for configuration in SAC}


def tiny(*overrides):
    panel = Panel(
        "real", "Real", "dot_reacher", (BY_NAME["sac_laptop"],), 60, 1, 20, (*SMALL_NETWORKS, *overrides), True
    )
    return Plan(Size("tiny_real", (panel,)))


def test_a_run_in_real_time_gives_the_row_that_one_in_virtual_time_gives(tmp_path):
    plan = tiny()
    ((key, job),) = plan.jobs.items()
    row = work({**plan.settings(), "runs": str(tmp_path)}, key)
    assert set(row) == {"goal_steps", "p50_ms", "late", "lost", "age_ms", "updates", "core_s"}
    assert row["lost"] == 0
    assert row["age_ms"]["inference"] >= 3.0  # The laptop's.
    assert row["core_s"] > 1.0  # Four services at least import torch.
    assert (tmp_path / job.folder / "summary.json").is_file()


def test_a_run_that_the_launcher_refuses_is_told_with_its_words(tmp_path):
    training = Training(task="dot_reacher", run_dir=tmp_path / "run", steps=10, mode="nowhere")
    with pytest.raises(LaunchError, match=r"exit code 1: .*nowhere"):
        launch(training)


def test_the_launcher_is_told_all_that_the_training_says():
    training = Training(
        task="dot_reacher",
        run_dir=Path("/runs/one"),
        algorithm="sac",
        seed=7,
        steps=100,
        overrides=("learner.threads=1",),
        host_budget="laptop",
        mode="remote_only",
        network="wifi_bad",
    )
    command = " ".join(command_line(training)[1:])
    assert command == (
        "-m deploy.launch remote_only --task dot_reacher --algorithm sac --steps 100 --seed 7 --network wifi_bad "
        "--host-budget laptop --run-dir /runs/one --set learner.threads=1"
    )


def test_runs_in_real_time_are_not_done_side_by_side():
    assert REAL.most_workers == 1
