"""What the numbers say, and whether there are enough of them to say it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from experiments.intervals import Interval, interval
from experiments.minimum_time.jobs import DEFAULT_HEAD, ZERO_HEAD
from experiments.minimum_time.rank_correlation import RankCorrelation, rank_correlation
from experiments.minimum_time.results import CurveResult, PanelResult, RunResult

_SIGNIFICANT = 0.05


@dataclass(frozen=True)
class Correlation:
    """Hits of the initial policy against how well it went."""

    final: RankCorrelation
    """Against steps per goal at the end: negative, if hits help."""
    goals: RankCorrelation | None
    """Against the goals of the whole run: positive, if hits help."""


def correlation(panel: PanelResult) -> Correlation | None:
    """Correlate over a panel's time limits; None where there are too few."""
    if panel.compares_heads:
        return None
    curves = panel.comparable
    hits = [list(curve.hits.values()) for curve in curves]
    final = rank_correlation(hits, [[run.steps_per_goal for run in curve.runs] for curve in curves])
    goals = rank_correlation(hits, [[run.goals for run in curve.runs] for curve in curves])
    return Correlation(final, goals) if final else None


def findings(panel: PanelResult) -> list[str]:
    """Sentences on a panel."""
    if panel.compares_heads:
        return [_heads_finding(panel, limit) for limit in panel.panel.limits]
    return [*_hits_findings(panel), *_limit_findings(panel)]


def _hits_findings(panel: PanelResult) -> list[str]:
    found = correlation(panel)
    if found is None:
        return [
            f"{panel.title}: {len(panel.comparable)} time limits with results; a rank correlation of hits with "
            "performance needs three that differ."
        ]
    sentences = [
        f"{panel.title}: rank correlation of hits with steps per goal at the end {_correlation_text(found.final)}. "
        + _judged(found.final, -1, "more hits go with fewer steps per goal", "more hits go with MORE steps per goal")
    ]
    if found.goals:
        sentences.append(
            f"{panel.title}: rank correlation of hits with the goals of the whole run "
            f"{_correlation_text(found.goals)}. "
            + _judged(found.goals, 1, "more hits go with more goals", "more hits go with FEWER goals")
        )
    return sentences


def _correlation_text(found: RankCorrelation) -> str:
    return (
        f"{found.rho:+.2f} over {found.limits} limits (95 % over resampled seeds: {found.low:+.2f} to "
        f"{found.high:+.2f}; by chance alone at least as strong with p = {found.p:.3f})"
    )


def _judged(found: RankCorrelation, helpful_sign: int, helpful: str, contrary: str) -> str:
    clear = found.p < _SIGNIFICANT and found.low * found.high > 0
    if not clear:
        return "At this size that is no evidence of a relation, nor of its absence."
    return f"Here, {helpful if found.rho * helpful_sign > 0 else contrary}."


def _limit_findings(panel: PanelResult) -> list[str]:
    curves = [curve for curve in panel.curves if curve.runs]
    if len(curves) < 2:
        return []
    best = min(curves, key=lambda curve: curve.final.mean)
    worse: list[str] = []
    open_: list[str] = []
    for curve in curves:
        if curve is not best:
            (worse if _log_ratio(best, curve).low > 0 else open_).append(str(curve.limit))
    text = f"{panel.title}: fewest steps per goal at the end under limit {best.limit} ({interval_text(best.final)})"
    if worse:
        text += f"; clearly more under {', '.join(worse)}"
    if open_:
        text += f"; not told apart from it: {', '.join(open_)}"
    return [f"{text} (95 % intervals of the ratios, seed by seed, each by itself)."]


def _heads_finding(panel: PanelResult, limit: int) -> str:
    by_head = {curve.head: curve for curve in panel.curves if curve.limit == limit}
    zero, default = by_head[ZERO_HEAD], by_head[DEFAULT_HEAD]
    if len(zero.runs) < 2 or len(default.runs) < 2:
        return f"{panel.title}, limit {limit}: too few finished runs to compare the heads."
    final = _log_ratio(zero, default)
    goals = _difference(zero, default, lambda run: float(run.goals))
    text = (
        f"{panel.title}, limit {limit}: steps per goal at the end {interval_text(zero.final)} with the zero head, "
        f"{interval_text(default.final)} with the default one, which needs {math.exp(final.mean):.2f} "
        f"times as many [{math.exp(final.low):.2f}, {math.exp(final.high):.2f}]: {_who(final, 1)}. Goals of a whole "
        f"run: {interval_text(zero.goals)} and {interval_text(default.goals)}, {goals.mean:+.0f} "
        f"[{goals.low:+.0f}, {goals.high:+.0f}]: {_who(goals, -1)}."
    )
    if min(len(zero.hits), len(default.hits)) > 1:
        counts = [list(curve.hits.values()) for curve in (zero, default)]
        text += (
            f" Hits of the initial policy in 20 000 steps: {np.mean(counts[0]):.1f} (zero; deviation over seeds "
            f"{np.std(counts[0], ddof=1):.1f}) and {np.mean(counts[1]):.1f} (default; {np.std(counts[1], ddof=1):.1f})."
        )
    return text


def _who(difference: Interval, sign_for_zero: int) -> str:
    if not (difference.low > 0 or difference.high < 0):
        return "no difference can be told at this size"
    return "the zero head does better" if difference.mean * sign_for_zero > 0 else "the default head does better"


def _log_ratio(one: CurveResult, other: CurveResult) -> Interval:
    """Logarithm of how many times the steps per goal ``other`` needs at the end: they spread by factors."""
    return _difference(one, other, lambda run: math.log(run.steps_per_goal))


def _difference(one: CurveResult, other: CurveResult, value: Callable[[RunResult], float]) -> Interval:
    """``other`` minus ``one``, over the seeds that both have: the same seed is the same world and the same critics."""
    ones = {run.seed: value(run) for run in one.runs}
    return interval([value(run) - ones[run.seed] for run in other.runs if run.seed in ones] or [float("nan")])


def interval_text(of: Interval) -> str:
    """``12.3 +- 0.4``; the mean alone where there is a single value."""
    return f"{of.mean:.1f}" if math.isnan(of.half) else f"{of.mean:.1f} +- {of.half:.1f}"
