"""``python -m experiments.robot_hits``: the counts beside the thesis's, and when they are not good enough."""

import math

import pytest

from experiments import robot_hits
from experiments.robot_hits import ThesisHits, inside, report_text
from experiments.target_hits.jobs import HitCount
from services.robot_bridge.tasks import TASKS
from tests.experiments.target_hits.fake_tasks import MODULE

REQUIRED = ThesisHits("arm", 6.0, "14.4 ± 2.5", 10, 19)
REPORTED = ThesisHits("arm", 30.0, "7.8 ± 0.9")


def counts(*hits, task="arm", limit=150):
    return [HitCount(task, limit, seed, found) for seed, found in enumerate(hits)]


def test_the_table_names_tasks_that_there_are_with_the_thesiss_limits():
    assert {row.task for row in robot_hits.TABLE} <= set(TASKS)
    expected = {
        ("ur5_visual_reacher_min_time", 6.0): (10, 19, 150),
        ("franka_visual_reacher", 3.0): (8, 18, 75),
        ("franka_visual_reacher", 6.0): (-math.inf, math.inf, 150),
        ("franka_visual_reacher", 30.0): (-math.inf, math.inf, 750),
        ("create_reacher", 15.0): (13, 26, 333),
        ("vector_charger_detector", 30.0): (7, 16, 300),
    }
    for row in robot_hits.TABLE:
        limit = robot_hits.limit_steps(row, robot_hits.TaskChoice(row.task, "", {}))
        assert expected.pop((row.task, row.limit_s)) == (row.low, row.high, limit)
    assert not expected


@pytest.mark.parametrize(
    ("found", "expected"),
    [((10, 10), True), ((19, 19), True), ((9, 10), False), ((19, 20), False), ((), False), ((0, 28), True)],
)
def test_the_mean_over_seeds_has_to_be_in_the_range(found, expected):
    assert inside(REQUIRED, 150, counts(*found)) is expected


def test_counts_of_other_limits_and_tasks_do_not_count():
    assert not inside(REQUIRED, 150, counts(14, limit=75) + counts(14, task="leg"))


def test_what_is_only_reported_is_always_good_enough():
    assert inside(REPORTED, 750, counts(0, 0, limit=750))


def test_the_counts_of_other_steps_are_not_judged():
    text = report_text({REQUIRED: 150}, counts(3, 4), 300)
    assert "10 to 19\n" in text
    assert text.endswith("\nthe thesis's counts and the ranges are of 20000 steps: nothing is judged")
    assert "judged" not in report_text({REQUIRED: 150}, counts(3, 4), 20_000)


def test_the_report_has_means_errors_and_verdicts():
    limits = {REQUIRED: 150, REPORTED: 750}
    text = report_text(limits, counts(10, 14) + counts(2, limit=750), 20_000)
    # Mean 12, deviation sqrt(8), error sqrt(8) / sqrt(2) = 2.
    assert "6 s    12.0 ± 2.0 (2)    14.4 ± 2.5    10 to 19: yes" in text
    assert "30 s     2.0 ±   - (1)    7.8 ± 0.9     -" in text
    assert "10 to 19: NO" in report_text(limits, counts(3, 4), 20_000)
    assert "not counted" in report_text(limits, counts(3, 4), 20_000)


# ---------------------------------------------------------------------- the program, on a task that is quick to count


@pytest.fixture
def line(monkeypatch):
    """Lets the program know a task from the tests by a table of one row, whose range is given."""

    def table(low, high):
        monkeypatch.setattr(robot_hits, "TABLE", (ThesisHits("line", 2.0, "20 ± 1", low, high),))

    monkeypatch.setattr(robot_hits, "STEPS", 500)
    choose = robot_hits.choose_task
    monkeypatch.setattr(robot_hits, "choose_task", lambda name: choose(f"{name}={MODULE}:Line"))
    return table


def run(out, *options, steps=500):
    return robot_hits.main(["--steps", str(steps), "--seeds", "2", "--workers", "1", "--out", str(out), *options])


def test_a_count_outside_of_its_range_ends_with_exit_code_1(line, tmp_path, capsys):
    line(0, 500)
    assert run(tmp_path) == 0
    assert "0 to 500: yes" in capsys.readouterr().out
    assert (tmp_path / "hits.csv").read_text().count("\nline,50,") == 2  # 2 s of 40 ms
    line(400, 500)
    assert run(tmp_path) == 1  # the same counts
    said = capsys.readouterr().out
    assert "2 of them in" in said
    assert "400 to 500: NO" in (tmp_path / "robot_hits.txt").read_text()


def test_a_count_of_other_steps_is_never_a_failure(line, tmp_path, capsys):
    line(400, 500)
    assert run(tmp_path, steps=100) == 0
    assert "are of 500 steps: nothing is judged" in capsys.readouterr().out


def test_an_unknown_task_is_named_with_those_of_the_table(tmp_path, capsys):
    assert run(tmp_path, "--task", "dot_reacher") == 1
    assert "--task dot_reacher: expected one of ur5_visual_reacher_min_time" in capsys.readouterr().err


def test_a_number_that_cannot_be_is_refused(tmp_path, capsys):
    assert run(tmp_path, "--seeds", "0") == 1
    assert "--seeds 0: expected at least 1" in capsys.readouterr().err
