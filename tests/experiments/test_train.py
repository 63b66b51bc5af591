"""Training in one process: the same every time, with a whole record, and clear words when it cannot."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from common.console import Console
from common.errors import ConfigError, MessageError
from common.stop_signals import StopSignals
from deploy.episodes import EpisodeTable
from experiments.train import Training, main, train
from tests.experiments.small_algorithm import SMALL_ALGORITHM

ROOT = Path(__file__).parents[2]
SMALL = (
    *SMALL_ALGORITHM,
    "task.target_half_width=0.4",
)


def small(run_dir: Path, **changes) -> Training:
    return Training(**{"task": "dot_reacher", "run_dir": run_dir, "steps": 200, "overrides": SMALL, **changes})


def test_the_same_options_give_the_same_run_in_any_process(tmp_path):
    command = [
        sys.executable,
        "-m",
        "experiments.train",
        "--task",
        "visual_dot_reacher",
        "--seed",
        "3",
        "--steps",
        "150",
    ]
    command += [text for setting in SMALL for text in ("--set", setting)]
    for name, hash_seed in (("one", "1"), ("two", "2")):
        environment = {"PATH": "", "PYTHONHASHSEED": hash_seed, "HOME": str(tmp_path)}
        subprocess.run([*command, "--run-dir", str(tmp_path / name)], cwd=ROOT, check=True, env=environment)
    for file in ("episodes.csv", "actions.csv", "policy.msgpack"):
        one, two = ((tmp_path / name / file).read_bytes() for name in ("one", "two"))
        assert one == two, file
    assert (tmp_path / "one" / "episodes.csv").read_text().count("\n") > 2


def test_ppo_gives_the_same_run_and_loses_a_step_for_each_rollout_at_most(tmp_path):
    overrides = (
        "algorithm.hidden_size=32",
        "algorithm.rollout_length=60",
        "algorithm.replay_capacity=500",
        "algorithm.epochs=2",
        "task.target_half_width=0.4",
    )
    runs = [small(tmp_path / name, algorithm="ppo", steps=300, overrides=overrides) for name in ("one", "two")]
    one, two = (train(run) for run in runs)
    for file in ("actions.csv", "policy.msgpack"):
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes(), file
    # When a rollout is complete, one answer of the old policy is on its way; then the actor waits for the new one.
    rollouts = one["rollouts"]
    assert rollouts == two["rollouts"]
    assert 3 <= rollouts["complete"] == one["updates"] == one["policy_version"]
    assert rollouts["dropped_transitions"] <= rollouts["complete"]


def test_another_seed_gives_another_run(tmp_path):
    for seed in (0, 1):
        train(small(tmp_path / str(seed), seed=seed))
    one, two = ((tmp_path / str(seed) / "actions.csv").read_bytes() for seed in (0, 1))
    assert one != two


def test_the_record_is_that_of_a_launched_run(tmp_path):
    values = train(small(tmp_path / "run"))
    assert values == json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (values["mode"], values["steps"], values["cycles"]) == ("in_process", 200, 200)
    assert (values["experience"]["lost"], values["experience"]["duplicated"]) == (0, 0)
    # Every transition from the 30th on earns an update; the last one may have had no time for its own.
    transitions = values["experience"]["persisted"] - attempts_of(tmp_path / "run")
    assert transitions - 30 <= values["updates"] <= transitions - 29
    assert values["policy_version"] == values["updates"] // 5
    assert values["late_actions"] == values["overruns"] == 0
    for name in (
        "run.toml",
        "learning_curve.png",
        "metrics/learner.csv",
        "config/actor.toml",
        "logs/train.log",
        "ring",
    ):
        assert (tmp_path / "run" / name).exists(), name
    assert len(EpisodeTable(tmp_path / "run").update()) == values["episodes"] > 0


def test_a_weaker_computer_learns_with_fewer_updates(tmp_path):
    values = train(small(tmp_path / "run", host_budget="jetson"))
    transitions = values["experience"]["persisted"] - attempts_of(tmp_path / "run")
    assert (transitions - 30) // 12 <= values["updates"] <= (transitions - 29) // 12
    assert 'host_budget = "jetson"' in (tmp_path / "run" / "run.toml").read_text()


def attempts_of(run_dir: Path) -> int:
    part = json.loads(next(run_dir.glob("parts/robot_bridge-*.json")).read_text())
    return int(part["counters"]["attempts"])


def test_a_stop_ends_the_run_early_with_a_whole_record(tmp_path):
    class StopOnceBegun(StopSignals):
        @property
        def asked(self):
            return (tmp_path / "run").exists()

    values = train(small(tmp_path / "run", steps=100_000), stop=StopOnceBegun())
    assert values["steps"] < 100_000
    assert values["experience"]["lost"] == 0
    assert values["service_failures"] == []


def test_a_stop_before_anything_is_begun_leaves_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("experiments.loading.load_algorithm", lambda name: os.kill(os.getpid(), signal.SIGINT))
    assert main(["--task", "dot_reacher", "--run-dir", str(tmp_path / "run")]) == 130
    said = capsys.readouterr()
    assert "interrupted before anything was begun" in said.out
    assert not said.err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"task": "dot_racher"}, "dot_reacher"),
        ({"overrides": ("task.time_limitt=3",)}, "time_limit"),
        ({"overrides": ("algorithm.preset=none_such",)}, "none_such"),
        ({"host_budget": "jetsn"}, "did you mean 'jetson'"),
        ({"overrides": ("robot_bridge.pacing=realtime",)}, "lockstep"),
        ({"mode": "local_only", "overrides": ("camera.name=opencv", "camera.device=0")}, "taken in real time"),
    ],
)
def test_what_cannot_be_trained_is_refused_with_the_reason(changes, message, tmp_path):
    with pytest.raises(ConfigError, match=message):
        train(small(tmp_path / "run", **changes))
    assert not (tmp_path / "run").exists(), "the corrected command may use the same folder"


def test_a_service_that_fails_ends_the_run_with_its_reason(tmp_path, monkeypatch):
    def fail(*_):
        raise MessageError("the ring is full of water")

    monkeypatch.setattr("services.replay.replay.RingWriter.append", fail)
    monkeypatch.setattr("services.replay.replay.RingWriter.contains", lambda *_: 1 // 0)
    with pytest.raises(Exception, match="replay: unexpected ZeroDivisionError"):
        train(small(tmp_path / "run"))


def test_a_folder_with_something_in_it_is_left_alone(tmp_path, capsys):
    (tmp_path / "precious").write_text("data")
    assert main(["--task", "dot_reacher", "--run-dir", str(tmp_path)]) == 1
    assert "expected a folder that is empty" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["precious"]


def test_progress_and_summary_are_shown(tmp_path, capsys):
    train(small(tmp_path / "run"), Console())
    shown = capsys.readouterr().out
    assert "summary.json" in shown
    assert "200 (" in shown
