"""``python -m experiments.hits``, on worlds small enough to be quick."""

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from experiments import hits
from tests.experiments.target_hits.fake_tasks import MODULE
from tests.helpers import TIMEOUT_S, eventually

REPOSITORY = Path(__file__).resolve().parents[2]
LINE = ["--task", f"line={MODULE}:Line", "--limits", "1", "5", "40", "--steps", "2000", "--workers", "1"]


def count(out, *options, base=LINE):
    return hits.main([*base, "--out", str(out), *options])


def table(out):
    return (out / "hits.csv").read_text()


def members_of(group):
    """Processes of a process group; one that has ended and only waits for its parent to notice does not count."""
    members = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, member_of = path.read_text().rpartition(")")[2].split()[:3]
            if int(member_of) == group and state not in "ZX":
                members.append(path.parent.name)
    return members


def test_one_and_two_workers_give_the_same_table(tmp_path):
    assert count(tmp_path / "one", "--seeds", "3") == 0
    assert count(tmp_path / "two", "--seeds", "3", "--workers", "2") == 0
    assert (tmp_path / "one" / "hits.csv").read_bytes() == (tmp_path / "two" / "hits.csv").read_bytes()
    lines = table(tmp_path / "one").splitlines()
    assert lines[0] == "task,limit,seed,hits"
    assert [line.rpartition(",")[0] for line in lines[1:]] == [
        f"line,{limit},{seed}" for limit in (1, 5, 40) for seed in range(3)
    ]
    found = [int(line.rpartition(",")[2]) for line in lines[1:]]
    assert len(set(found)) > 3  # another seed, other luck
    assert (tmp_path / "one" / "hits.png").read_bytes().startswith(b"\x89PNG")


def test_more_seeds_and_limits_are_added_to_what_is_there(tmp_path):
    count(tmp_path / "at once", "--seeds", "3")
    count(tmp_path / "bit by bit", "--seeds", "1", "--limits", "5")
    count(tmp_path / "bit by bit", "--seeds", "3")
    assert table(tmp_path / "bit by bit") == table(tmp_path / "at once")


def test_other_settings_are_refused_and_change_nothing(tmp_path, capsys):
    count(tmp_path, "--seeds", "1")
    before = table(tmp_path)
    assert count(tmp_path, "--seeds", "1", "--steps", "2001") == 1
    assert "steps: 2000 there, now 2001" in capsys.readouterr().err
    assert count(tmp_path, "--seeds", "1", "--set", "task.reset_steps=9") == 1
    assert "choose another folder with --out" in capsys.readouterr().err
    assert table(tmp_path) == before


def test_a_task_that_breaks_is_reported_and_the_rest_goes_on(tmp_path, capsys):
    base = ["--task", f"fragile={MODULE}:Fragile", *LINE[2:]]
    # Limit 1 resets all the time; 2000 steps under limit 1000 reset once at most.
    assert count(tmp_path, "--seeds", "1", "--limits", "1", "1000", base=base) == 1
    said = capsys.readouterr()
    assert "fragile 1 0 failed: RuntimeError: the gripper came off; the rest goes on" in said.err
    assert "1 of 2 jobs failed" in said.err
    assert [line.rpartition(",")[0] for line in table(tmp_path).splitlines()[1:]] == ["fragile,1000,0"]
    assert "in begin_attempt" in (tmp_path / "failures.log").read_text()


@pytest.mark.parametrize(("task", "reward"), [("Generous", "0.2"), ("Prize", "0.0")])
def test_a_task_with_other_rewards_is_refused_before_any_job(tmp_path, capsys, task, reward):
    assert count(tmp_path / "out", base=["--task", f"other={MODULE}:{task}", *LINE[2:]]) == 1
    said = capsys.readouterr().err
    assert f"--task other: task other gave a reward of {reward}" in said
    assert "expected -1 in every step" in said
    assert not (tmp_path / "out").exists()


def test_a_reward_that_is_no_number_later_on_fails_its_job(tmp_path, capsys):
    base = ["--task", f"late={MODULE}:NotANumber", *LINE[2:]]
    assert count(tmp_path, "--seeds", "1", "--limits", "1", base=base) == 1
    assert "late 1 0 failed: NotMinimumTimeError: task late gave a reward of nan in step 2" in capsys.readouterr().err


def test_a_task_that_ends_at_once_is_said_to_be_trivial(tmp_path, capsys):
    assert count(tmp_path, "--seeds", "1", base=["--task", f"at_once={MODULE}:AtOnce", *LINE[2:]]) == 0
    said = capsys.readouterr().out
    assert "at_once is trivial: under 1 step the untrained policy reaches the goal every 1.0 steps." in said
    assert "Check the task's termination" in said
    assert "1 steps" not in said


def test_an_output_folder_that_cannot_be_one_is_named_with_its_option(tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    for out in (tmp_path / "file", tmp_path / "file" / "inside"):
        assert count(out, "--seeds", "1") == 1
        said = capsys.readouterr().err
        assert f"error: --out {out}: " in said
        assert "choose another folder with --out" in said


def test_a_goal_that_is_never_reached_gives_zeros(tmp_path):
    base = ["--task", f"nowhere={MODULE}:Nowhere", *LINE[2:]]
    assert count(tmp_path, "--seeds", "1", base=base) == 0
    assert table(tmp_path).splitlines()[1:] == ["nowhere,1,0,0", "nowhere,5,0,0", "nowhere,40,0,0"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--limits", "0"], "--limits 0: expected at least 1 step"),
        (["--limits", "1000000001"], "--limits 1000000001: expected at most 1000000000 steps"),
        (["--seeds", "0"], "--seeds 0: expected at least 1"),
        (["--seeds", "10001"], "--seeds 10001: expected at most 10000"),
        (["--steps", "-5"], "--steps -5: expected at least 1"),
        (["--workers", "0"], "--workers 0: expected at least 1"),
        (["--workers", "257"], "--workers 257: expected at most 256"),
        (["--task", "noise_frames"], "no goal to hit"),
    ],
)
def test_bad_input_is_named_and_starts_nothing(tmp_path, capsys, options, words):
    assert count(tmp_path / "out", *options) == 1
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_keeps_what_is_finished_and_the_same_command_goes_on(tmp_path, number):
    options = ["--seeds", "400", "--workers", "2"]
    command = [sys.executable, "-m", "experiments.hits", *LINE, "--out", str(tmp_path / "part"), *options]
    process = subprocess.Popen(
        command, cwd=REPOSITORY, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    results = tmp_path / "part" / "results.jsonl"
    eventually(lambda: results.exists() and results.stat().st_size, "a first result")
    os.killpg(process.pid, number)  # as a terminal or `timeout` does: to the workers as well
    said, _ = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 130
    assert "the same command goes on from here" in said
    assert "Traceback" not in said
    assert "failed" not in said
    assert not (tmp_path / "part" / "failures.log").exists()
    eventually(lambda: not members_of(process.pid), "the end of all its processes")
    finished = len(table(tmp_path / "part").splitlines()) - 1
    assert 1 <= finished < 1200
    count(tmp_path / "part", "--seeds", "4")
    count(tmp_path / "whole", "--seeds", "4")
    wanted = table(tmp_path / "whole").splitlines()
    assert set(wanted) <= set(table(tmp_path / "part").splitlines())
