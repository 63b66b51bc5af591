"""One pass says what the library and NumPy say in two."""

from __future__ import annotations

import numpy as np
import pytest
import xxhash

from common.policies.fused_check import digest_and_finite

BLOCK = 1024


def random_bytes(size):
    return np.random.default_rng(size).integers(0, 256, size, np.uint8)


def test_the_digest_is_the_librarys_for_every_length_of_up_to_three_blocks():
    data = random_bytes(3 * BLOCK + 4)
    for size in range(3 * BLOCK + 1):
        assert digest_and_finite(data[:size])[0] == xxhash.xxh3_128_hexdigest(data[:size].data), size


@pytest.mark.parametrize("size", [64 * BLOCK - 64, 64 * BLOCK, 64 * BLOCK + 4, 1_000_000])
@pytest.mark.parametrize("content", ["random", "zeros", "ones"])
def test_the_digest_is_the_librarys_for_long_inputs(size, content):
    data = {"random": random_bytes(size), "zeros": np.zeros(size, np.uint8), "ones": np.full(size, 255, np.uint8)}
    assert digest_and_finite(data[content])[0] == xxhash.xxh3_128_hexdigest(data[content].data)


def test_the_digest_does_not_depend_on_where_in_memory_the_bytes_are():
    data = random_bytes(5 * BLOCK)
    for start in range(65):
        part = data[start : start + 4 * BLOCK]
        assert digest_and_finite(part)[0] == xxhash.xxh3_128_hexdigest(part.data)
    every_other = data[::2]
    assert digest_and_finite(every_other)[0] == xxhash.xxh3_128_hexdigest(every_other.tobytes())


def test_any_changed_bit_of_a_stripe_changes_the_digest():
    data = random_bytes(2 * BLOCK + 100)
    digests = {digest_and_finite(data)[0]}
    for bit in [*range(512), *range(8 * (2 * BLOCK + 36), 8 * (2 * BLOCK + 100))]:
        changed = data.copy()
        changed[bit // 8] ^= 1 << bit % 8
        digests.add(digest_and_finite(changed)[0])
    assert len(digests) == 1 + 512 + 512


# 100 numbers: no whole block; 256: exactly one, which counts as the last; 257; 1000.
@pytest.mark.parametrize("count", [10, 60, 61, 100, 256, 257, 1000])
@pytest.mark.parametrize("bits", [0x7F800000, 0xFF800000, 0x7FC00000, 0xFFC00001, 0x7F800001])
def test_an_infinity_or_nan_is_found_wherever_it_is(count, bits):
    values = np.random.default_rng(0).standard_normal(count).astype(np.float32)
    assert digest_and_finite(values.view(np.uint8))[1]
    for at in range(count):
        changed = values.copy()
        changed.view(np.uint32)[at] = bits
        assert not digest_and_finite(changed.view(np.uint8))[1], at


@pytest.mark.parametrize("bits", [0x7F7FFFFF, 0xFF7FFFFF, 0x00000001, 0x807FFFFF, 0x80000000])
def test_the_largest_and_the_smallest_numbers_are_finite(bits):
    for count in (61, 300):
        assert digest_and_finite(np.full(count, bits, np.uint32).view(np.uint8))[1]
