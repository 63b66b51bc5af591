"""Learning curves and final performance, from goals placed by hand."""

import numpy as np
import pytest

from experiments.minimum_time.curves import curve_steps, final_steps_per_goal, goals_within, return_curve


def test_a_curve_begins_with_its_first_whole_window_and_ends_with_the_run():
    np.testing.assert_array_equal(curve_steps(100, 50), [50, 60, 70, 80, 90, 100])
    np.testing.assert_array_equal(curve_steps(105, 50), [55, 65, 75, 85, 95, 105])
    np.testing.assert_array_equal(curve_steps(40, 50), [40])


def test_a_point_is_the_mean_return_of_the_episodes_that_ended_in_its_window():
    # Episodes of 10, 20, 30 and 5 steps.
    curve = return_curve([10, 30, 60, 65], np.array([40.0, 60.0, 65.0, 100.0]), 40)
    # (0, 40]: 10 and 20; (20, 60]: 20 and 30; (25, 65]: 20, 30 and 5; (60, 100]: 5 alone.
    np.testing.assert_allclose(curve, [-15.0, -25.0, -55 / 3, -5.0])


def test_where_no_episode_ended_it_is_minus_the_steps_since_the_last_goal():
    np.testing.assert_allclose(return_curve([10], np.array([5.0, 60.0, 90.0]), 40), [-5.0, -50.0, -80.0])
    np.testing.assert_allclose(return_curve([], np.array([40.0, 80.0]), 40), [-40.0, -80.0])


def test_a_window_without_goal_counts_as_at_least_its_own_steps():
    # The goal leaves the window after step 140: until then its episode counts.
    np.testing.assert_allclose(return_curve([70, 100], np.array([139.0, 140.0, 141.0]), 40), [-30.0, -40.0, -41.0])


def test_the_thesis_example_returns_minus_385():
    # Three time-outs of 100 steps with resets of 20, then the goal in 25 (section 6.1).
    goal = 3 * (100 + 20) + 25
    assert return_curve([goal], np.array([400.0]), 400) == -385


@pytest.mark.parametrize(
    ("goals", "steps", "expected"),
    [
        ([4500, 4750, 5000], 5000, 1000 / 3),
        ([4000, 4001], 5000, 1000.0),  # the first is just outside of the last 1000 steps
        ([4000], 5000, 1000.0),
        ([700], 5000, 4300.0),
        ([], 5000, 5000.0),
        ([10, 20], 40, 20.0),  # a run shorter than the window
        ([], 40, 40.0),
    ],
)
def test_final_performance_is_steps_per_goal_and_without_goal_steps_since_the_last(goals, steps, expected):
    assert final_steps_per_goal(goals, steps) == pytest.approx(expected)


def test_goals_of_the_last_steps_are_counted_with_the_end_and_without_the_beginning():
    assert goals_within([4000, 4001, 5000], 5000) == 2
