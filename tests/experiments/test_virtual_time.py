"""Training in virtual time: the pace of a real run in the mode's placement, the same every time."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

from common.errors import ConfigError
from deploy.episodes import EpisodeTable
from experiments.train import Training, main, train

INFERENCE_S, UPDATE_S = 0.001, 0.005
SMALL = (
    "algorithm.batch_size=8",
    "algorithm.hidden_size=32",
    "algorithm.min_size_to_sample=30",
    "algorithm.policy_push_interval=5",
    "algorithm.replay_capacity=500",
    "task.target_half_width=0.4",
    f"actor.min_inference_s={INFERENCE_S}",
    f"learner.min_update_s={UPDATE_S}",
)
PROCESSES_MS = 1.1
"""Both messages' way through the processes."""


def small(run_dir: Path, *settings: str, **changes) -> Training:
    options = {"task": "dot_reacher", "run_dir": run_dir, "steps": 150, "mode": "remote_only", **changes}
    return Training(overrides=(*SMALL, *settings), **options)


def configuration(run_dir: Path, service: str):
    return tomllib.loads((run_dir / "config" / f"{service}.toml").read_text())


@pytest.mark.parametrize("task", ["dot_reacher", "visual_dot_reacher"])
def test_the_same_seed_gives_the_same_run_over_a_bad_network_with_outages(task, tmp_path):
    settings = () if task == "dot_reacher" else ("task.target_half_width=0.4",)
    outages = ("network.outage_every_s=3", "network.outage_s=1")
    for name, seed in (("one", 3), ("two", 3), ("other", 4)):
        train(small(tmp_path / name, *settings, *outages, task=task, network="wifi_bad", seed=seed))
    for file in ("episodes.csv", "actions.csv", "policy.msgpack", "network.json"):
        one, two = ((tmp_path / name / file).read_bytes() for name in ("one", "two"))
        assert one == two, file
    assert (tmp_path / "one/actions.csv").read_bytes() != (tmp_path / "other/actions.csv").read_bytes()


def test_nothing_is_lost_over_a_bad_network_with_outages(tmp_path):
    values = train(small(tmp_path / "run", "network.outage_every_s=3", "network.outage_s=1", network="wifi_bad"))
    experience = values["experience"]
    assert (values["steps"], experience["lost"], experience["duplicated"]) == (150, 0, 0)
    assert experience["produced"] == experience["persisted"] > 100
    # Six seconds of action cycles: one outage has ended among them, and its connections were up again within 2 s.
    assert values["outages"]
    assert 0 < values["outages"][0]["first_action_s"] < 2
    assert values["late_actions"] > 0
    assert values["overruns"] == 0


@pytest.mark.parametrize(
    ("mode", "crossing_ms"), [("local_only", 0), ("remote_local", 0), ("remote_only", 5 + 7)], ids=lambda value: value
)
def test_an_answer_takes_inference_processes_and_what_the_placement_puts_in_between(mode, crossing_ms, tmp_path):
    network = tmp_path / "network.toml"
    network.write_text("[network]\n[network.uplink]\ndelay_ms = 5\n[network.downlink]\ndelay_ms = 7\n")
    values = train(small(tmp_path / "run", mode=mode, network=None if mode == "local_only" else str(network)))
    expected_ms = crossing_ms + PROCESSES_MS + INFERENCE_S * 1e3
    assert values["observation_to_action_ms"] == {"p50": pytest.approx(expected_ms), "p99": pytest.approx(expected_ms)}
    assert values["late_actions"] == 0


def test_an_action_that_takes_longer_than_the_cycle_is_late_and_the_world_goes_on(tmp_path):
    values = train(small(tmp_path / "run", "actor.min_inference_s=0.05", mode="local_only"))
    assert values["observation_to_action_ms"]["p50"] >= 50
    assert values["late_actions"] > 0.8 * values["cycles"] / 2, "every other observation is answered, 11 ms too late"
    assert values["overruns"] == 0


def test_updates_take_their_time(tmp_path):
    fast = train(small(tmp_path / "fast", "learner.min_update_s=0.001", mode="local_only"))
    slow = train(small(tmp_path / "slow", "learner.min_update_s=0.5", mode="local_only"))
    # 150 cycles of 40 ms are 6 s; the first 30 transitions earn nothing.
    assert 6 <= slow["updates"] <= 11
    assert fast["updates"] > 60


def test_a_policy_takes_the_downlink_s_rate(tmp_path):
    """The learner pushes 7 kB after each fifth update; at 100 kbit/s that is over half a second."""
    slow, fast = (
        train(small(tmp_path / str(rate), f"network.downlink.rate_mbit={rate}", mode="remote_local"))
        for rate in (0.1, 100)
    )
    pushed = {
        name: part["counters"] for name, part in (("slow", actor(tmp_path / "0.1")), ("fast", actor(tmp_path / "100")))
    }
    assert fast["policy_pushes"] - pushed["fast"]["policies_received"] <= 1
    assert pushed["slow"]["policies_received"] < pushed["fast"]["policies_received"]
    assert slow["observation_to_action_ms"]["p50"] == fast["observation_to_action_ms"]["p50"]


def actor(run_dir: Path):
    return json.loads(next(run_dir.glob("parts/actor-*.json")).read_text())


def test_the_record_is_that_of_a_launched_run(tmp_path):
    values = train(small(tmp_path / "run", network="wifi_office"))
    assert values == json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (values["mode"], values["network"], values["steps"]) == ("remote_only", "wifi_office", 150)
    run = tomllib.loads((tmp_path / "run" / "run.toml").read_text())
    assert (run["run"]["pacing"], run["run"]["backend"]) == ("virtual", "virtual")
    assert (run["placement"]["robot_bridge"], run["placement"]["actor"]) == ("local", "remote")
    assert run["conditions"]["uplink"]["delay_ms"] == 3.0
    link = values["network_link"]
    # TCP/IP's and Zenoh's headers are most of it: the messages of this task are small.
    assert 1 < link["uplink"]["ratio"] < 2
    for name in ("learning_curve.png", "metrics/learner.csv", "logs/train.log", "ring", "policy.msgpack"):
        assert (tmp_path / "run" / name).exists(), name
    assert len(EpisodeTable(tmp_path / "run").update()) == values["episodes"]


def test_the_learner_s_computer_gives_the_times(tmp_path):
    host = tmp_path / "board.toml"
    host.write_text(
        '[host]\ndevice = "cpu"\nthreads = 1\ninference_s = 0.012\nupdates_per_step = 0.25\nreplay_capacity = 900\n'
    )
    settings = tuple(setting for setting in SMALL if "min_" not in setting or "size" in setting)
    values = train(
        Training(
            "dot_reacher", tmp_path / "run", steps=60, overrides=settings, mode="local_only", host_budget=str(host)
        )
    )
    assert values["observation_to_action_ms"]["p50"] == pytest.approx(12 + PROCESSES_MS)
    assert configuration(tmp_path / "run", "learner")["learner"]["min_update_s"] == pytest.approx(0.04 / 0.25)
    assert configuration(tmp_path / "run", "replay")["algorithm"]["replay_ratio"] == 0.25


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--network", "wifi_bad"], "add --mode"),
        (["--mode", "local_only", "--network", "wifi_bad"], "nothing crosses a network"),
        (["--mode", "remote_onyl"], "remote_only"),
        (["--mode", "remote_only", "--network", "wifi_ofice"], "wifi_office"),
        (["--mode", "remote_only", "--set", "robot_bridge.pacing=lockstep"], "expected 'realtime'"),
        (["--mode", "remote_only", "--host-budget", "jetsno"], "jetson"),
        (["--mode", "remote_only", "--set", "network.loss=2"], "loss = 2"),
    ],
)
def test_what_cannot_be_trained_is_refused_with_the_reason(options, message, tmp_path, capsys):
    assert main(["--task", "dot_reacher", "--run-dir", str(tmp_path / "run"), *options]) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists(), "the corrected command may use the same folder"
