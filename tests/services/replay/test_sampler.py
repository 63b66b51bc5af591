"""The update budget's arithmetic, and sampling: uniform over what is valid, and nothing else."""

import numpy as np
import pytest

from common.errors import ConfigError
from common.frame_ring import RingReader
from services.replay.sampler import TransitionSampler, UpdateBudget
from tests.common.ring_cases import Bridge
from tests.common.test_frame_ring import append_all, every_pair, make_ring


def spend_all(budget):
    count = 0
    while budget.spend():
        count += 1
    return count


def test_nothing_is_owed_before_the_minimum_size():
    budget = UpdateBudget(replay_ratio=2, min_size_to_sample=5, max_surplus=100)
    budget.add(4)
    assert budget.owed == 0
    assert not budget.spend()
    budget.add(1)  # the fifth is the first that earns
    assert budget.owed == 2
    budget.add(3)
    assert budget.owed == 8
    assert spend_all(budget) == 8
    assert budget.owed == 0


def test_the_step_across_the_minimum_earns_only_what_is_beyond():
    budget = UpdateBudget(1, 5, 100)
    budget.add(7)
    assert budget.owed == 3  # numbers 5, 6 and 7


def test_a_fractional_ratio_neither_loses_nor_gains():
    budget = UpdateBudget(0.1, 1, 10)
    spent = []
    for _ in range(1000):
        budget.add()
        spent.append(spend_all(budget))
    assert sum(spent) == 100
    assert spent[:20] == [0] * 9 + [1] + [0] * 9 + [1]


def test_the_surplus_is_capped_and_goes_on_from_the_cap():
    budget = UpdateBudget(0.5, 1, max_surplus=3)
    budget.add(1000)
    assert budget.owed == 3
    budget.add(1)
    assert budget.owed == 3
    assert budget.spend()
    budget.add(1)
    assert budget.owed == 2.5
    assert spend_all(budget) == 2


def test_nothing_is_earned_while_nothing_is_persisted():
    budget = UpdateBudget(1, 1, 10)
    budget.add(2)
    spend_all(budget)
    assert not any(budget.spend() for _ in range(10))


def test_a_restart_counts_the_ring_towards_the_minimum_but_owes_nothing():
    budget = UpdateBudget(1, 100, 10, persisted=250)
    assert budget.owed == 0
    budget.add()
    assert budget.owed == 1


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ((-1, 1, 1), "replay_ratio"),
        ((float("nan"), 1, 1), "replay_ratio"),
        ((1, 0, 1), "min_size"),
        ((1, 1, 0.5), "max_surplus"),
        ((1, 1, float("nan")), "max_surplus"),
    ],
)
def test_settings_out_of_range_are_refused_by_name(settings, named):
    with pytest.raises(ConfigError, match=named):
        UpdateBudget(*settings)


@pytest.fixture
def ring(tmp_path):
    return make_ring(tmp_path / "ring", 60, 1.0)


def chi_square(sampled, valid):
    counts = np.array([np.count_nonzero(sampled == row) for row in valid])
    assert counts.sum() == len(sampled)  # nothing but valid rows
    expected = len(sampled) / len(valid)
    return ((counts - expected) ** 2 / expected).sum()


def test_sampling_is_uniform_over_valid_pairs_and_never_returns_another_row(ring, tmp_path):
    bridge = Bridge()
    append_all(ring, [e for e in bridge.wander(np.random.default_rng(0), 300) if e.time_step.seq % 7])
    valid = every_pair(ring)
    assert 10 < len(valid) < 50
    sampler = TransitionSampler(np.random.default_rng(1))
    for source in (ring, RingReader(tmp_path / "ring")):
        sampled = np.concatenate([sampler.sample(source, 64) for _ in range(200)])
        # Mean n, standard deviation sqrt(2 n): four of them are far beyond p = .001.
        assert chi_square(sampled, valid) < len(valid) + 4 * np.sqrt(2 * len(valid))


def test_where_few_rows_end_a_transition_all_of_them_are_found(ring):
    bridge = Bridge()
    attempts = [[bridge.start(), bridge.step()] for _ in range(25)]
    for number, (first, second) in enumerate(attempts):
        append_all(ring, [first, second] if number in (3, 20) else [first])
    valid = every_pair(ring)
    assert len(valid) == 2
    sampler = TransitionSampler(np.random.default_rng(2))
    sampled = np.concatenate([sampler.sample(ring, 64) for _ in range(50)])
    assert len(sampled) == 50 * 64
    assert chi_square(sampled, valid) < 10.8  # 1 degree of freedom, p = .001


def test_without_a_transition_there_is_nothing_to_sample(ring):
    sampler, bridge = TransitionSampler(np.random.default_rng(0)), Bridge()
    assert sampler.sample(ring, 4) is None
    ring.append(bridge.start())
    assert sampler.sample(ring, 4) is None
    ring.append(bridge.start())
    assert sampler.sample(ring, 4) is None
    ring.append(bridge.step())
    assert sampler.sample(ring, 4).tolist() == [2, 2, 2, 2]


def test_the_same_seed_gives_the_same_rows(ring):
    append_all(ring, Bridge().wander(np.random.default_rng(0), 60))
    one, other = (TransitionSampler(np.random.default_rng(3)).sample(ring, 32) for _ in range(2))
    np.testing.assert_array_equal(one, other)
    assert one.dtype == np.int64


def test_the_budget_counts_transitions_not_rows(ring):
    budget, bridge = UpdateBudget(1, 1, 1000), Bridge()
    for experience in bridge.wander(np.random.default_rng(0), 50):
        before = ring.transitions_appended
        ring.append(experience)
        budget.add(ring.transitions_appended - before)
    assert budget.owed == sum(e.time_step.step_index > 0 for e in bridge.experiences)
