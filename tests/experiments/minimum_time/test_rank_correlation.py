"""Spearman's coefficient, its chance and its spread, where they can be counted by hand."""

import math

import numpy as np
import pytest

from experiments.minimum_time.rank_correlation import rank_correlation, spearman


def test_it_depends_on_the_order_alone():
    assert spearman(np.array([1.0, 2.0, 30.0]), np.array([5.0, 6.0, 6.5])) == pytest.approx(1.0)
    assert spearman(np.array([1.0, 2.0, 30.0]), np.array([9.0, 1.0, 0.5])) == pytest.approx(-1.0)


def test_it_is_one_minus_six_times_the_squared_rank_differences():
    # Ranks 1 2 3 4 5 against 2 1 4 3 5: differences 1 1 1 1 0, so 1 - 6 * 4 / (5 * 24).
    x, y = np.array([1.0, 2.0, 3.0, 4.0, 5.0]), np.array([20.0, 10.0, 40.0, 30.0, 50.0])
    assert spearman(x, y) == pytest.approx(0.8)


def test_equal_values_share_their_mean_rank():
    # Ranks 1, 2.5, 2.5, 4 against 1 2 3 4: covariance 4.5, variances 4.5 and 5.
    assert spearman(np.array([1.0, 7.0, 7.0, 9.0]), np.array([1.0, 2.0, 3.0, 4.0])) == pytest.approx(4.5 / 22.5**0.5)


def test_without_any_difference_there_is_none():
    assert math.isnan(spearman(np.ones(4), np.arange(4.0)))
    assert rank_correlation([[1], [1], [1]], [[1], [2], [3]]) is None
    assert rank_correlation([[1], [2]], [[1], [2]]) is None


def test_chance_is_the_share_of_orders_that_are_as_extreme():
    # Of 4! = 24 orders, one rises and one falls throughout.
    found = rank_correlation([[1], [2], [3], [4]], [[8], [6], [4], [2]])
    assert (found.rho, found.limits) == (pytest.approx(-1.0), 4)
    assert found.p == pytest.approx(2 / 24)
    # Three limits can never be significant: 2 of 6.
    assert rank_correlation([[1], [2], [3]], [[1], [2], [3]]).p == pytest.approx(2 / 6)


def test_many_limits_are_judged_by_random_orders():
    rising = [[value] for value in range(10)]
    assert rank_correlation(rising, rising).p <= 1e-3
    assert rank_correlation(rising, [[value % 3] for value in range(10)]).p > 0.05


def test_seeds_that_agree_leave_no_doubt_and_seeds_that_do_not_leave_much():
    hits = [[10, 11], [20, 21], [30, 31], [40, 41]]
    sure = rank_correlation(hits, [[90, 91], [70, 71], [50, 51], [30, 31]])
    assert (sure.rho, sure.low, sure.high) == (pytest.approx(-1), pytest.approx(-1), pytest.approx(-1))
    unsure = rank_correlation(hits, [[0, 100], [5, 90], [10, 85], [20, 60]])
    assert unsure.low < -0.5 < 0.5 < unsure.high


def test_the_same_numbers_give_the_same_interval():
    rng = np.random.default_rng(0)
    hits, final = rng.integers(0, 50, (5, 6)), rng.random((5, 6))
    assert rank_correlation(hits, final) == rank_correlation(hits, final)
