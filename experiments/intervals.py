"""Means over seeds and how far to trust them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

_PANELS = 2000
_LEVEL = 0.975


@dataclass(frozen=True)
class Interval:
    """A mean and its 95 % confidence interval."""

    mean: float
    half: float
    """Half of the interval's width; NaN for a single value."""

    @property
    def low(self) -> float:
        """Lower end."""
        return self.mean - self.half

    @property
    def high(self) -> float:
        """Upper end."""
        return self.mean + self.half


def student_t_975(degrees: int) -> float:
    """97.5 % quantile of Student's t distribution.

    With x = sqrt(degrees) tan(u), the density becomes proportional to cos(u) ** (degrees - 1) on +-pi/2; the quantile
    is found by bisection on its integral, taken by Simpson's rule.
    """
    whole = math.sqrt(math.pi) * math.exp(math.lgamma(degrees / 2) - math.lgamma((degrees + 1) / 2))
    low, high = 0.0, math.pi / 2
    while high - low > 1e-12:
        middle = (low + high) / 2
        if 0.5 + _cosine_integral(middle, degrees - 1) / whole < _LEVEL:
            low = middle
        else:
            high = middle
    return math.sqrt(degrees) * math.tan(low)


def mean_and_half_width(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean over the first axis, and half the width of its 95 % interval (Student's t), NaN for a single value.

    Args:
        values: (seeds, ...).
    """
    mean = values.mean(axis=0)
    n = len(values)
    if n < 2:
        return mean, np.full_like(mean, np.nan)
    half: FloatArray = student_t_975(n - 1) * values.std(axis=0, ddof=1) / math.sqrt(n)
    return mean, half


def interval(values: Sequence[float]) -> Interval:
    """Mean of some values with its 95 % interval (Student's t)."""
    mean, half = mean_and_half_width(np.asarray(values, dtype=np.float64))
    return Interval(float(mean), float(half))


def standard_error(values: Sequence[float]) -> float:
    """Of the mean; NaN for a single value."""
    return float(np.std(values, ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else math.nan


def _cosine_integral(to: float, power: int) -> float:
    """Integral of cos ** power from 0, by Simpson's rule."""
    values = np.cos(np.linspace(0.0, to, _PANELS + 1)) ** power
    weights = np.ones(_PANELS + 1)
    weights[1:-1:2], weights[2:-1:2] = 4.0, 2.0
    return float(values @ weights) * to / _PANELS / 3.0
