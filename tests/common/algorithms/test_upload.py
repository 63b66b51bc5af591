"""Arrays reach the device as they are, read-only ones too."""

import warnings

import numpy as np
import pytest
import torch

from common.algorithms.upload import upload

CPU = torch.device("cpu")


@pytest.mark.parametrize("dtype", [np.uint8, np.int64, np.float32, np.float64])
def test_values_shape_and_dtype_stay(dtype):
    array = np.arange(12, dtype=dtype).reshape(3, 4)
    np.testing.assert_array_equal(upload(array, CPU).numpy(), array, strict=True)
    np.testing.assert_array_equal(upload(array[::2, 1:], CPU).numpy(), array[::2, 1:], strict=True)
    assert upload(array[:0], CPU).shape == (0, 4)


def test_on_the_cpu_nothing_is_copied_unless_the_array_is_read_only():
    array = np.zeros(3)
    shared = upload(array, CPU)
    array[0] = 1.0
    assert shared.tolist() == [1, 0, 0]
    array.flags.writeable = False
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        copied = upload(array, CPU)
    copied[0] = 2.0
    assert array.tolist() == [1, 0, 0]
