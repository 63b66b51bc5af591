"""One pass copies what the library joins, and takes the library's digest of it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import xxhash

from common.policies import fused_copy
from common.policies.fused_copy import copy_and_digest

BLOCK = 1024
GUARD = 4096
"""More bytes than are written at once, or fetched ahead."""


@pytest.fixture(params=[2 * BLOCK, 64 * BLOCK])
def large(request, monkeypatch):
    """Pieces from here on are copied and taken in at once; two blocks are the least that is allowed."""
    monkeypatch.setattr(fused_copy, "_LARGE", request.param)


def make_pieces(sizes):
    rng = np.random.default_rng(sum(sizes))
    return [rng.integers(0, 256, size, np.uint8) for size in sizes]


def assert_copied(pieces, shift=0):
    """Copy to an address that is ``shift`` more than a multiple of 64; nothing but the copy may be written."""
    expected = b"".join(piece.tobytes() for piece in pieces)
    space = np.full(len(expected) + 2 * GUARD + 128, 0xA5, np.uint8)
    begin = GUARD + -(space.ctypes.data + GUARD) % 64 + shift
    digest = copy_and_digest(pieces, len(expected), space.ctypes.data + begin)
    assert digest == xxhash.xxh3_128_hexdigest(expected)
    end = begin + len(expected)
    assert space[begin:end].tobytes() == expected
    assert (space[:begin] == 0xA5).all()
    assert (space[end:] == 0xA5).all()


@pytest.mark.usefixtures("large")
def test_one_piece_of_any_size_up_to_five_blocks():
    for size in [*range(0, 5 * BLOCK, 7), *(b * BLOCK + d for b in range(6) for d in (-1, 0, 1) if b * BLOCK + d >= 0)]:
        assert_copied(make_pieces([size]))


@pytest.mark.usefixtures("large")
@pytest.mark.parametrize("edge", [64, 240, 241, BLOCK, 2 * BLOCK, 3 * BLOCK, 64 * BLOCK])
def test_pieces_that_end_around_a_stripe_or_block(edge):
    for before, size, after in itertools.product((-1, 0, 1), (edge - 1, edge, edge + 1), (0, 1, 63, 64, 65)):
        assert_copied(make_pieces([edge + before, size, after]))


@pytest.mark.usefixtures("large")
@pytest.mark.parametrize("seed", range(40))
def test_many_pieces_some_of_them_empty(seed):
    rng = np.random.default_rng(seed)
    small = rng.integers(1, 3001, 20) * (rng.random(20) < 0.8)
    others = rng.choice([0, 2 * BLOCK, 5 * BLOCK + 4, 64 * BLOCK, 70 * BLOCK + 12], 3)
    assert_copied(make_pieces(rng.permutation([*small, *others]).tolist()), shift=int(rng.integers(64)))


@pytest.mark.usefixtures("large")
def test_bytes_may_begin_anywhere():
    source = make_pieces([70 * BLOCK])[0]
    for begin in range(0, 65, 3):
        assert_copied([source[begin : begin + 100], source[begin:]], shift=(5 * begin) % 64)


@pytest.mark.usefixtures("large")
def test_arrays_of_any_type_and_shape_are_copied_as_their_bytes():
    rng = np.random.default_rng(0)
    assert_copied([rng.standard_normal(shape).astype(np.float32) for shape in [(32, 9, 3, 3), (0, 5), (), (99, 201)]])


@pytest.mark.usefixtures("large")
def test_any_changed_bit_of_a_piece_changes_the_digest():
    pieces = make_pieces([100, 3 * BLOCK, 100])
    size = sum(piece.size for piece in pieces)
    target = np.zeros(size, np.uint8)
    digests = {copy_and_digest(pieces, size, target.ctypes.data)}
    for piece in pieces:
        for bit in range(0, 8 * piece.size, 61):
            piece[bit // 8] ^= 1 << bit % 8
            digests.add(copy_and_digest(pieces, size, target.ctypes.data))
            piece[bit // 8] ^= 1 << bit % 8
    assert len(digests) == 1 + sum(len(range(0, 8 * piece.size, 61)) for piece in pieces)


def test_a_computer_whose_bytes_are_the_other_way_round_gets_the_same(monkeypatch):
    monkeypatch.setattr("common.policies.xxh3.sys.byteorder", "big")
    monkeypatch.setattr(fused_copy, "compile_take_in_and_copy", None)
    assert_copied(make_pieces([100, 0, 70 * BLOCK]))
