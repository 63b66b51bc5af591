"""The answer in words: each kind of answer, from evidence made by hand."""

import pytest

from experiments.target_hits.advice import TaskFacts, advice
from experiments.target_hits.guideline import Evidence, Thoroughness, judge

FACTS = TaskFacts("pusher", "demo", action_cycle_time_s=0.1, reset_steps=20, effort=1000)
THOROUGH = Thoroughness()
LONG = THOROUGH.most_seeds // 2


def around(mean, pairs=5):
    return (mean - 2, mean + 2) * pairs


def words(hits, starts):
    evidence = Evidence(hits, starts)
    return advice(FACTS, evidence, judge(evidence, THOROUGH), THOROUGH)


def paragraph(text, title):
    (found,) = [part for part in text.split("\n\n") if part.startswith(title)]
    return found.removeprefix(title).strip()


def test_a_recommendation_comes_in_steps_and_seconds_with_what_speaks_against_shorter_ones():
    text = words({5: around(50), 25: around(3), 50: around(30), 100: around(20)}, (20,) * 60)
    assert text.startswith("pusher (demo): an action cycle is 100 ms, a reset takes 20 steps (2 s)")
    assert paragraph(text, "Recommended time limit:") == "50 steps (5 s)"
    assert paragraph(text, "Admissible limits:") == "50, 100"
    assert paragraph(text, "Minimum steps:").startswith("20 steps (2 s): whoever knows the way")
    why = paragraph(text, "Why:")
    assert "under 50 steps the untrained policy reaches the goal 30.0 times in 20 000 steps" in why
    assert "5 is below the minimum steps" in why
    assert "25 has too few hits" in why
    assert "perhaps" not in text.partition("How sure")[0]


def test_a_borderline_answer_says_what_is_not_clear():
    text = words({25: around(11, LONG), 50: around(10, LONG), 500: around(3)}, (20,) * 57 + (40,) * 3)
    assert paragraph(text, "Recommended time limit:") == "borderline; if you try, 25 steps (2.5 s)"
    assert paragraph(text, "Admissible limits:") == "none for certain; perhaps 25, 50"
    why = paragraph(text, "Why:")
    assert "25 and 50 may be admissible" in why
    assert "it is not clear that 25 and 50 have more than 10 hits" in why
    assert "the goal can be reached within 25 from nine of ten starts" in why
    assert "95 % of the starts" in why


@pytest.mark.parametrize(
    ("hits", "advised"),
    [
        ({5: around(50), 10: around(40), 100: around(3)}, "100 has too few hits. Try limits in between with --limits."),
        ({5: around(50), 10: around(40)}, "No limit that was tried is long enough: give longer ones with --limits."),
    ],
)
def test_limits_that_are_all_too_short_give_no_recommendation_but_where_to_look(hits, advised):
    text = words(hits, (30,) * 60)
    assert paragraph(text, "Recommended time limit:") == "none of those tried"
    assert paragraph(text, "Admissible limits:") == "none for certain"
    why = paragraph(text, "Why:")
    assert why.startswith("the limits with enough hits (5 and 10) are too short.")
    assert why.endswith(advised)


@pytest.mark.parametrize(
    ("hits", "starts", "reason"),
    [
        ((0,) * 5, (None,) * 10, "Check that the goal can be reached at all"),
        ((0,) * 5, (30,) * 4 + (None,) * 6, "The search found a way from 4 of 10 starts"),
        ((0, 1, 0, 2, 0), (30,) * 4 + (None,) * 6, "no limit has more than 10 hits; the most are 0.6, at 50 steps"),
    ],
)
def test_a_hopeless_task_is_not_recommended_at_any_limit(hits, starts, reason):
    text = words({10: (0,) * 5, 50: hits}, starts)
    assert paragraph(text, "Recommended time limit:") == "none; do not try this task as it is"
    assert paragraph(text, "Admissible limits:") == "none for certain"
    assert reason in paragraph(text, "Why:")
