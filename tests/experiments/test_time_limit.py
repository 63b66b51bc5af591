"""``python -m experiments.time_limit``: what it says of worlds whose answer is known."""

import pytest

from experiments import time_limit
from tests.experiments.target_hits.fake_tasks import MODULE

QUICK = ["--effort", "300"]


def ask(out, task, *options):
    return time_limit.main(["--task", f"fake={MODULE}:{task}", "--workers", "1", "--out", str(out), *QUICK, *options])


def answer(out):
    return (out / "time_limit_fake.txt").read_text()


def test_a_limit_is_recommended_with_its_reason(tmp_path):
    # From 1, 2 or 3 above the goal: 1 step suffices for a third of the starts, 3 for all.
    assert ask(tmp_path, "Line", "--limits", "1", "3", "20") == 0
    text = answer(tmp_path)
    assert "Recommended time limit: 3 steps (0.12 s)" in text
    assert "Minimum steps: 3 steps" in text
    assert "Admissible limits: 3, 20" in text
    assert "1 is below the minimum steps" in text
    assert "lucky starts" in text


def test_the_answer_is_the_same_for_two_workers_and_from_half_of_the_results(tmp_path):
    options = ["--limits", "1", "3"]
    ask(tmp_path / "one", "Line", *options)
    ask(tmp_path / "two", "Line", *options, "--workers", "2")
    assert answer(tmp_path / "one") == answer(tmp_path / "two")
    results = tmp_path / "two" / "results.jsonl"
    lines = results.read_bytes().splitlines(keepends=True)
    results.write_bytes(b"".join(lines[::2]))
    (tmp_path / "two" / "time_limit_fake.txt").unlink()
    ask(tmp_path / "two", "Line", *options)
    assert answer(tmp_path / "one") == answer(tmp_path / "two")


def test_limits_below_the_minimum_steps_are_no_recommendation(tmp_path):
    assert ask(tmp_path, "Line", "--limits", "1", "2") == 0
    text = answer(tmp_path)
    assert "Recommended time limit: none" in text
    assert "No limit that was tried is long enough: give longer ones with --limits" in text


def test_a_goal_that_is_never_reached_is_not_to_be_tried(tmp_path):
    assert ask(tmp_path, "Nowhere", "--limits", "10", "40") == 0
    text = answer(tmp_path)
    assert "Recommended time limit: none; do not try this task as it is" in text
    assert "did not reach the goal once" in text
    assert "Check that the goal can be reached at all" in text
    assert "Admissible limits: none for certain\n" in text


@pytest.mark.parametrize(
    ("task", "reason"),
    [
        ("AtOnce", "from 100 % of the starts a single step suffices"),
        (
            "Autopilot",
            "every 4.0 steps, resets included, and the search knows no ways that are much shorter: 4.0 steps",
        ),
    ],
)
def test_a_task_whose_goal_comes_whatever_is_done_gets_no_limit(tmp_path, task, reason):
    assert ask(tmp_path, task, "--limits", "1", "5", "20") == 0
    text = answer(tmp_path)
    assert "Recommended time limit: none; the task is trivial as it is" in text
    assert reason in text
    assert "Check the task's termination" in text
    assert "1 steps" not in text


def test_a_task_with_other_rewards_is_refused(tmp_path, capsys):
    assert ask(tmp_path / "out", "Generous", "--limits", "20") == 1
    assert "expected -1 in every step" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_task_that_breaks_gives_no_answer_but_the_reason(tmp_path, capsys):
    assert ask(tmp_path, "Fragile", "--limits", "1", "10") == 1
    said = capsys.readouterr().err
    assert "failed: RuntimeError: the gripper came off" in said
    assert "so there is no answer" in said
    assert not (tmp_path / "time_limit_fake.txt").exists()


def test_a_task_that_does_not_repeat_itself_is_named(tmp_path, capsys):
    assert ask(tmp_path, "Forgetful", "--limits", "100") == 1
    said = capsys.readouterr().err
    assert "task fake does not repeat itself from the same start" in said
    assert "so there is no answer" in said


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--limits", "-3"], "--limits -3: expected at least 1 step"),
        (["--seed", "-1"], "--seed -1: expected at least 0"),
        (["--set", "task.time_limit=3"], "given by --limits"),
    ],
)
def test_bad_input_is_named(tmp_path, capsys, options, words):
    assert ask(tmp_path, "Line", *options) == 1
    assert words in capsys.readouterr().err


def test_a_task_without_goal_is_refused(tmp_path, capsys):
    assert time_limit.main(["--task", "noise_frames", "--out", str(tmp_path)]) == 1
    assert "no goal to hit" in capsys.readouterr().err
