"""Is a rate above a threshold? Tests that may be looked at after every observation.

Counting until an ordinary test is significant finds something in the end, whatever is true. These tests compare the
threshold with a mixture of all other values; that ratio exceeds 1 / error with a probability of at most ``error`` at
any time at all if the threshold is the truth (Ville's inequality; Robbins, Statistical methods related to the law of
the iterated logarithm, Annals of Mathematical Statistics 41, 1970). So one may stop as soon as it does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum

import numpy as np

_PRIOR_BLOCKS = 1.0
"""Weight of the mixture's centre, the threshold, in blocks of observation."""
_PRIOR_STARTS = 2.0
"""The same, in starts."""
FEWEST_BLOCKS = 5
"""Before so many counts nothing is said: their spread is not known."""


class Side(Enum):
    """Where the truth is, as far as is known."""

    ABOVE = "above"
    BELOW = "below"
    OPEN = "open"
    """Not clear yet."""


def side_of_mean(counts: Sequence[int], threshold: float, error: float) -> Side:
    """Tell where the mean of counts lies.

    Counts of rare events are Poisson, at least; where goals differ in difficulty their variance is larger than their
    mean. Then so many fewer events are taken to have been seen, which is the quasi-Poisson correction: approximate,
    as the spread is estimated from the same counts.

    Args:
        counts: hits, each in one block of steps.
        threshold: to compare the mean with.
        error: probability, at most, of telling a side when the mean is at the threshold.
    """
    if len(counts) < FEWEST_BLOCKS:
        return Side.OPEN
    spread = max(1.0, float(np.var(counts, ddof=1)) / max(float(np.mean(counts)), 1e-9))
    blocks, events = len(counts) / spread, sum(counts) / spread
    shape = _PRIOR_BLOCKS * threshold
    log_ratio = (
        shape * math.log(_PRIOR_BLOCKS)
        - math.lgamma(shape)
        + math.lgamma(shape + events)
        - (shape + events) * math.log(_PRIOR_BLOCKS + blocks)
        + blocks * threshold
        - events * math.log(threshold)
    )
    return _side(log_ratio, error, events / blocks, threshold)


def side_of_share(successes: int, trials: int, threshold: float, error: float) -> Side:
    """Tell where a share lies; the arguments are as in :func:`side_of_mean`."""
    if not trials:
        return Side.OPEN
    failures = trials - successes
    good, bad = _PRIOR_STARTS * threshold, _PRIOR_STARTS * (1 - threshold)
    log_ratio = (
        _log_beta(good + successes, bad + failures)
        - _log_beta(good, bad)
        - successes * math.log(threshold)
        - failures * math.log(1 - threshold)
    )
    return _side(log_ratio, error, successes / trials, threshold)


def _side(log_ratio: float, error: float, estimate: float, threshold: float) -> Side:
    if log_ratio < -math.log(error):
        return Side.OPEN
    return Side.ABOVE if estimate > threshold else Side.BELOW


def _log_beta(a: float, b: float) -> float:
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)
