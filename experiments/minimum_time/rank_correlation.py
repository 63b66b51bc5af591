"""Do more hits go with better learning? Spearman's rank correlation over time limits, and what it is worth."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

FEWEST = 3
"""Time limits below which a rank correlation says nothing."""
_RESAMPLES = 4000
_LARGEST_EXACT = 8
_PERMUTATIONS = 20_000


@dataclass(frozen=True)
class RankCorrelation:
    """Spearman's coefficient with its uncertainty from two sources."""

    rho: float
    low: float
    """2.5 % quantile over resampled seeds: what these time limits would show with other seeds."""
    high: float
    """97.5 % quantile."""
    p: float
    """Share of all orders of the time limits that correlate at least as much, either way: the chance of it if hits
    and performance had nothing to do with each other."""
    limits: int
    """Time limits compared."""


def rank_correlation(hits: Sequence[Sequence[float]], performance: Sequence[Sequence[float]]) -> RankCorrelation | None:
    """Correlate the means of two quantities over time limits; None where there is nothing to correlate.

    Args:
        hits: of each time limit, one value a seed.
        performance: the same.
    """
    if len(hits) < FEWEST:
        return None
    x, y = _means(hits), _means(performance)
    rho = float(spearman(x, y))
    if math.isnan(rho):
        return None
    rng = np.random.default_rng(0)
    rhos = spearman(_resampled_means(hits, rng), _resampled_means(performance, rng))
    low, high = np.nanquantile(rhos, [0.025, 0.975])
    return RankCorrelation(rho, float(low), float(high), _permutation_p(x, y, rho, rng), len(hits))


def spearman(x: FloatArray, y: FloatArray) -> FloatArray:
    """Correlation of the ranks along the last axis; NaN where all of one kind are equal.

    Equal values share the mean of their ranks.
    """
    a, b = _centred_ranks(x), _centred_ranks(y)
    covariance = (a * b).sum(axis=-1)
    scale = np.sqrt((a * a).sum(axis=-1) * (b * b).sum(axis=-1))
    rho: FloatArray = np.divide(covariance, scale, out=np.full(np.shape(scale), np.nan), where=scale > 0)
    return rho


def _centred_ranks(values: FloatArray) -> FloatArray:
    one, other = values[..., :, None], values[..., None, :]
    ranks = ((one > other).sum(axis=-1) + (one >= other).sum(axis=-1) - 1) / 2
    centred: FloatArray = ranks - ranks.mean(axis=-1, keepdims=True)
    return centred


def _means(values: Sequence[Sequence[float]]) -> FloatArray:
    return np.array([np.mean(of_limit) for of_limit in values])


def _resampled_means(values: Sequence[Sequence[float]], rng: np.random.Generator) -> FloatArray:
    """(resamples, limits): means of as many values, drawn with replacement from each limit's."""
    columns = []
    for of_limit in values:
        chosen = rng.integers(len(of_limit), size=(_RESAMPLES, len(of_limit)))
        columns.append(np.asarray(of_limit, dtype=np.float64)[chosen].mean(axis=1))
    return np.stack(columns, axis=1)


def _permutation_p(x: FloatArray, y: FloatArray, rho: float, rng: np.random.Generator) -> float:
    if len(y) <= _LARGEST_EXACT:
        orders = np.array(list(itertools.permutations(range(len(y)))))
    else:
        orders = np.argsort(rng.random((_PERMUTATIONS, len(y))), axis=1)
    rhos = spearman(np.broadcast_to(x, orders.shape), y[orders])
    return float(np.mean(np.abs(rhos) >= abs(rho) - 1e-9))
