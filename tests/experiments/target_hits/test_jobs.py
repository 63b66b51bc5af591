"""Each job's randomness follows from its key alone."""

import itertools

import numpy as np
import pytest

from experiments.target_hits.choice import choose_task, record_settings
from experiments.target_hits.jobs import all_keys, hits_key, relative_cost, start_key, stream, work
from tests.experiments.target_hits.fake_tasks import MODULE

CHOICE = choose_task(f"line={MODULE}:Line")
SETTINGS = record_settings([CHOICE], steps=2000, effort=500)
KEYS = [
    hits_key("line", 1, 0),
    hits_key("line", 0, 1),
    hits_key("line", 1, 1),
    hits_key("enil", 1, 0),
    start_key("line", 0),
    start_key("line", 1),
]


def numbers(key):
    return np.random.default_rng(stream(*key)).integers(2**60, size=4).tolist()


def test_the_same_key_gives_the_same_numbers_and_another_key_others():
    assert [numbers(key) for key in KEYS] == [numbers(key) for key in KEYS]
    for one, other in itertools.combinations(KEYS, 2):
        assert not set(numbers(one)) & set(numbers(other))


@pytest.mark.parametrize("key", [hits_key("line", 5, 3), start_key("line", 3)])
def test_a_job_done_again_gives_the_same_row_whatever_was_done_in_between(key):
    row = work(SETTINGS, key)
    work(SETTINGS, hits_key("line", 5, 4))
    assert work(SETTINGS, key) == row


def test_a_start_is_searched_from_until_its_way_is_known():
    ways = [work(SETTINGS, start_key("line", number))["steps"] for number in range(12)]
    assert set(ways) == {1, 2, 3}  # as far as the starts are


def test_a_table_grows_seed_by_seed():
    assert all_keys(["a", "b"], [1, 5], range(2)) == [
        ("a", 1, 0), ("a", 5, 0), ("b", 1, 0), ("b", 5, 0), ("a", 1, 1), ("a", 5, 1), ("b", 1, 1), ("b", 5, 1),
    ]  # fmt: skip


def test_short_limits_cost_less_because_most_of_their_steps_are_resets():
    cost = relative_cost(SETTINGS)  # a reset takes 5 steps
    assert cost(hits_key("line", 5, 0)) == 0.5
    assert cost(hits_key("line", 45, 0)) == 0.9
    assert cost(start_key("line", 0)) == 1.0
