"""Confidence intervals against the printed tables of Student's t."""

import math

import numpy as np
import pytest

from experiments.intervals import interval, mean_and_half_width, standard_error, student_t_975


@pytest.mark.parametrize(
    ("degrees", "quantile"), [(1, 12.706), (2, 4.303), (4, 2.776), (9, 2.262), (29, 2.045), (1000, 1.962)]
)
def test_quantiles_are_those_of_the_table(degrees, quantile):
    assert student_t_975(degrees) == pytest.approx(quantile, abs=5e-4)


def test_an_interval_is_the_mean_and_t_times_its_standard_error():
    # Deviation 2, standard error 2 / sqrt(5), t of 4 degrees 2.776.
    values = [8.0, 9.0, 10.0, 10.0 - math.sqrt(3), 10.0 + math.sqrt(3)]
    deviation = float(np.std(values, ddof=1))
    found = interval(values)
    assert found.mean == pytest.approx(9.4)
    assert found.half == pytest.approx(2.776 * deviation / math.sqrt(5), rel=1e-3)
    assert (found.low, found.high) == (found.mean - found.half, found.mean + found.half)


def test_bands_are_taken_point_by_point_over_the_seeds():
    mean, half = mean_and_half_width(np.array([[1.0, 5.0], [3.0, 5.0]]))
    np.testing.assert_allclose(mean, [2.0, 5.0])
    np.testing.assert_allclose(half, [12.706, 0.0], rtol=1e-3)  # standard error 1, one degree of freedom


def test_a_single_value_has_no_interval():
    assert math.isnan(interval([3.0]).half)
    assert math.isnan(standard_error([3.0]))
    assert standard_error([1.0, 3.0]) == pytest.approx(1.0)
