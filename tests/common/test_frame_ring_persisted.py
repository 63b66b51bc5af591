"""The table of persisted ranges: a set of numbers that a kill at any moment leaves right."""

from contextlib import suppress

import numpy as np
import pytest

from common.frame_ring.layout import RANGE_DTYPE
from common.frame_ring.persisted import PersistedRanges


def table(slots=32):
    return np.zeros(slots, RANGE_DTYPE)


def test_contiguous_numbers_take_one_slot():
    kept = table(1)
    persisted = PersistedRanges(kept)
    for seq in range(100):
        persisted.add(7, seq)
    assert persisted.ranges(7) == [(0, 100)]
    assert kept["length"].tolist() == [100]


def test_a_filled_gap_joins_its_neighbours_and_frees_a_slot():
    kept = table()
    persisted = PersistedRanges(kept)
    for seq in (0, 1, 4, 3, 9):
        persisted.add(7, seq)
    assert persisted.ranges(7) == [(0, 2), (3, 5), (9, 10)]
    persisted.add(7, 2)
    assert persisted.ranges(7) == [(0, 5), (9, 10)]
    assert np.count_nonzero(kept["length"]) == 2


@pytest.mark.parametrize("seed", range(5))
def test_any_order_gives_the_set_and_any_restart_keeps_it(seed):
    rng = np.random.default_rng(seed)
    kept, expected = table(64), set()
    persisted = PersistedRanges(kept)
    for _ in range(300):
        number = int(rng.integers(1, 4)), int(rng.integers(0, 40))
        persisted.add(*number)
        expected.add(number)
        if rng.random() < 0.05:
            persisted = PersistedRanges(kept)
    for incarnation in range(5):
        for seq in range(-1, 41):
            assert persisted.contains(incarnation, seq) == ((incarnation, seq) in expected)


class Killed(Exception):
    """Stands for a signal that ends the process."""


@pytest.mark.parametrize("survives", range(6))
@pytest.mark.parametrize("seq", [2, 5, 7, 20], ids=["joins", "extends back", "extends", "new"])
def test_a_kill_at_any_store_leaves_the_set_with_or_without_the_number(survives, seq):
    kept = table()
    persisted = PersistedRanges(kept)
    before = {0, 1, 3, 4, 6, 10}
    for number in before:
        persisted.add(7, number)
    left = [survives]

    class Column(np.ndarray):
        def __setitem__(self, key, value):
            if not left[0]:
                raise Killed
            left[0] -= 1
            super().__setitem__(key, value)

    class Table(np.ndarray):
        def __getitem__(self, key):
            got = super().__getitem__(key)
            return got.view(Column) if isinstance(key, str) else got

    persisted._table = kept.view(Table)
    persisted._lengths = kept["length"].view(Column)
    with suppress(Killed):
        persisted.add(7, seq)
    after = PersistedRanges(kept)
    got = {number for number in range(-5, 30) if after.contains(7, number)}
    assert got in (before, before | {seq})
    for number in range(12):
        after.add(7, number)
    assert after.ranges(7)[0] == (0, 12)


def test_a_full_table_forgets_the_oldest():
    persisted = PersistedRanges(table(3))
    for number in [(1, 0), (1, 5), (2, 0), (2, 5), (3, 0)]:
        persisted.add(*number)
    assert [persisted.ranges(i) for i in (1, 2, 3)] == [[], [(0, 1), (5, 6)], [(0, 1)]]
    for seq in range(10, 20, 2):
        persisted.add(3, seq)
    assert persisted.ranges(3) == [(14, 15), (16, 17), (18, 19)]
