"""Runs of the study through the launcher."""

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest

from experiments.distribution.__main__ import main
from experiments.distribution.configurations import SAC
from experiments.distribution.jobs import work
from experiments.distribution.plan import Plan
from experiments.distribution.real_time import LaunchError, command_line, launch
from experiments.distribution.sizes import SIZES, Panel, Size
from experiments.training import Training
from tests.experiments.distribution.studies_by_hand import HAND_MADE, SMALL_NETWORKS, hand_made_with_cores

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


@pytest.mark.parametrize("real_time", [False, True])
def test_a_run_in_real_time_has_all_cores_and_one_in_virtual_time_a_core_of_its_own(tmp_path, real_time):
    every_core = sorted(os.sched_getaffinity(0))
    size = replace(HAND_MADE, panels=tuple(replace(panel, real_time=real_time) for panel in HAND_MADE.panels))
    assert main(["--out", str(tmp_path), "--workers", "2"], {size.name: size}, hand_made_with_cores) == 0
    lines = (tmp_path / "runs" / "results.jsonl").read_text(encoding="utf-8").splitlines()
    rows = [json.loads(line) for line in lines]
    assert len(rows) == len(size.jobs()) == 6
    if real_time:
        assert {row["process"] for row in rows} == {rows[0]["process"]}, "one at a time"
        assert all(row["cores"] == every_core for row in rows)
    elif len(every_core) > 1:
        assert all(row["cores"] in ([core] for core in every_core[:2]) for row in rows)


def test_the_size_of_real_runs_is_in_real_time_and_no_other_is():
    assert [name for name, size in SIZES.items() if size.real_time] == ["real"]
