"""Bars, by hand."""

import math

from experiments.distribution.bars import AtMost, ClearlyAbove, Equivalent
from experiments.intervals import Interval


def test_at_most_is_about_the_means_alone():
    assert AtMost(1.5).holds(Interval(15.0, 100.0), Interval(10.0, 0.1))
    assert not AtMost(1.5).holds(Interval(15.1, 100.0), Interval(10.0, 0.1))


def test_equivalent_bounds_the_difference_on_both_sides():
    against = Interval(10.0, 1.0)
    assert [Equivalent(0.25).holds(Interval(mean, 1.0), against) for mean in (7.4, 7.5, 12.5, 12.6)] == [
        False,
        True,
        True,
        False,
    ]


def test_clearly_above_wants_the_intervals_apart():
    against = Interval(10.0, 2.0)
    assert ClearlyAbove().holds(Interval(15.0, 2.5), against)
    assert not ClearlyAbove().holds(Interval(15.0, 3.0), against)  # They touch.
    assert not ClearlyAbove().holds(Interval(5.0, 1.0), against)


def test_one_run_shows_nothing_to_be_clearly_above():
    assert not ClearlyAbove().holds(Interval(100.0, math.nan), Interval(10.0, 1.0))
