"""A run's record from one folder, and from the two that a run on two computers leaves."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from common.errors import ConfigError
from common.frame_ring import RingWriter
from deploy.mirror import Mirror, read_piece, shared_files, write_ring_counts
from deploy.run_file import RunFile
from deploy.run_record import read_record, read_ring
from deploy.summary import main, summarise
from tests.common.ring_cases import Bridge, task_spec
from tests.deploy.hand_made_record import write_actions, write_episodes, write_part

RUN = RunFile(
    id="test",
    mode="remote_local",
    task="dot_reacher",
    algorithm="sac",
    seed=4,
    steps=300,
    pacing="realtime",
    network="real",
    backend="none",
    placement={"robot_bridge": "local", "actor": "local", "replay": "remote", "learner": "remote"},
)


def write_sides(folder: Path) -> tuple[Path, Path]:
    """The folders of a run of 300 steps; replay has persisted 38 of 40 time steps."""
    local, remote = folder / "local", folder / "remote"
    for side in (local, remote):
        side.mkdir()
        RUN.write(side)
    counters = {"steps": 300, "acted_steps": 300, "episodes": 2, "produced": 40, "cycles": 300, "resent": 1}
    write_part(local, "robot_bridge", 100, wall_s=12.0, counters=counters, has_goal=True, bytes_sent={"timestep": 7})
    write_part(local, "actor", 110, counters={"resent": 3})
    write_episodes(local, [100, 300])
    write_actions(local, [(1.0, 1.003), (2.0, 2.003)])
    write_part(remote, "replay", 120, persisted={"100": 38}, produced_seen={"100": 40})
    write_part(remote, "learner", 130, counters={"updates": 25, "policy_pushes": 2, "policy_version": 2})
    bridge = Bridge(incarnation=100, camera=False)
    ring = RingWriter.create_or_reopen(remote / "ring", task_spec(camera=False), 10)
    ring.append(bridge.start())
    ring.close()
    return local, remote


def test_a_run_on_two_computers_has_one_summary_whatever_folder_is_named_first(tmp_path: Path) -> None:
    local, remote = write_sides(tmp_path)
    results = [summarise(read_record(*folders)) for folders in ((local, remote), (remote, local))]
    values = results[0].values
    assert results[0].warnings == results[1].warnings == []
    assert results[1].values == values
    assert values["experience"] == {"produced": 40, "persisted": 38, "lost": 2, "duplicated": 0, "resent": 4}
    assert (values["steps"], values["updates"], values["wall_s"]) == (300, 25, 12.0)
    assert values["steps_per_goal_last_1000"] == 150.0
    assert values["observation_to_action_ms"]["p50"] == pytest.approx(3.0)
    assert values["bytes_per_key"] == {"timestep": 7}
    assert values["service_failures"] == []


def test_one_side_alone_lacks_the_other_and_says_so(tmp_path: Path) -> None:
    local, remote = write_sides(tmp_path)
    here = summarise(read_record(local))
    assert here.values["experience"]["persisted"] is None
    assert any("replay" in warning for warning in here.warnings)
    there = summarise(read_record(remote))
    assert there.values["steps"] is None
    assert any("robot_bridge" in warning for warning in there.warnings)


def test_the_copy_of_the_other_side_s_files_is_as_good_as_its_folder(tmp_path: Path) -> None:
    local, remote = write_sides(tmp_path)
    both = summarise(read_record(local, remote)).values
    write_ring_counts(remote, 7, 0, 5)
    for name in shared_files(remote):
        copy = local / "hosts" / "remote" / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(remote / name, copy)
    assert summarise(read_record(local)).values == both
    # With the folder too, nothing is counted twice.
    assert summarise(read_record(local, remote)).values == both


def test_of_two_copies_of_a_part_the_later_one_counts(tmp_path: Path) -> None:
    local, remote = write_sides(tmp_path)
    write_part(local / "hosts" / "remote", "learner", 130, state="running", wall_s=0.5, counters={"updates": 11})
    values = summarise(read_record(local, remote)).values
    assert values["updates"] == 25
    assert values["service_failures"] == []


def test_of_copies_that_are_outdated_it_is_not_known_what_replay_has_stored_since(tmp_path: Path) -> None:
    local, remote = write_sides(tmp_path)
    write_ring_counts(remote, 7, 0, 5)
    mirror = Mirror(local / "hosts" / "remote", lambda name, offset: read_piece(remote, name, offset))
    assert mirror.update(shared_files(remote))
    assert summarise(read_record(local)).values["experience"]["lost"] == 2
    mirror.note_outdated()
    result = summarise(read_record(local))
    experience = result.values["experience"]
    assert (experience["produced"], experience["persisted"], experience["lost"]) == (40, None, None)
    assert any("the record of remote may not be complete here" in warning for warning in result.warnings)
    whole = summarise(read_record(local, remote))
    assert (whole.values["experience"]["lost"], whole.warnings) == (2, [])


def test_an_outdated_copy_from_the_robot_s_computer_leaves_what_is_known_of_replay(tmp_path: Path) -> None:
    _, remote = write_sides(tmp_path)
    Mirror(remote / "hosts" / "local", lambda name, offset: None).note_outdated()
    assert summarise(read_record(remote)).values["experience"]["persisted"] == 38


def test_an_unreadable_copy_of_a_part_costs_nothing_where_the_part_itself_is_there(tmp_path: Path) -> None:
    local, remote = write_sides(tmp_path)
    copy = write_part(local / "hosts" / "remote", "learner", 130)
    copy.write_text("", encoding="utf-8")
    assert summarise(read_record(local)).values["updates"] is None
    values = summarise(read_record(local, remote)).values
    assert values["updates"] == 25
    assert values["service_failures"] == []


def test_folders_of_two_runs_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    local, remote = write_sides(tmp_path)
    replace(RUN, id="run2").write(remote)
    assert main([str(local), str(remote)]) == 1
    assert (
        f"expected the folders of one run; {local} is of run test, {remote} is of run run2" in capsys.readouterr().err
    )


def test_the_command_writes_the_summary_into_the_first_folder(tmp_path: Path) -> None:
    local, remote = write_sides(tmp_path)
    assert main([str(local), str(remote)]) == 0
    assert (local / "summary.json").exists()
    assert not (remote / "summary.json").exists()


@pytest.mark.parametrize("missing_first", [True, False])
def test_a_folder_that_is_no_run_is_an_error(tmp_path: Path, missing_first: bool) -> None:
    local, _ = write_sides(tmp_path)
    (tmp_path / "empty").mkdir()
    folders = (tmp_path / "empty", local) if missing_first else (local, tmp_path / "empty")
    with pytest.raises(ConfigError, match=r"empty: expected a run's record"):
        read_record(*folders)
    assert list((tmp_path / "empty").iterdir()) == []


def test_a_ring_that_has_wrapped_is_read_whole(tmp_path: Path) -> None:
    bridge = Bridge(incarnation=7, camera=False)
    ring = RingWriter.create_or_reopen(tmp_path / "ring", task_spec(camera=False), 10)
    for _ in range(25):
        ring.append(bridge.start())
    ring.close()
    content = read_ring(tmp_path / "ring")
    assert content.duplicated == 0
    # Published at 1000 + seq: the newest is the 25th.
    assert content.last_published_ns == 1024
