"""Gather and crop: every path of the kernel gives what slicing gives, and nothing around it is touched."""

from __future__ import annotations

import numpy as np
import pytest

from common.frame_ring.kernel import gather_and_crop

HEIGHT, WIDTH = 5, 7
CROPS = [(0, 0, 5, 7), (1, 2, 3, 4), (4, 6, 1, 1), (0, 0, 1, 1), (2, 0, 3, 7), (0, 6, 5, 1)]


def sliced(frames, slots, y, x, height, width):
    crops = frames[slots, y : y + height, x : x + width]  # (B, S, h, w, C)
    return crops.transpose(0, 2, 3, 1, 4).reshape(len(slots), height, width, -1)


def within(array):
    """Return a contiguous copy between bytes of 77, and those around it."""
    memory = np.full(array.size + 32, 77, np.uint8)
    middle = memory[16:-16].reshape(array.shape)
    middle[:] = array
    return middle, (memory[:16], memory[-16:])


@pytest.mark.parametrize("crop", CROPS, ids=str)
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("stack", [1, 2, 3, 4])
def test_the_kernel_gives_what_slicing_gives(stack, channels, crop):
    y, x, height, width = crop
    rng = np.random.default_rng(stack * channels)
    frames, _ = within(rng.integers(0, 256, (6, HEIGHT, WIDTH, channels), np.uint8))
    frames.flags.writeable = False  # as the learner maps them
    slots = rng.integers(0, 6, (9, stack))
    slots[0], slots[-1] = 0, 5  # the first and the last bytes there are
    out, around = within(np.zeros((9, height, width, stack * channels), np.uint8))
    gather_and_crop(frames, slots, y, x, out)
    np.testing.assert_array_equal(out, sliced(frames, slots, y, x, height, width))
    for guard in around:
        assert (guard == 77).all()


def test_frames_and_results_need_not_be_contiguous():
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (6, HEIGHT, 2 * WIDTH, 3), np.uint8)[:, :, ::2]
    slots, out = rng.integers(0, 6, (4, 3)), np.zeros((8, 3, 4, 9), np.uint8)[::2]
    gather_and_crop(frames, slots, 1, 2, out)
    np.testing.assert_array_equal(out, sliced(frames, slots, 1, 2, 3, 4))
