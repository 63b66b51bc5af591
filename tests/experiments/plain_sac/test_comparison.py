"""The comparison with a SAC loop in one file: what is counted, and when it fails."""

from __future__ import annotations

import pytest

from experiments.plain_sac import __main__ as comparison
from experiments.plain_sac.loop import Result, run


def test_goals_count_from_the_last_thousand_steps_on():
    # 4000 is outside, 4001 and 5000 are inside: two goals in 1000 steps.
    assert comparison.steps_per_goal([100, 4000, 4001, 5000], 5000) == 500.0


def test_a_run_without_a_goal_at_the_end_counts_as_one_goal():
    assert comparison.steps_per_goal([3], 5000) == 1000.0


def test_an_interval_is_student_s():
    # 1, 2, 3: deviation 1, standard error 1 / sqrt(3), times 4.303.
    assert comparison.interval([1.0, 2.0, 3.0]) == (2.0, pytest.approx(2.484, abs=1e-3))


def test_the_loop_repeats_itself_and_learns_from_the_minimum_size_on():
    once, again, other = run(0, 260), run(0, 260), run(1, 260)
    assert once.goal_steps == again.goal_steps != other.goal_steps


@pytest.mark.parametrize(("ours", "code"), [([9.0, 10.0, 11.0], 0), ([11.0, 12.0, 13.5], 0), ([14.0, 15.0, 16.0], 1)])
def test_the_exit_code_tells_whether_they_agree(ours, code, tmp_path, monkeypatch, capsys):
    # Three runs of the loop: 111, 100 and 91 goals in the last thousand steps, about 9, 10 and 11 steps per goal.
    plain = iter([111, 100, 91])
    monkeypatch.setattr(comparison, "run", lambda seed, steps: Result(list(range(steps - next(plain) + 1, steps + 1))))
    values = iter(ours)
    monkeypatch.setattr(comparison, "train", lambda training: {"steps_per_goal_last_1000": next(values)})
    assert comparison.main(["--seeds", "3", "--out", str(tmp_path)]) == code
    assert "intervals overlap" in capsys.readouterr().out
    assert (tmp_path / "steps_per_goal.csv").read_text().splitlines()[1] == f"0,9.009,{ours[0]}"
