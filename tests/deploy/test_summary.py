"""The summary: hand-made records with hand-computed numbers, and records with pieces missing."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from common.frame_ring import RingWriter
from deploy import summary
from deploy.run_file import RunFile
from deploy.run_record import read_record
from deploy.summary import summarise
from deploy.summary_text import summary_text
from tests.common.ring_cases import Bridge, task_spec
from tests.deploy.hand_made_record import network_part, write_actions, write_ages, write_episodes, write_part

FIELDS = [
    "task",
    "algorithm",
    "mode",
    "network",
    "seed",
    "steps",
    "acted_steps",
    "episodes",
    "steps_per_goal_last_1000",
    "cycles",
    "overruns",
    "overruns_after_1000",
    "late_actions",
    "experience",
    "updates",
    "policy_pushes",
    "policy_version",
    "rollouts",
    "observation_to_action_ms",
    "action_age_ms",
    "outages",
    "bytes_per_key",
    "wall_s",
    "network_link",
    "service_failures",
    "notes",
]
BRIDGE = {"task": "dot_reacher", "has_goal": True, "seed": 4}
RUN = RunFile(
    id="test",
    mode="remote_only",
    task="dot_reacher",
    algorithm="sac",
    seed=4,
    steps=3000,
    pacing="realtime",
    network="outage",
    backend="namespaces",
    placement={"robot_bridge": "local", "actor": "remote", "replay": "remote", "learner": "remote"},
)


def write_run(run_dir: Path) -> None:
    """A run whose bridge, replay and learner were each killed once and started again."""
    RUN.write(run_dir)
    write_part(
        run_dir,
        "robot_bridge",
        100,
        state="running",
        wall_s=40.0,
        counters={
            "steps": 1000,
            "acted_steps": 900,
            "episodes": 2,
            "cycles": 1000,
            "overruns": 5,
            "overruns_after_1000": 0,
            "late_actions": 3,
            "produced": 90,
            "resent": 4,
        },
        bytes_sent={"timestep": 1000},
        **BRIDGE,
    )
    write_part(
        run_dir,
        "robot_bridge",
        50_000_000_100,
        wall_s=70.5,
        counters={
            "steps": 3000,
            "acted_steps": 2500,
            "episodes": 5,
            "cycles": 2000,
            "overruns": 2,
            "overruns_after_1000": 1,
            "late_actions": 1,
            "produced": 210,
            "resent": 1,
        },
        bytes_sent={"timestep": 2000, "status": 10},
        **BRIDGE,
    )
    write_part(run_dir, "actor", 110, counters={"resent": 2}, bytes_sent={"action": 100})
    write_part(run_dir, "replay", 120, state="running", persisted={"100": 60}, produced_seen={"100": 95})
    write_part(
        run_dir,
        "replay",
        130,
        persisted={"100": 93, "50000000100": 209},
        produced_seen={"100": 80, "50000000100": 200},
    )
    write_part(run_dir, "learner", 140, state="running", counters={"updates": 500, "policy_pushes": 10})
    write_part(
        run_dir,
        "learner",
        150,
        failure="out of memory",
        counters={"updates": 2400, "policy_pushes": 38, "policy_version": 47, "updates_per_s": 24.0},
    )
    write_episodes(run_dir, [1500, 2100, 2500, 2900, 2999])
    write_actions(run_dir, [(10.0, 10.002), (21.5, 21.504), (30.0, 30.006)])
    part = network_part([(20.0, 21.0)], start_s=0.5, kernel={"local": (3300, 0), "remote": (500, 0)})
    (run_dir / "network.json").write_text(part.to_json(), encoding="utf-8")


def test_the_summary_of_a_run_with_several_incarnations(tmp_path: Path) -> None:
    write_run(tmp_path)
    values = summarise(read_record(tmp_path)).values
    assert list(values) == FIELDS
    expected = {
        "task": "dot_reacher",
        "algorithm": "sac",
        "mode": "remote_only",
        "network": "outage",
        "seed": 4,
        "steps": 3000,
        "acted_steps": 2500,
        "episodes": 5,
        "steps_per_goal_last_1000": 250.0,  # four of the five goals are in the last 1000 of 3000 steps
        "cycles": 3000,
        "overruns": 7,
        "overruns_after_1000": 1,
        "late_actions": 4,
        "updates": 2400,
        "policy_pushes": 48,
        "policy_version": 47,
        "rollouts": None,
        "observation_to_action_ms": {"p50": 4.0, "p99": 5.96},
        "outages": [{"end_s": 20.5, "first_action_s": 0.504}],
        "bytes_per_key": {"action": 100, "status": 10, "timestep": 3000},
        "wall_s": 120.5,  # the second bridge started 50 s after the first and ran for 70.5 s
        "notes": [],
    }
    assert {name: values[name] for name in expected} == expected
    # The killed bridge's last part says 90, replay has seen 95 of it. Persisted are 93 and 209.
    assert values["experience"] == {"produced": 305, "persisted": 302, "lost": 3, "duplicated": None, "resent": 7}
    # Up: 3000 bytes of time steps, and 10 of status for each of three services. Down: the actor's actions.
    assert values["network_link"] == {
        "backend": "namespaces",
        "uplink": {"kernel_bytes": 3300, "record_bytes": 3030, "ratio": 1.0891},
        "downlink": {"kernel_bytes": 500, "record_bytes": 100, "ratio": 5.0},
        "received": {"local": {}, "remote": {}},
    }
    assert [(f["service"], f["incarnation"]) for f in values["service_failures"]] == [
        ("robot_bridge", 100),
        ("replay", 120),
        ("learner", 140),
        ("learner", 150),
    ]
    assert values["service_failures"][-1]["failure"] == "out of memory"


def test_rollouts_and_what_was_dropped_between_them_add_up_over_restarts_of_replay(tmp_path: Path) -> None:
    for incarnation, complete, dropped in ((20, 3, 41), (30, 2, 7)):
        write_part(tmp_path, "replay", incarnation, counters={"rollouts": complete, "dropped_transitions": dropped})
    values = summarise(read_record(tmp_path)).values
    assert values["rollouts"] == {"complete": 5, "dropped_transitions": 48}
    assert "5 rollouts, 48 transitions dropped" in summary_text(values)


def test_the_medians_of_an_action_s_age_are_told_with_the_clocks_error(tmp_path: Path) -> None:
    write_run(tmp_path)
    write_ages(tmp_path, [(1, 2, 3, 4, 5, 6, 7, 0.5), (1, 2, 13, 4, 5, 6, 7, 0.7), (1, 2, 4, 4, 5, 6, 7, 0.6)])
    values = summarise(read_record(tmp_path)).values
    assert values["action_age_ms"] == {
        **{"camera": 1, "encode": 2, "uplink": 4, "queue": 4, "inference": 5, "downlink": 6, "apply": 7},
        **{"age": 29, "offset_bound": 0.6},
    }
    assert "29.00 ms of age (p50): camera 1.00, encode 2.00, uplink 4.00" in summary_text(values)


def test_a_clock_that_jumped_is_noted(tmp_path: Path) -> None:
    write_run(tmp_path)
    write_part(tmp_path, "actor", 111, clock={"offset_s": 3.0, "jumps": 2})
    write_part(tmp_path, "actor", 112, clock={"jumps": 1})
    write_part(tmp_path, "replay", 131, clock={"jumps": 0})
    notes = summarise(read_record(tmp_path)).values["notes"]
    assert notes == ["actor: its clock and the bridge's jumped against each other (3 x)"]


@pytest.mark.parametrize(("persisted", "noted"), [(5, False), (2, True)])
def test_what_a_run_that_was_ended_lost_on_its_way_is_noted(tmp_path: Path, persisted: int, noted: bool) -> None:
    replace(RUN, steps=10, ended_early="interrupted").write(tmp_path)
    write_part(tmp_path, "robot_bridge", 1, counters={"produced": 5, "steps": 10})
    write_part(tmp_path, "replay", 1, counters={}, persisted={"1": persisted})
    notes = summarise(read_record(tmp_path)).values["notes"]
    said = "the run was ended (interrupted): what was still on its way by then counts as lost"
    assert (said in notes) == noted


@pytest.mark.parametrize(("persisted", "noted"), [(5, False), (2, True)])
def test_first_observations_that_may_have_been_lost_are_noted(tmp_path: Path, persisted: int, noted: bool) -> None:
    write_part(tmp_path, "robot_bridge", 1, counters={"produced": 5}, unanswered_first_observations=3)
    write_part(tmp_path, "robot_bridge", 2, counters={"produced": 0}, unanswered_first_observations=1)
    write_part(tmp_path, "replay", 1, counters={}, persisted={"1": persisted})
    values = summarise(read_record(tmp_path)).values
    assert values["experience"]["lost"] == 5 - persisted
    assert any("4 first observations were not answered in time" in note for note in values["notes"]) == noted


def test_a_camera_that_stalled_is_noted(tmp_path: Path) -> None:
    write_run(tmp_path)
    write_part(tmp_path, "robot_bridge", 141, counters={"camera_stalls": 2})
    write_part(tmp_path, "robot_bridge", 142, counters={"camera_stalls": 1})
    notes = summarise(read_record(tmp_path)).values["notes"]
    assert "the camera stalled (3 x); attempts that it befell were truncated" in notes


def test_in_simulated_time_an_action_has_no_age(tmp_path: Path) -> None:
    write_run(tmp_path)
    replace(RUN, mode="in_process").write(tmp_path)
    write_ages(tmp_path, [(1, 2, 3, 4, 5, 6, 7, 0.5)])
    assert summarise(read_record(tmp_path)).values["action_age_ms"] is None


def test_rows_that_stand_twice_in_the_ring_are_counted(tmp_path: Path) -> None:
    bridge = Bridge(incarnation=7, camera=False)
    ring = RingWriter.create_or_reopen(tmp_path / "ring", task_spec(camera=False), 10)
    for _ in range(4):
        ring.append(bridge.start())
    layout = ring.layout
    ring.close()
    # The writer refuses a time step that it has; so one is put there behind its back: 0, 1, 0, 0.
    rows = np.memmap(tmp_path / "ring", layout.row_dtype, "r+", offset=layout.rows_offset, shape=4)
    rows["seq"][2:] = 0
    rows.flush()
    write_part(tmp_path, "robot_bridge", 7, counters={"produced": 2}, **BRIDGE)
    assert summarise(read_record(tmp_path)).values["experience"]["duplicated"] == 2


def test_what_is_missing_is_null_with_a_warning(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    result = summarise(read_record(tmp_path))
    assert list(result.values) == FIELDS
    assert result.values["bytes_per_key"] == {}
    assert result.values["service_failures"] == result.values["notes"] == []
    assert set(result.values["experience"].values()) == {None}
    empty = {"bytes_per_key", "service_failures", "notes", "experience"}
    assert {name for name, value in result.values.items() if value is not None} == empty
    text = "\n".join(result.warnings)
    for missing in ("run.toml", "robot_bridge", "replay", "ring"):
        assert missing in text


def test_a_run_that_was_cut_short_says_so_and_why(tmp_path: Path) -> None:
    write_run(tmp_path)
    cut = replace(RUN, steps=4000, ended_early="the trace t.csv is over after 4 s")
    cut.write(tmp_path)
    values = summarise(read_record(tmp_path)).values
    note = "the run was cut short, at 3000 of 4000 steps: the trace t.csv is over after 4 s"
    assert note in values["notes"]
    assert f"note       {note}" in summary_text(values)
    # What was told to end when it had made all its steps was not cut short.
    for whole in (replace(cut, steps=3000), replace(cut, ended_early="")):
        whole.write(tmp_path)
        assert not any("cut short" in note for note in summarise(read_record(tmp_path)).values["notes"])


@pytest.mark.parametrize("name", ["run.toml", "network.json", "ring", "parts/learner-150.json", "actions.csv"])
def test_a_damaged_piece_costs_only_what_is_in_it(tmp_path: Path, name: str) -> None:
    write_run(tmp_path)
    (tmp_path / name).write_text("{ damaged", encoding="utf-8")
    result = summarise(read_record(tmp_path))
    assert list(result.values) == FIELDS
    assert result.values["steps"] == 3000
    json.dumps(result.values)
    summary_text(result.values)


@pytest.mark.parametrize("content", ["", "{ damaged"])
def test_of_a_service_whose_part_is_empty_or_damaged_the_counts_are_unknown_and_that_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str
) -> None:
    write_run(tmp_path)
    (tmp_path / "parts" / "learner-150.json").write_text(content, encoding="utf-8")
    assert summary.main([str(tmp_path)]) == 0
    values = json.loads((tmp_path / "summary.json").read_text())
    # That of the learner which was killed before it says 500 updates and 10 policies: less than there were.
    assert (values["updates"], values["policy_pushes"], values["policy_version"]) == (None, None, None)
    failure = "its part of the record is empty or damaged: its counts are unknown"
    assert {"service": "learner", "incarnation": 150, "failure": failure} in values["service_failures"]
    said = capsys.readouterr()
    assert said.out.count(f"learner: {failure}") == 1
    assert "Error" not in said.out + said.err


@pytest.mark.parametrize(
    ("name", "persisted"),
    [
        ("robot_bridge-100", 302),  # the first of two
        ("robot_bridge-50000000100", 302),
        ("replay-120", 302),  # the newer replay goes on from its count
        ("replay-130", None),
    ],
)
def test_what_depends_on_an_unreadable_part_is_unknown_and_nothing_else(
    tmp_path: Path, name: str, persisted: int | None
) -> None:
    write_run(tmp_path)
    (tmp_path / "parts" / f"{name}.json").write_text("", encoding="utf-8")
    values = summarise(read_record(tmp_path)).values
    experience = values["experience"]
    # Of the bridge that was killed, a replay may know more than the bridge's last part.
    assert (experience["produced"], experience["persisted"], experience["lost"]) == (None, persisted, None)
    assert values["updates"] == 2400
    # Steps go on over incarnations of the bridge, cycles begin anew.
    assert values["steps"] == (None if name == "robot_bridge-50000000100" else 3000)
    assert values["cycles"] == (None if name.startswith("robot_bridge") else 3000)


def test_without_ring_and_last_word_of_replay_nothing_is_said_to_be_lost(tmp_path: Path) -> None:
    write_part(tmp_path, "robot_bridge", 7, counters={"produced": 1299}, **BRIDGE)
    write_part(tmp_path, "replay", 8, state="running", persisted={"7": 233})
    result = summarise(read_record(tmp_path))
    experience = result.values["experience"]
    assert (experience["produced"], experience["persisted"], experience["lost"]) == (1299, None, None)
    assert any("what replay has persisted is not known" in warning for warning in result.warnings)


def test_a_run_without_run_toml_still_has_what_its_bridge_says(tmp_path: Path) -> None:
    write_part(tmp_path, "robot_bridge", 100, counters={"steps": 10}, **BRIDGE)
    values = summarise(read_record(tmp_path)).values
    assert (values["task"], values["seed"], values["mode"]) == ("dot_reacher", 4, None)


def test_steps_per_goal_are_null_without_a_goal_and_noted_where_none_was_reached(tmp_path: Path) -> None:
    write_part(tmp_path, "robot_bridge", 100, counters={"steps": 5000}, **{**BRIDGE, "has_goal": False})
    write_episodes(tmp_path, [100, 4900])
    values = summarise(read_record(tmp_path)).values
    assert (values["steps_per_goal_last_1000"], values["notes"]) == (None, [])
    write_part(tmp_path, "robot_bridge", 100, counters={"steps": 5000}, **BRIDGE)
    write_episodes(tmp_path, [100, 3900])
    values = summarise(read_record(tmp_path)).values
    assert values["steps_per_goal_last_1000"] is None
    assert "no goal was reached" in values["notes"][0]


def test_episodes_that_are_missing_in_the_table_are_noted(tmp_path: Path) -> None:
    write_part(tmp_path, "robot_bridge", 100, counters={"steps": 5000, "episodes": 3}, **BRIDGE)
    values = summarise(read_record(tmp_path)).values
    assert values["steps_per_goal_last_1000"] is None
    assert values["notes"] == ["episodes.csv holds 0 of the 3 completed episodes"]


def test_parts_of_another_run_are_left_out_and_named(tmp_path: Path) -> None:
    write_run(tmp_path)
    write_part(tmp_path, "robot_bridge", 60_000_000_000, run="another", counters={"steps": 9, "produced": 999})
    result = summarise(read_record(tmp_path))
    assert result.values["experience"]["produced"] == 305
    assert "parts/robot_bridge-60000000000.json is of run 'another', expected 'test': left out" in result.warnings


def test_of_a_replay_that_was_killed_the_ring_tells_what_it_has_stored(tmp_path: Path) -> None:
    bridge = Bridge(incarnation=7, camera=False)
    ring = RingWriter.create_or_reopen(tmp_path / "ring", task_spec(camera=False), 3)
    for _ in range(5):
        ring.append(bridge.start())
    ring.close()
    write_part(tmp_path, "robot_bridge", 7, counters={"produced": 6}, **BRIDGE)
    write_part(tmp_path, "replay", 8, state="running", persisted={"7": 2})
    experience = summarise(read_record(tmp_path)).values["experience"]
    assert (experience["persisted"], experience["lost"]) == (5, 1)


def test_a_learner_that_had_not_begun_is_noted(tmp_path: Path) -> None:
    write_part(tmp_path, "robot_bridge", 100, **BRIDGE)
    write_part(tmp_path, "learner", 150, counters={})
    values = summarise(read_record(tmp_path)).values
    assert values["updates"] is None
    assert values["notes"] == ["updates is null: the learner was still starting"]


def test_a_run_on_one_host_has_no_outages_and_no_link(tmp_path: Path) -> None:
    replace(RUN, backend="none", mode="local_only").write(tmp_path)
    write_part(tmp_path, "robot_bridge", 100, **BRIDGE)
    values = summarise(read_record(tmp_path)).values
    assert values["outages"] == []
    assert values["network_link"] is None


def test_the_command_writes_and_prints_the_summary(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_run(tmp_path)
    assert summary.main([str(tmp_path)]) == 0
    assert json.loads((tmp_path / "summary.json").read_text())["experience"]["lost"] == 3
    assert (tmp_path / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr()
    for words in ("305 produced", "3 lost", "250 steps per goal", "learner: out of memory", "learning_curve.png"):
        assert words in printed.out
    assert "ring" in printed.err


def test_no_such_run_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert summary.main([str(tmp_path / "nowhere")]) == 1
    assert "no such run directory" in capsys.readouterr().err
