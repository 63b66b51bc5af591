"""A layer that skips zero inputs computes what the dense product does, and touches no memory but its own."""

from __future__ import annotations

import math

import numpy as np
import pytest

from common.policies.sparse_layer import SparseLayer, is_worthwhile, load

SIZES = [(1, 16), (2, 16), (3, 32), (4, 16), (5, 48), (16, 16), (31, 64), (100, 512), (512, 512), (1030, 1024)]


def make_layer(inputs, outputs, seed=0):
    rng = np.random.default_rng(seed)
    return rng.standard_normal((outputs, inputs), np.float32), rng.standard_normal(outputs, np.float32)


def make_inputs(size, active, seed=0):
    """Return inputs of which ``active`` are not zero, in random places and of either sign."""
    rng = np.random.default_rng(seed)
    values = np.zeros(size, np.float32)
    values[rng.permutation(size)[:active]] = rng.choice([-1.0, 1.0], active) * rng.uniform(0.1, 2.0, active)
    return values


def assert_is_the_product(result, weight, bias, inputs):
    """However the sum is ordered, its error is at most n u (|b| + sum |w| |x|), u = 2^-24, of n = inputs + 1 terms."""
    wide = weight.astype(np.float64), inputs.astype(np.float64)
    largest = np.abs(bias) + np.abs(wide[0]) @ np.abs(wide[1])
    assert result.dtype == np.float32
    assert (np.abs(result - (wide[0] @ wide[1] + bias)) <= (len(inputs) + 1) * 2.0**-24 * largest).all()


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_the_result_is_the_dense_product_however_many_inputs_are_zero(size):
    inputs, outputs = size
    weight, bias = make_layer(inputs, outputs)
    layer = SparseLayer(weight, bias)
    for active in sorted({*range(min(inputs, 9) + 1), inputs // 2, max(0, inputs - 3), max(0, inputs - 1), inputs}):
        values = make_inputs(inputs, active, seed=active)
        assert_is_the_product(layer(values), weight, bias, values)


def test_small_numbers_make_the_exact_result():
    # Two inputs that are not zero: 1 + 2 * 3 + 4 * -5 = -13 for each output, and its number on top.
    weight = np.zeros((16, 6), np.float32)
    weight[:, 1], weight[:, 4] = 3.0, -5.0
    result = SparseLayer(weight, np.arange(1, 17, dtype=np.float32))(np.array([0, 2, 0, -0.0, 4, 0], np.float32))
    assert result.tolist() == [-13.0 + output for output in range(16)]


@pytest.mark.parametrize("zero", [0.0, -0.0])
def test_of_nothing_but_zeros_the_bias_remains(zero):
    weight, bias = make_layer(100, 64)
    np.testing.assert_array_equal(SparseLayer(weight, bias)(np.full(100, zero, np.float32)), bias)


def test_the_weights_of_zero_inputs_are_not_looked_at():
    weight, bias = make_layer(100, 64)
    values = make_inputs(100, 50)
    values[0] = 1.0
    expected = SparseLayer(weight, bias)(values)
    weight[:, values == 0.0] = np.nan
    np.testing.assert_array_equal(SparseLayer(weight, bias)(values), expected)


@pytest.mark.parametrize("at", [0, 1, 57, 98, 99])
def test_an_input_that_is_nan_makes_everything_nan_as_in_the_dense_product(at):
    weight, bias = make_layer(100, 64)
    values = make_inputs(100, 50)
    values[at] = np.nan
    assert np.isnan(weight @ values + bias).all()
    assert np.isnan(SparseLayer(weight, bias)(values)).all()


@pytest.mark.parametrize("infinity", [math.inf, -math.inf])
def test_an_infinite_input_makes_each_output_infinite_of_its_weights_sign(infinity):
    weight, bias = make_layer(100, 64)
    values = make_inputs(100, 50)
    values[7] = infinity
    np.testing.assert_array_equal(SparseLayer(weight, bias)(values), np.copysign(np.inf, weight[:, 7] * infinity))


def test_denormal_inputs_are_not_zero():
    weight = np.full((16, 4), 2.0**100, np.float32)
    values = np.array([0, 2.0**-149, 0, 0], np.float32)
    assert SparseLayer(weight, np.zeros(16, np.float32))(values).tolist() == [2.0**-49] * 16


def test_the_same_inputs_give_the_same_bits_wherever_everything_is_in_memory():
    weight, bias = make_layer(512, 512)
    values = make_inputs(512, 250)
    expected = SparseLayer(weight, bias)(values)
    for start in range(1, 17):
        arrays = []
        for array in (weight, bias, values):
            shifted = np.empty(array.size + start, np.float32)[start:].reshape(array.shape)
            shifted[:] = array
            arrays.append(shifted)
        np.testing.assert_array_equal(SparseLayer(*arrays[:2])(arrays[2]), expected)
    for order in (np.asfortranarray(weight), np.repeat(weight, 2, axis=1)[:, ::2]):
        np.testing.assert_array_equal(SparseLayer(order, np.repeat(bias, 2)[::2])(values), expected)
    np.testing.assert_array_equal(SparseLayer(weight, bias)(np.repeat(values, 2)[::2]), expected)


def test_results_and_layers_are_independent_of_what_comes_after():
    weight, bias = make_layer(100, 64)
    values = make_inputs(100, 50)
    layer = SparseLayer(weight, bias)
    first = layer(values)
    before = first.copy()
    weight[:] = 0.0
    second = layer(values)
    layer(make_inputs(100, 50, seed=1))
    np.testing.assert_array_equal(first, before)
    np.testing.assert_array_equal(second, before)


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_no_byte_is_read_or_written_beyond_the_arrays(size):
    inputs, outputs = size
    weight, bias = make_layer(inputs, outputs)

    def guarded(array):
        """Return a copy that begins at a line of the cache, with NaN around it: whatever is read of that shows."""
        space = np.full(array.size + 48, np.nan, np.float32)
        start = 16 + -(space.ctypes.data // 4) % 16
        inside = space[start : start + array.size]
        inside[:] = array.reshape(-1)
        return inside, (space[:start], space[start + array.size :])

    # Active at either end, and nowhere: the groups' unused places must not read beyond the last row.
    for active in (0, 1, inputs // 2, inputs):
        values = make_inputs(inputs, active)
        parts = [guarded(array) for array in (values, weight.T, bias, np.zeros(outputs, np.float32))]
        load()(*(inside.ctypes.data for inside, _ in parts), inputs, outputs)
        assert_is_the_product(parts[-1][0], weight, bias, values)
        for (inside, around), before in zip(parts, (values, weight.T, bias, None), strict=True):
            assert all(np.isnan(guard).all() for guard in around)
            if before is not None:
                np.testing.assert_array_equal(inside, before.reshape(-1))


@pytest.mark.parametrize("shape", [(17, 100), (64, 0), (0, 100), (8, 100)], ids=str)
def test_sizes_that_the_loop_cannot_take_are_refused(shape):
    with pytest.raises(ValueError, match="16 outputs"):
        SparseLayer(np.zeros(shape, np.float32), np.zeros(shape[0], np.float32))


def test_biases_of_another_number_are_refused():
    with pytest.raises(ValueError, match=r"biases \(65,\)"):
        SparseLayer(np.zeros((64, 100), np.float32), np.zeros(65, np.float32))


@pytest.mark.parametrize("size", [0, 99, 101])
def test_inputs_of_another_size_are_refused(size):
    with pytest.raises(ValueError, match=rf"\(100,\), got \({size},\)"):
        SparseLayer(*make_layer(100, 64))(np.zeros(size, np.float32))


def test_only_wide_layers_of_whole_vectors_are_worth_it():
    assert [size for size in (16, 256, 496, 511, 512, 513, 520, 528, 1000, 1024) if is_worthwhile(size)] == [
        512,
        528,
        1024,
    ]
