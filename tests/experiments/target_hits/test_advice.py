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


def test_a_trivial_task_gets_no_limit_but_what_to_check():
    text = words({1: around(9000), 50: around(18000)}, (1,) * 60)
    assert paragraph(text, "Recommended time limit:") == "none; the task is trivial as it is"
    assert paragraph(text, "Admissible limits:") == "of no importance"
    assert paragraph(text, "Minimum steps:").startswith(
        "1 step (0.1 s): whoever knows the way reaches the goal within it"
    )
    why = paragraph(text, "Why:")
    # 20 000 steps with 18 000 hits
    assert why.startswith(
        "from 100 % of the starts a single step suffices, so there is no time to save; under 50 steps"
    )
    assert "every 1.1 steps, resets included" in why
    assert "Check the task's termination" in why


def test_a_single_limit_is_spoken_of_as_one():
    assert "the limit with enough hits (5) is too short. 5 is below" in words({5: around(50)}, (30,) * 60)
    assert "the limit that was tried is below the minimum steps (30)" in words({5: around(3)}, (30,) * 60)
    assert "the most are 3.0, at 1 step." in words({1: around(3)}, (1,) * 10)


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
