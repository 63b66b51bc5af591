"""The guideline for the time limit (thesis 7.3) as a decision from evidence. No task, no randomness: arithmetic.

The thesis: collect the initial policy's target hits for a set of time limits; keep those with more than 10 hits in 20
000 steps that also exceed the expected minimum steps to the goal; start with the smallest of them.

*More than 10 hits* is taken as it stands, and asked of the mean over seeds. A mean near 10 cannot be told from 10 by
any reasonable number of seeds: such a limit is borderline, which is an answer, too.

*Expected minimum steps* is not defined further. The thesis gives 25 to 30 for Reacher and Ball-in-Cup, and explains:
if the goal takes longer than the limit, the agent risks a suboptimal policy. Starts are random, so the minimum steps
are a distribution over starts. Its mean would not do: from half of Ball-in-Cup's starts the ball can be caught within
10 steps, from the others in no fewer than 31, and under a limit at the mean, 21, every other attempt would be lost
from its start, whatever is learnt. Here a limit exceeds the minimum steps if the goal can be reached within it from at
least nine of ten starts, and the steps within which nine of ten starts can reach the goal are called the minimum
steps. These are also about the numbers that the thesis has: 26 for Reacher-Easy and Reacher-Hard (where the means are
14 and 16), 37 for Ball-in-Cup. How they are found: :mod:`experiments.target_hits.search`.

Both questions are answered by sequential tests (:mod:`experiments.target_hits.certainty`), so that counting stops as
soon as the answer is clear. The probability that any of the answer's statements is wrong is at most 1 - confidence:
half of it for the starts, half shared by the limits' hits. Statements on starts are about what the search found: that a
limit is long enough holds for whoever acts, that it is too short holds as far as the search can tell.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from experiments.target_hits.certainty import FEWEST_BLOCKS, Side, side_of_mean, side_of_share
from experiments.target_hits.counting import STEPS

SUFFICIENT_HITS = 10.0
"""Of the initial policy in 20 000 steps (thesis 7.3)."""
SHARE_OF_STARTS = 0.9
AS_FAST_AS_CAN_BE = 1.25
"""A task is trivial if the initial policy's mean steps to the goal are at most so many times the fewest that are known:
whatever is done, the goal comes. For the tasks of the thesis they are some 30 times as many, and more."""


@dataclass(frozen=True)
class Thoroughness:
    """How sure an answer has to be, and when looking ends without being sure."""

    confidence: float = 0.95
    most_seeds: int = 30
    """Counts a limit, as in the thesis's figures."""
    fewest_starts: int = 20
    most_starts: int = 60
    starts_if_hopeless: int = 10
    """Where no limit has enough hits: only to tell a goal that is hard to find from one that cannot be reached."""


@dataclass(frozen=True)
class Evidence:
    """What was seen."""

    hits: Mapping[int, tuple[int, ...]]
    """Limit -> hits in 20 000 steps, one count a seed."""
    starts: tuple[int | None, ...] = ()
    """Shortest way found, steps, from each start searched from; None: no way was found."""

    def mean_hits(self, limit: int) -> float:
        """Mean over seeds."""
        return float(np.mean(self.hits[limit]))

    def share_in_time(self, limit: int) -> float:
        """Share of the starts from which the goal can be reached within the limit; NaN without starts."""
        if not self.starts:
            return math.nan
        return self.starts_in_time(limit) / len(self.starts)

    def starts_in_time(self, limit: int) -> int:
        """Starts from which the goal can be reached within the limit."""
        return sum(steps is not None and steps <= limit for steps in self.starts)

    def steps_per_hit(self, limit: int) -> float:
        """Steps that the initial policy takes from hit to hit, resets included."""
        mean = self.mean_hits(limit)
        return STEPS / mean if mean else math.inf

    @property
    def mean_way(self) -> float:
        """Mean of the shortest ways found, over the starts from which there is one; NaN without."""
        known = [steps for steps in self.starts if steps is not None]
        return float(np.mean(known)) if known else math.nan

    @property
    def minimum_steps(self) -> int | None:
        """Steps within which :data:`SHARE_OF_STARTS` of the starts can reach the goal; None: not known to be finite."""
        needed = math.ceil(SHARE_OF_STARTS * len(self.starts))
        known = sorted(steps for steps in self.starts if steps is not None)
        return known[needed - 1] if 0 < needed <= len(known) else None


@dataclass(frozen=True)
class LimitFinding:
    """What is known of a time limit."""

    limit: int
    hits: Side
    """Of the mean, against :data:`SUFFICIENT_HITS`."""
    length: Side
    """Of the share of starts in time, against :data:`SHARE_OF_STARTS`: BELOW is too short."""

    @property
    def excluded(self) -> bool:
        """It is clear that this limit is not admissible."""
        return Side.BELOW in (self.hits, self.length)

    @property
    def admissible(self) -> bool:
        """It is clear that this limit is admissible."""
        return self.hits is self.length is Side.ABOVE


class Answer(Enum):
    """What comes of it."""

    TRIVIAL = "trivial"
    """The initial policy reaches the goal as fast as anyone could, or a step suffices: there is no time to save."""
    USE = "use"
    """There is an admissible limit."""
    BORDERLINE = "borderline"
    """There may be one, and no reasonable effort can tell."""
    TOO_SHORT = "too short"
    """Limits with enough hits are too short, longer ones have too few; or all that were tried are too short."""
    DO_NOT_TRY = "do not try"
    """No limit has enough hits."""


@dataclass(frozen=True)
class Verdict:
    """The guideline's answer."""

    answer: Answer
    limit: int | None
    """The limit to start with, or under which the task is trivial; None where there is none."""
    borderline: tuple[int, ...]
    """Limits of which it cannot be told whether they are admissible, as far as it would matter."""
    findings: Mapping[int, LimitFinding] = field(default_factory=dict)


@dataclass(frozen=True)
class NextLook:
    """What would bring the answer nearer; neither: it is there."""

    limit: int | None = None
    """Count hits of more seeds under this limit."""
    starts: bool = False
    """Search from more starts."""

    @property
    def needed(self) -> bool:
        """False: there is nothing more to look at."""
        return self.limit is not None or self.starts


def find(evidence: Evidence, thoroughness: Thoroughness) -> dict[int, LimitFinding]:
    """Limit -> what is known of it, shortest first."""
    error = 1 - thoroughness.confidence
    findings = {}
    for limit in sorted(evidence.hits):
        length = side_of_share(evidence.starts_in_time(limit), len(evidence.starts), SHARE_OF_STARTS, error / 2)
        hits = side_of_mean(evidence.hits[limit], SUFFICIENT_HITS, error / 2 / len(evidence.hits))
        findings[limit] = LimitFinding(limit, hits, length)
    return findings


def next_look(evidence: Evidence, thoroughness: Thoroughness) -> NextLook:
    """Say what to look at next: the shortest limit that may be admissible comes first, longer ones do not matter."""
    short = [limit for limit in sorted(evidence.hits) if len(evidence.hits[limit]) < FEWEST_BLOCKS]
    if short:
        return NextLook(limit=short[0])
    findings = find(evidence, thoroughness)
    if all(finding.hits is Side.BELOW for finding in findings.values()):
        return NextLook(starts=len(evidence.starts) < thoroughness.starts_if_hopeless)
    if len(evidence.starts) < thoroughness.fewest_starts:
        return NextLook(starts=True)
    for limit, finding in findings.items():
        if finding.excluded:
            continue
        if finding.admissible:
            break
        count = finding.hits is Side.OPEN and len(evidence.hits[limit]) < thoroughness.most_seeds
        search = finding.length is Side.OPEN and len(evidence.starts) < thoroughness.most_starts
        if count or search:
            return NextLook(limit if count else None, search)
    return NextLook()


def judge(evidence: Evidence, thoroughness: Thoroughness) -> Verdict:
    """Decide, with whatever evidence there is."""
    findings = find(evidence, thoroughness)
    if (trivial_limit := _trivial_limit(evidence, findings)) is not None:
        return Verdict(Answer.TRIVIAL, trivial_limit, (), findings)
    admissible = next((limit for limit, finding in findings.items() if finding.admissible), None)
    open_limits = tuple(
        limit
        for limit, finding in findings.items()
        if not finding.excluded and not finding.admissible and (admissible is None or limit < admissible)
    )
    if admissible is not None:
        return Verdict(Answer.USE, admissible, open_limits, findings)
    if all(finding.hits is Side.BELOW for finding in findings.values()):
        # Under limits that are all too short, few hits say nothing about longer ones.
        longest_needed = evidence.minimum_steps
        too_short = longest_needed is not None and max(findings) < longest_needed
        return Verdict(Answer.TOO_SHORT if too_short else Answer.DO_NOT_TRY, None, (), findings)
    if open_limits:
        return Verdict(Answer.BORDERLINE, _most_promising(evidence, open_limits), open_limits, findings)
    return Verdict(Answer.TOO_SHORT, None, (), findings)


def _trivial_limit(evidence: Evidence, findings: Mapping[int, LimitFinding]) -> int | None:
    """The limit under which the task shows that it is trivial, if it is.

    Of limits that are long enough only: under shorter ones those starts are chosen by chance from which it is near.
    """
    long_enough = [
        limit
        for limit, finding in findings.items()
        if finding.hits is not Side.BELOW and evidence.starts and evidence.share_in_time(limit) >= SHARE_OF_STARTS
    ]
    if not long_enough:
        return None
    fastest = min(long_enough, key=evidence.steps_per_hit)
    trivial = evidence.minimum_steps == 1 or evidence.steps_per_hit(fastest) <= AS_FAST_AS_CAN_BE * evidence.mean_way
    return fastest if trivial else None


def _most_promising(evidence: Evidence, limits: tuple[int, ...]) -> int:
    """The shortest limit that passes both thresholds as measured; else that with the most hits of the long enough."""
    long_enough = [limit for limit in limits if evidence.share_in_time(limit) >= SHARE_OF_STARTS]
    passing = [limit for limit in long_enough if evidence.mean_hits(limit) > SUFFICIENT_HITS]
    if passing:
        return passing[0]
    return max(long_enough or limits, key=evidence.mean_hits)
