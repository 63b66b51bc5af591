"""Tests that may be looked at after every observation."""

import math

import numpy as np
import pytest

from experiments.target_hits.certainty import FEWEST_BLOCKS, Side, side_of_mean, side_of_share

ERROR = 0.025


def looks_until_clear(draw, most=400):
    counts = []
    while len(counts) < most:
        counts.append(draw())
        side = side_of_mean(counts, 10.0, ERROR)
        if side is not Side.OPEN:
            return side, len(counts)
    return Side.OPEN, most


def test_the_ratio_for_counts_is_that_of_the_gamma_mixture():
    # Spread below that of Poisson counts to the threshold 2, so nothing is corrected. With the prior Gamma(2, 1) the
    # ratio is G(2 + 30) / G(2) / (1 + 5)^32 * e^(5 * 2) / 2^30.
    counts = [6, 6, 6, 6, 6]
    log_ratio = math.log(math.factorial(31)) - 32 * math.log(6) + 10 - 30 * math.log(2)
    assert side_of_mean(counts, 2.0, math.exp(-log_ratio) * 1.001) is Side.ABOVE
    assert side_of_mean(counts, 2.0, math.exp(-log_ratio) * 0.999) is Side.OPEN


def test_the_ratio_for_shares_is_that_of_the_beta_mixture():
    # Prior Beta(1.8, .2), 3 of 3 good: (1.8 * 2.8 * 3.8) / (2 * 3 * 4) / .9^3 = .798 / .729
    ratio = (1.8 * 2.8 * 3.8) / (2 * 3 * 4) / 0.9**3
    assert side_of_share(3, 3, 0.9, 1 / ratio * 1.001) is Side.ABOVE
    assert side_of_share(3, 3, 0.9, 1 / ratio * 0.999) is Side.OPEN


@pytest.mark.parametrize(("mean", "side"), [(0.2, Side.BELOW), (5, Side.BELOW), (16, Side.ABOVE), (50, Side.ABOVE)])
def test_what_is_far_from_the_threshold_is_clear_soon(mean, side):
    rng = np.random.default_rng(0)
    for _ in range(20):
        assert looks_until_clear(lambda: int(rng.poisson(mean)), most=30)[0] is side


def test_what_is_at_the_threshold_is_hardly_ever_called_clear_however_often_one_looks():
    rng = np.random.default_rng(0)
    called = sum(looks_until_clear(lambda: int(rng.poisson(10)), most=60)[0] is not Side.OPEN for _ in range(100))
    assert called <= 5


def test_counts_that_spread_more_than_poisson_ones_take_longer():
    even, uneven = [15, 16, 14, 15, 15] * 3, [2, 30, 4, 29, 10] * 3
    assert sum(even) == sum(uneven)
    assert side_of_mean(even, 10.0, ERROR) is Side.ABOVE
    assert side_of_mean(uneven, 10.0, ERROR) is Side.OPEN


def test_nothing_is_said_before_the_spread_of_the_counts_is_known():
    assert side_of_mean([100] * (FEWEST_BLOCKS - 1), 10.0, ERROR) is Side.OPEN
    assert side_of_mean([100] * FEWEST_BLOCKS, 10.0, ERROR) is Side.ABOVE
    assert side_of_share(0, 0, 0.9, ERROR) is Side.OPEN


def test_no_hits_at_all_are_clear():
    assert side_of_mean([0] * FEWEST_BLOCKS, 10.0, ERROR) is Side.BELOW


@pytest.mark.parametrize(
    ("successes", "trials", "side"),
    [(60, 60, Side.ABOVE), (20, 20, Side.OPEN), (54, 60, Side.OPEN), (12, 20, Side.BELOW), (3, 20, Side.BELOW)],
)
def test_shares_of_starts(successes, trials, side):
    assert side_of_share(successes, trials, 0.9, ERROR) is side
