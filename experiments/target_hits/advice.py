"""The guideline's answer in words: what to set, why, and how it was found out."""

from __future__ import annotations

import math
from dataclasses import dataclass

from experiments.target_hits.certainty import Side
from experiments.target_hits.counting import STEPS
from experiments.target_hits.guideline import (
    SHARE_OF_STARTS,
    SUFFICIENT_HITS,
    Answer,
    Evidence,
    LimitFinding,
    Thoroughness,
    Verdict,
)
from experiments.target_hits.table import TRIVIAL_ADVICE, hits_text, standard_error
from experiments.wording import counted, plural

_HITS = f"{SUFFICIENT_HITS:g} hits"


@dataclass(frozen=True)
class TaskFacts:
    """What the words need to know of the task."""

    name: str
    preset: str
    action_cycle_time_s: float
    reset_steps: int
    effort: int
    """Most steps of the search from one start."""

    def duration(self, steps: int) -> str:
        """Steps, and what they are in seconds of the real robot's clock."""
        return f"{counted(steps, 'step')} ({steps * self.action_cycle_time_s:.3g} s)"


def advice(facts: TaskFacts, evidence: Evidence, verdict: Verdict, thoroughness: Thoroughness) -> str:
    """All there is to say, as text."""
    return "\n\n".join(
        [
            f"{facts.name} ({facts.preset}): an action cycle is {1000 * facts.action_cycle_time_s:g} ms, "
            f"a reset takes {facts.duration(facts.reset_steps)}",
            _table(facts, evidence, verdict),
            f"Minimum steps: {_minimum(facts, evidence)}",
            f"Admissible limits: {_admissible(evidence, verdict)}",
            f"Recommended time limit: {_headline(facts, verdict)}",
            f"Why: {_reason(evidence, verdict)}",
            f"How sure: {_certainty(evidence, thoroughness)}",
        ]
    )


def _table(facts: TaskFacts, evidence: Evidence, verdict: Verdict) -> str:
    lines = [f"{'limit':>7} {'seconds':>8}   {'hits in 20 000 steps':<20}  {'starts in time':>14}   finding"]
    for limit, finding in verdict.findings.items():
        counts = evidence.hits[limit]
        hits = f"{hits_text(evidence.mean_hits(limit), standard_error(counts))} ({len(counts)})"
        share = evidence.share_in_time(limit)
        starts = "-" if math.isnan(share) else f"{100 * share:.0f} %"
        seconds = f"{limit * facts.action_cycle_time_s:g}"
        lines.append(f"{limit:>7} {seconds:>8}   {hits:<20}  {starts:>14}   {_finding(evidence, finding)}")
    return "\n".join(lines)


def _finding(evidence: Evidence, finding: LimitFinding) -> str:
    if finding.length is Side.BELOW:
        length = "too short"
    elif finding.length is Side.OPEN and evidence.starts:
        length = "perhaps too short"
    else:
        length = ""
    hits = {Side.ABOVE: "enough hits", Side.BELOW: "too few hits"}.get(
        finding.hits, _open_hits(evidence, finding.limit)
    )
    return ", ".join(filter(None, [length, hits]))


def _open_hits(evidence: Evidence, limit: int) -> str:
    more = evidence.mean_hits(limit) > SUFFICIENT_HITS
    return f"{'more' if more else 'fewer'} than {_HITS}, not clearly"


def _minimum(facts: TaskFacts, evidence: Evidence) -> str:
    searched, found = len(evidence.starts), sum(steps is not None for steps in evidence.starts)
    if not searched:
        return "not looked for, since no limit has enough hits."
    how = (
        f"a search tried plans of commands from {counted(searched, 'random start')}, up to "
        f"{counted(facts.effort, 'step')} each, and found a way to the goal from {found} of them."
    )
    if found:
        how += " What it finds is possible; the true minimum can only be less."
    else:
        how += " That it found none proves nothing; with a larger --effort it looks longer."
    steps = evidence.minimum_steps
    if steps is None:
        return f"not known; {how}"
    known = sorted(steps for steps in evidence.starts if steps is not None)
    return (
        f"{facts.duration(steps)}: whoever knows the way reaches the goal within {'it' if steps == 1 else 'them'} "
        "from nine of ten starts "
        f"(from half of the starts within {known[(searched + 1) // 2 - 1]}). {how[0].upper()}{how[1:]}"
    )


def _admissible(evidence: Evidence, verdict: Verdict) -> str:
    if verdict.answer is Answer.TRIVIAL:
        return "of no importance"
    clear = [f"{limit}" for limit, finding in verdict.findings.items() if finding.admissible]
    perhaps = [
        f"{limit}"
        for limit, finding in verdict.findings.items()
        if not finding.excluded and not finding.admissible and evidence.starts
    ]
    text = ", ".join(clear) or "none for certain"
    return f"{text}; perhaps {', '.join(perhaps)}" if perhaps and verdict.answer is not Answer.DO_NOT_TRY else text


def _headline(facts: TaskFacts, verdict: Verdict) -> str:
    if verdict.answer is Answer.USE:
        assert verdict.limit is not None
        return facts.duration(verdict.limit)
    if verdict.answer is Answer.TRIVIAL:
        return "none; the task is trivial as it is"
    if verdict.answer is Answer.BORDERLINE:
        assert verdict.limit is not None
        return f"borderline; if you try, {facts.duration(verdict.limit)}"
    if verdict.answer is Answer.TOO_SHORT:
        return "none of those tried"
    return "none; do not try this task as it is"


def _reason(evidence: Evidence, verdict: Verdict) -> str:
    sentences = {
        Answer.TRIVIAL: _why_trivial,
        Answer.USE: _why_use,
        Answer.BORDERLINE: _why_borderline,
        Answer.TOO_SHORT: _why_too_short,
        Answer.DO_NOT_TRY: _why_not,
    }[verdict.answer](evidence, verdict)
    return " ".join(sentences)


def _why_trivial(evidence: Evidence, verdict: Verdict) -> list[str]:
    limit = verdict.limit
    assert limit is not None
    often = (
        f"under {counted(limit, 'step')} the untrained policy reaches the goal every "
        f"{evidence.steps_per_hit(limit):.1f} steps, resets included"
    )
    if evidence.minimum_steps == 1:
        share = f"{100 * evidence.share_in_time(1):.0f} %"
        return [
            f"from {share} of the starts a single step suffices, so there is no time to save; {often}.",
            TRIVIAL_ADVICE,
        ]
    return [
        f"{often}, and the search knows no ways that are much shorter: {evidence.mean_way:.1f} steps on average. "
        "Whatever is done, the goal comes.",
        TRIVIAL_ADVICE,
    ]


def _why_use(evidence: Evidence, verdict: Verdict) -> list[str]:
    limit = verdict.limit
    assert limit is not None
    sentences = [
        f"under {counted(limit, 'step')} the untrained policy reaches the goal {evidence.mean_hits(limit):.1f} times "
        f"in 20 000 steps, more than the {SUFFICIENT_HITS:g} that learning needs to get going, and the goal can be "
        f"reached in time from {100 * evidence.share_in_time(limit):.0f} % of the starts."
    ]
    short = [other for other, finding in verdict.findings.items() if finding.length is Side.BELOW and other < limit]
    if short:
        sentences.append(_why_short(evidence, short))
    rare = [
        other
        for other, finding in verdict.findings.items()
        if finding.hits is Side.BELOW and finding.length is not Side.BELOW and other < limit
    ]
    if rare:
        sentences.append(f"{_list(rare)} {_have(rare)} too few hits.")
    if verdict.borderline:
        sentences.append(
            f"{_list(verdict.borderline)} would be shorter, but it is not clear that {' and '.join(_doubts(verdict))}."
        )
    sentences.append("Longer limits are not better to begin with: an attempt that goes wrong wastes more time.")
    return sentences


def _why_borderline(evidence: Evidence, verdict: Verdict) -> list[str]:
    limit = verdict.limit
    assert limit is not None
    sentences = [
        f"of no limit is it clear that it has more than {_HITS} and is long enough. {_list(verdict.borderline)} may "
        f"be admissible; it is not clear that {' and '.join(_doubts(verdict))}.",
        f"Under {counted(limit, 'step')} there are {evidence.mean_hits(limit):.1f} hits, and the goal can be reached "
        f"in time from {100 * evidence.share_in_time(limit):.0f} % of the starts. Learning may succeed, slowly or not "
        "with every seed. A larger target or shorter resets would make it safer.",
    ]
    short = [other for other, finding in verdict.findings.items() if finding.length is Side.BELOW]
    return [*sentences, _why_short(evidence, short)] if short else sentences


def _why_too_short(evidence: Evidence, verdict: Verdict) -> list[str]:
    short = [limit for limit, finding in verdict.findings.items() if finding.length is Side.BELOW]
    enough = [limit for limit in short if verdict.findings[limit].hits is not Side.BELOW]
    long = [limit for limit in verdict.findings if limit not in short]
    if not enough:
        minimum = evidence.minimum_steps
        assert minimum is not None
        tried = "the limit that was tried is" if len(short) == 1 else "all limits that were tried are"
        return [
            f"{tried} below the minimum steps ({minimum}), and hits under {'it' if len(short) == 1 else 'them'} say "
            "nothing about longer ones: give longer ones with --limits."
        ]
    sentences = [
        f"the {plural(len(enough), 'limit')} with enough hits ({_list(enough)}) "
        f"{'is' if len(enough) == 1 else 'are'} too short. {_why_short(evidence, short)}",
        "That is as far as the search can tell; with a larger --effort it looks longer for a way.",
    ]
    if long:
        sentences.append(f"{_list(long)} {_have(long)} too few hits. Try limits in between with --limits.")
    else:
        sentences.append("No limit that was tried is long enough: give longer ones with --limits.")
    return sentences


def _why_not(evidence: Evidence, verdict: Verdict) -> list[str]:
    found = sum(steps is not None for steps in evidence.starts)
    searched = counted(len(evidence.starts), "start")
    counts = [count for counts in evidence.hits.values() for count in counts]
    if not any(counts):
        sentences = [
            f"the untrained policy did not reach the goal once in {len(counts)} times {STEPS} steps, under any limit."
        ]
    else:
        best = max(evidence.hits, key=evidence.mean_hits)
        sentences = [
            f"no limit has more than {_HITS}; the most are {evidence.mean_hits(best):.1f}, at "
            f"{counted(best, 'step')}. With so few, a policy has nothing to learn from."
        ]
    if evidence.starts and not found:
        sentences.append(
            f"Nor did the search find a way, from any of {searched}. Check that the goal can be "
            "reached at all and that the task notices it: does an attempt ever end as terminated?"
        )
    elif evidence.starts:
        sentences.append(
            f"The search found a way from {found} of {searched}, so the goal can be reached, but "
            "not by chance often enough. A larger target, faster commands or starts nearer to the goal would help."
        )
    return sentences


def _why_short(evidence: Evidence, short: list[int]) -> str:
    longest = short[-1]
    return (
        f"{_list(short)} {'is' if len(short) == 1 else 'are'} below the minimum steps: within {longest} the goal is "
        f"known to be reachable from {100 * evidence.share_in_time(longest):.0f} % of the starts only, so hits there "
        "come from lucky starts, and a policy would learn that the others are lost."
    )


def _doubts(verdict: Verdict) -> list[str]:
    rare = [limit for limit in verdict.borderline if verdict.findings[limit].hits is Side.OPEN]
    short = [limit for limit in verdict.borderline if verdict.findings[limit].length is Side.OPEN]
    doubts = []
    if rare:
        doubts.append(f"{_list(rare)} {_have(rare)} more than {_HITS}")
    if short:
        doubts.append(f"the goal can be reached within {_list(short)} from nine of ten starts")
    return doubts


def _certainty(evidence: Evidence, thoroughness: Thoroughness) -> str:
    seeds = sum(len(counts) for counts in evidence.hits.values())
    return (
        f"{100 * thoroughness.confidence:g} % for all that is said without “perhaps” or “not clear” together, by tests "
        f"that may be looked at after every count; counting stopped as soon as nothing more would have changed the "
        f"answer, or at {thoroughness.most_seeds} seeds a limit and {thoroughness.most_starts} starts. That a limit is "
        "too short means that the search knows no way in time from enough starts; a better search may. "
        f"{seeds} counts of {STEPS} steps, {len(evidence.starts)} starts searched from; {SHARE_OF_STARTS:.0%} of the "
        "starts must reach the goal in time."
    )


def _list(limits: tuple[int, ...] | list[int]) -> str:
    *others, last = [str(limit) for limit in limits] or ["-"]
    return f"{', '.join(others)} and {last}" if others else last


def _have(limits: list[int]) -> str:
    return "has" if len(limits) == 1 else "have"
