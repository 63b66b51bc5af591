"""Advantages by hand: what is added up, and where it ends."""

from __future__ import annotations

import numpy as np
import pytest

from common.algorithms.advantages import advantages

REWARD = np.array([-1.0, -1.0, -1.0, -1.0])
VALUE = np.array([-4.0, -3.0, -2.0, -1.0])
NEXT_VALUE = np.array([-3.0, -2.0, -1.0, -6.0])
GOING_ON = np.zeros(4)


def of(terminated=GOING_ON, goes_on=(True, True, True, False), discount=0.5, gae_lambda=0.5):
    return advantages(
        REWARD, VALUE, NEXT_VALUE, np.array(terminated), np.array(goes_on), discount=discount, gae_lambda=gae_lambda
    ).tolist()


def test_four_transitions_in_a_row_that_end_without_the_goal():
    # delta: -1 - 1.5 + 4 = 1.5, -1 - 1 + 3 = 1, -1 - .5 + 2 = .5, -1 - 3 + 1 = -3 (the last next value counts).
    # H, each with a quarter of the one after it: -3, .5 - .75, 1 - .0625, 1.5 + .234375.
    assert of() == [1.734375, 0.9375, -0.25, -3.0]


def test_at_the_goal_nothing_is_to_come():
    # The last delta is -1 + 1 = 0, whatever the next value.
    assert of(terminated=(0, 0, 0, 1)) == [1.5 + 0.25 * (1.0 + 0.25 * 0.5), 1.125, 0.5, 0.0]


def test_where_an_attempt_ends_by_its_time_limit_the_next_ones_errors_are_not_added():
    # The second ends an attempt: its next value (-2) still counts, what follows it in the rollout does not.
    assert of(goes_on=(True, False, True, False)) == [1.75, 1.0, -0.25, -3.0]


def test_nothing_is_carried_over_the_goal_even_if_the_rows_follow_each_other():
    assert of(terminated=(0, 1, 0, 0)) == [1.5 + 0.25 * 2.0, 2.0, -0.25, -3.0]


@pytest.mark.parametrize(
    ("gae_lambda", "expected"),
    [
        (0.0, [0.0, 0.0, 0.0, -6.0]),  # the errors of one transition each
        (1.0, [-6.0, -6.0, -6.0, -6.0]),  # all that came, -1 each and -6 at the end, minus the value
    ],
)
def test_lambda_goes_from_one_transition_to_all_that_came(gae_lambda, expected):
    assert of(discount=1.0, gae_lambda=gae_lambda) == expected
