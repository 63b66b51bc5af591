"""Training in virtual time: the pace of a real run in the mode's placement, the same every time."""

from __future__ import annotations

import csv
import json
import tomllib
from pathlib import Path

import pytest

from common.console import Console
from common.errors import ConfigError
from deploy.episodes import EpisodeTable
from deploy.summary import read_record, summarise
from experiments.train import Training, main, train
from tests.experiments.small_algorithm import SMALL_ALGORITHM

INFERENCE_S, UPDATE_S = 0.001, 0.005
SMALL = (
    *SMALL_ALGORITHM,
    "task.target_half_width=0.6",
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


OUTAGES = ("network.outage_every_s=3", "network.outage_s=1")


@pytest.fixture(scope="module")
def bad(tmp_path_factory):
    """A run over a bad network with outages."""
    run_dir = tmp_path_factory.mktemp("bad")
    train(small(run_dir, *OUTAGES, network="wifi_bad"))
    return run_dir


def test_the_same_seed_gives_the_same_run_over_a_bad_network_with_outages(bad, tmp_path):
    train(small(tmp_path, *OUTAGES, network="wifi_bad"))
    names = {path.name for path in bad.iterdir()}
    assert names == {path.name for path in tmp_path.iterdir()}
    assert names > {"actions.csv", "policy.msgpack", "network.json"}
    # So few steps need not complete an episode.
    for file in names & {"episodes.csv", "actions.csv", "policy.msgpack", "network.json"}:
        assert (bad / file).read_bytes() == (tmp_path / file).read_bytes(), file


def test_a_trace_that_stops_ends_the_run_in_order(tmp_path, capsys):
    trace = tmp_path / "short.csv"
    trace.write_text("time_s,delay_ms\n0.0,5\n1.0,10\n", encoding="utf-8")  # Each line holds for a second.
    network = tmp_path / "network.toml"
    network.write_text(f'[network]\ntrace = "{trace}"\ntrace_end = "stop"\n', encoding="utf-8")
    values = train(small(tmp_path / "run", network=str(network)), Console())
    # The link's 2 s of 25 cycles each, less the services' start; looked at once a second.
    assert 25 <= values["steps"] <= 75
    assert values["experience"]["lost"] == 0
    assert "short.csv is over after 2 s" in (tmp_path / "run" / "logs" / "train.log").read_text(encoding="utf-8")
    assert f"the run has ended early: the trace {trace} is over after 2 s" in capsys.readouterr().err
    cut_short = f"the run was cut short, at {values['steps']} of 150 steps: the trace {trace} is over after 2 s"
    for notes in (values["notes"], summarise(read_record(tmp_path / "run")).values["notes"]):
        assert any(note.startswith(cut_short) for note in notes)


def test_a_congestion_control_is_refused_because_nobody_would_have_it(tmp_path):
    with pytest.raises(ConfigError, match=r"congestion_control = 'cubic': expected ''; virtual time has a TCP"):
        train(small(tmp_path / "run", "network.congestion_control='cubic'", network="wifi_bad"))
    assert not (tmp_path / "run").exists()


def test_another_seed_gives_another_run(bad, tmp_path):
    train(small(tmp_path, *OUTAGES, network="wifi_bad", seed=1, steps=50))
    one, other = ((folder / "network.json").read_bytes() for folder in (bad, tmp_path))
    assert one != other


def test_nothing_is_lost_over_a_bad_network_with_outages(bad):
    values = json.loads((bad / "summary.json").read_text())
    experience = values["experience"]
    assert (values["steps"], experience["lost"], experience["duplicated"]) == (150, 0, 0)
    assert experience["produced"] == experience["persisted"] > 100
    # Six seconds of action cycles: one outage has ended among them, and its connections were up again within 2 s.
    assert values["outages"]
    assert 0 < values["outages"][0]["first_action_s"] < 2
    assert values["late_actions"] > 0
    assert values["overruns"] == 0


@pytest.mark.parametrize(
    ("mode", "crossing_ms"),
    [("local_only", 0), ("remote_local", 0), ("remote_only", 5 + 7 + 0.7)],
    ids=lambda value: value,
)
def test_an_answer_takes_inference_processes_and_what_the_placement_puts_in_between(mode, crossing_ms, tmp_path):
    network = tmp_path / "network.toml"
    network.write_text("[network]\n[network.uplink]\ndelay_ms = 5\n[network.downlink]\ndelay_ms = 7\n")
    values = train(small(tmp_path / "run", steps=40, mode=mode, network=None if mode == "local_only" else str(network)))
    expected_ms = crossing_ms + PROCESSES_MS + INFERENCE_S * 1e3
    assert values["observation_to_action_ms"] == {"p50": pytest.approx(expected_ms), "p99": pytest.approx(expected_ms)}
    assert values["late_actions"] == 0


def test_an_action_that_takes_longer_than_the_cycle_is_late_and_the_world_goes_on(tmp_path):
    values = train(small(tmp_path / "run", "actor.min_inference_s=0.05", mode="local_only", steps=60))
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
    for rate in (0.1, 100):
        train(small(tmp_path / str(rate), f"network.downlink.rate_mbit={rate}", mode="remote_local"))
    # 7 kB after each fifth update: at 100 kbit/s that takes over half a second, and the robot has gone on meanwhile.
    slow, fast = (policies_received(tmp_path / str(rate)) for rate in (0.1, 100))
    assert len(slow) == len(fast) > 4
    assert sum(slow) < 0.8 * sum(fast)


def policies_received(run_dir: Path) -> list[float]:
    """The actor's count, once a second of the first six."""
    with (run_dir / "metrics" / "actor.csv").open(newline="") as file:
        return [float(row["policies_received"] or 0) for row in csv.DictReader(file)][:6]


def test_the_record_is_that_of_a_launched_run(tmp_path):
    values = train(small(tmp_path / "run", network="wifi_office", task="visual_dot_reacher", steps=60))
    assert values == json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (values["mode"], values["network"], values["steps"]) == ("remote_only", "wifi_office", 60)
    run = tomllib.loads((tmp_path / "run" / "run.toml").read_text())
    assert (run["run"]["pacing"], run["run"]["backend"]) == ("virtual", "virtual")
    assert (run["placement"]["robot_bridge"], run["placement"]["actor"]) == ("local", "remote")
    assert run["conditions"]["uplink"]["delay_ms"] == 3.0
    link = values["network_link"]
    # TCP/IP's headers, acknowledgements and repetitions.
    assert 1 < link["uplink"]["ratio"] < 1.3
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
