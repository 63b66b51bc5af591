"""The decision, from tables of hits made by hand."""

import pytest

from experiments.target_hits.certainty import Side
from experiments.target_hits.guideline import Answer, Evidence, NextLook, Thoroughness, judge, next_look

THOROUGH = Thoroughness()
ALL = THOROUGH.most_seeds
"""As many seeds as are ever counted."""


def around(mean, seeds=10):
    """Counts with this mean that spread about as Poisson counts do."""
    return tuple([mean - 2, mean + 2] * (seeds // 2))


def starts(*counts_and_steps):
    """(how many starts, steps each), ..."""
    return tuple(steps for count, steps in counts_and_steps for _ in range(count))


NEAR = starts((60, 8))
"""From everywhere the goal can be reached in 8 steps."""


def verdict(hits, of_starts=NEAR):
    return judge(Evidence(hits, of_starts), THOROUGH)


def test_the_shortest_limit_with_enough_hits_and_above_the_minimum_steps_is_taken():
    found = verdict({5: around(60), 10: around(50), 50: around(30), 500: around(4)})
    assert (found.answer, found.limit, found.borderline) == (Answer.USE, 10, ())
    assert found.findings[5].length is Side.BELOW
    assert [limit for limit, finding in found.findings.items() if finding.admissible] == [10, 50]
    assert found.findings[500].hits is Side.BELOW


def test_a_limit_with_too_few_hits_is_passed_over():
    assert verdict({10: around(3), 25: around(20), 50: around(30)}).limit == 25


def test_lucky_starts_do_not_make_a_limit_long_enough():
    # As with Ball-in-Cup: most hits are where the ball falls into the cup by itself.
    of_starts = starts((24, 5), (34, 30), (2, 45))
    found = verdict({5: around(20), 10: around(50), 25: around(47), 50: around(33), 100: around(17)}, of_starts)
    assert (found.answer, found.limit) == (Answer.USE, 50)
    assert Evidence({}, of_starts).minimum_steps == 30


def test_the_minimum_steps_are_what_nine_of_ten_starts_need():
    assert Evidence({}, starts((9, 5), (1, 80))).minimum_steps == 5
    assert Evidence({}, starts((8, 5), (1, 70), (1, 80))).minimum_steps == 70
    assert Evidence({}, starts((9, 5), (1, None))).minimum_steps == 5
    assert Evidence({}, starts((8, 5), (2, None))).minimum_steps is None
    assert Evidence({}).minimum_steps is None


def test_a_limit_equal_to_a_start_s_way_is_in_time_for_it():
    evidence = Evidence({}, starts((1, 25), (1, 26), (2, None)))
    assert (evidence.share_in_time(24), evidence.share_in_time(25), evidence.share_in_time(26)) == (0.0, 0.25, 0.5)


def test_hits_about_ten_are_borderline_and_the_limit_that_passes_as_measured_is_named():
    found = verdict({5: around(12), 10: around(9, ALL), 25: around(11, ALL), 50: around(10, ALL)})
    assert (found.answer, found.limit, found.borderline) == (Answer.BORDERLINE, 25, (10, 25, 50))


def test_where_none_passes_as_measured_that_with_the_most_hits_is_named():
    found = verdict({10: around(9, ALL), 25: around(10, ALL), 50: around(9, ALL)})
    assert (found.answer, found.limit) == (Answer.BORDERLINE, 25)


def test_a_borderline_limit_does_not_hide_a_clear_longer_one():
    found = verdict({10: around(10, ALL), 25: around(20), 50: around(30)})
    assert (found.answer, found.limit, found.borderline) == (Answer.USE, 25, (10,))


def test_hits_under_ten_everywhere_are_not_to_be_tried():
    found = verdict({10: around(2), 50: around(3), 500: around(2)})
    assert (found.answer, found.limit, found.borderline) == (Answer.DO_NOT_TRY, None, ())


@pytest.mark.parametrize("of_starts", [(), starts((10, None)), starts((10, 20))])
def test_no_hits_at_all_are_not_to_be_tried_whatever_the_search_says(of_starts):
    assert verdict({10: (0,) * 5, 50: (0,) * 5}, of_starts).answer is Answer.DO_NOT_TRY


def test_enough_hits_only_below_the_minimum_steps_are_no_recommendation():
    found = verdict({1: around(50), 10: around(40), 100: around(3)}, starts((60, 30)))
    assert (found.answer, found.limit) == (Answer.TOO_SHORT, None)


def test_a_search_that_finds_too_few_ways_recommends_nothing():
    found = verdict({10: around(50), 100: around(30)}, starts((30, 8), (30, None)))
    assert (found.answer, found.limit) == (Answer.TOO_SHORT, None)


def test_a_goal_that_comes_whatever_is_done_is_trivial():
    # 2000 hits in 20 000 steps are 10 steps from hit to hit: 1.25 times the 8 that are known. 1900 are 10.5.
    found = verdict({5: around(4000), 10: around(2000), 50: around(1500)})
    assert (found.answer, found.limit) == (Answer.TRIVIAL, 10)
    assert verdict({5: around(4000), 10: around(1900), 50: around(1500)}).answer is Answer.USE
    # Under a limit that is too short, hits are lucky starts and nothing can be told from them.
    assert verdict({1: around(1900), 5: around(4000), 50: around(1500)}).answer is Answer.USE


def test_a_goal_one_step_away_is_trivial_if_it_is_hit_at_all():
    assert verdict({1: around(500), 10: around(900)}, starts((55, 1), (5, None))).answer is Answer.TRIVIAL
    assert verdict({1: around(500), 10: around(900)}, starts((60, 2))).answer is Answer.USE
    assert verdict({1: (0,) * 5, 10: (0,) * 5}, starts((60, 1))).answer is Answer.DO_NOT_TRY


# ---------------------------------------------------------------------- when to stop looking


def look(hits, of_starts=NEAR):
    return next_look(Evidence(hits, of_starts), THOROUGH)


def test_every_limit_is_counted_a_few_times_first():
    assert look({10: around(50), 50: (30, 31)}) == NextLook(limit=50)


def test_a_clear_answer_ends_the_looking():
    assert look({5: around(60), 10: around(50), 50: around(10)}) == NextLook()
    assert not NextLook().needed


def test_the_shortest_limit_that_may_be_admissible_is_counted_on():
    assert look({5: around(10), 10: around(11), 50: around(10), 100: around(30)}) == NextLook(limit=10)


def test_it_is_not_counted_for_ever():
    assert look({10: around(11, ALL), 50: around(10, ALL)}) == NextLook()
    assert look({10: around(11, ALL), 50: around(10)}) == NextLook(limit=50)


def test_ways_are_searched_for_once_there_are_hits():
    assert look({10: around(50)}, ()) == NextLook(starts=True)
    assert look({10: around(50)}, starts((20, 8))) == NextLook(starts=True)  # 20 of 20 are not 90 % for sure


def test_the_search_ends_where_more_starts_would_not_help():
    # 54 of 60 are about nine of ten: no number of starts would tell.
    assert look({10: around(50)}, starts((54, 8), (6, 90))) == NextLook()


def test_both_may_be_needed():
    assert look({10: around(11)}, starts((20, 8))) == NextLook(limit=10, starts=True)


def test_a_hopeless_task_is_searched_a_little_to_tell_why():
    assert look({10: (0,) * 5}, ()) == NextLook(starts=True)
    assert look({10: (0,) * 5}, starts((10, None))) == NextLook()


def test_few_hits_under_limits_that_are_all_too_short_are_no_reason_not_to_try():
    found = verdict({1: around(3), 2: around(4)})
    assert (found.answer, found.limit) == (Answer.TOO_SHORT, None)
    # Where one of them is long enough, they are.
    assert verdict({1: around(3), 8: around(4)}).answer is Answer.DO_NOT_TRY
