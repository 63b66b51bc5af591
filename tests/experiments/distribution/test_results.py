"""From runs to numbers, worked out by hand."""

import math
from dataclasses import replace

import pytest

from experiments.distribution.bars import AtMost
from experiments.distribution.configurations import Question
from experiments.distribution.results import collect, curve_rows, run_rows
from tests.experiments.distribution.studies_by_hand import HAND_MADE, hand_made


def rows():
    return {job.key: hand_made({}, job.key) for job in HAND_MADE.jobs()}


def test_steps_per_goal_are_means_over_seeds_with_student_s_interval():
    # 1000 steps; seed s has s goals less than 100, or 50 on the laptop.
    workstation, laptop = collect(HAND_MADE, rows(), {}).configurations
    assert [run.goals for run in workstation.runs] == [100, 99, 98]
    assert [run.goals for run in laptop.runs] == [50, 49, 48]
    values = [1000 / 50, 1000 / 49, 1000 / 48]
    mean = sum(values) / 3
    deviation = math.sqrt(sum((value - mean) ** 2 for value in values) / 2)
    assert laptop.steps_per_goal.mean == pytest.approx(mean)
    assert laptop.steps_per_goal.half == pytest.approx(4.302653 * deviation / math.sqrt(3), rel=1e-6)
    assert laptop.mean("late").mean == pytest.approx(0.01)
    assert laptop.lost == 3


def test_configurations_are_compared_by_the_ratio_of_equal_seeds():
    (panel,) = collect(HAND_MADE, rows(), {}).panels
    (answer,) = panel.answers
    ratio = (100 / 50 * 99 / 49 * 98 / 48) ** (1 / 3)
    assert (answer.question.configuration, answer.question.against) == ("sac_laptop", "sac_workstation")
    assert answer.pairs == 3
    assert answer.ratio == pytest.approx(ratio)
    assert answer.low < ratio < answer.high
    assert answer.verdict == "needs more steps per goal"


def test_a_bar_is_held_against_the_means_of_all_seeds(monkeypatch):
    for factor, keeps in ((2.0, False), (2.1, True)):
        question = Question("sac_laptop", "sac_workstation", "worse", AtMost(factor))
        monkeypatch.setattr("experiments.distribution.results.QUESTIONS", (question,))
        (panel,) = collect(HAND_MADE, rows(), {}).panels
        (answer,) = panel.answers
        means = [sum(1000 / (goals - seed) for seed in range(3)) / 3 for goals in (50, 100)]
        assert answer.ratio_of_means == pytest.approx(means[0] / means[1])  # 2.02
        assert answer.keeps_bar is keeps


def test_a_seed_that_one_configuration_lacks_is_compared_with_nothing():
    lacking = {key: row for key, row in rows().items() if key[0] != "sac_laptop" or key[3] == 1}
    (panel,) = collect(HAND_MADE, lacking, {}).panels
    (answer,) = panel.answers
    assert answer.pairs == 1
    assert answer.ratio == pytest.approx(99 / 49)
    assert answer.verdict == "cannot be told apart"  # one pair has no interval


def test_a_run_without_a_goal_counts_with_all_its_steps():
    without = {key: {**row, "goal_steps": []} for key, row in rows().items()}
    for result in collect(HAND_MADE, without, {}).configurations:
        assert result.steps_per_goal.mean == 1000
        assert result.without_goal == 3


def test_the_learning_curve_is_the_steps_per_goal_before_each_of_its_points():
    workstation, laptop = collect(HAND_MADE, rows(), {}).configurations
    # Goals are evenly spaced, so every window that they fill shows that spacing; seeds 1 and 2 miss some at the end.
    assert workstation.at.tolist() == [500, 600, 700, 800, 900, 1000]
    for result, every in ((workstation, 10), (laptop, 20)):
        assert result.curve[0] == pytest.approx([every] * 6)
        assert result.curve[1] == pytest.approx(result.curve[0])  # All seeds are alike: the band has no width.


def test_every_run_has_a_row_also_one_that_crashed():
    crashed = HAND_MADE.jobs()[0].key
    some = {key: row for key, row in rows().items() if key != crashed}
    study = collect(HAND_MADE, some, {crashed: "crashed: why"})
    table = run_rows(study)
    assert len(table) == 6
    assert [row["status"] for row in table] == ["finished"] * 5 + ["crashed: why"]
    assert {row["runs"] for row in curve_rows(study)} == {2, 3}


def test_runs_that_two_panels_show_are_made_and_counted_once():
    (first,) = HAND_MADE.panels
    shared = replace(HAND_MADE, panels=(first, replace(first, name="again", configurations=first.configurations[:1])))
    assert shared.jobs() == HAND_MADE.jobs()
    study = collect(shared, rows(), {})
    assert [len(panel.measured) for panel in study.panels] == [2, 1]
    assert study.panels[1].measured[0].runs == study.panels[0].measured[0].runs
    assert run_rows(study) == run_rows(collect(HAND_MADE, rows(), {}))
    assert curve_rows(study) == curve_rows(collect(HAND_MADE, rows(), {}))
