"""Gather and crop: every path of the kernel gives what slicing gives, and nothing around it is touched."""

from __future__ import annotations

import subprocess
import sys

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


@pytest.mark.parametrize("width", [*range(1, 24), 40])
def test_colour_images_of_any_width_are_stacked_in_whole_vectors(width):
    rng = np.random.default_rng(width)
    frames, _ = within(rng.integers(0, 256, (4, 9, 40, 3), np.uint8))
    slots = rng.integers(0, 4, (5, 3))
    slots[0], slots[2], slots[-1] = 3, 3, 0  # beyond the last bytes there is nothing to read, whichever stack has them
    for y, x in {(0, 0), (1, 40 - width)}:
        out, around = within(np.zeros((5, 8, width, 9), np.uint8))
        gather_and_crop(frames, slots, y, x, out)
        np.testing.assert_array_equal(out, sliced(frames, slots, y, x, 8, width))
        for guard in around:
            assert (guard == 77).all()


READS_THE_LAST_FRAME = """
import mmap, sys
import numpy as np
from common.frame_ring.kernel import gather_and_crop

page = mmap.PAGESIZE
with open(sys.argv[1], "r+b") as file:
    file.truncate(2 * page)
    mapped = mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ)
    file.truncate(page)  # who reads the second page now is killed
frames = np.frombuffer(mapped, np.uint8, page // 48 * 48, page % 48).reshape(4, 4, -1, 3)
gather_and_crop(frames, np.full((3, 3), 3), 0, 0, np.zeros((3, 4, frames.shape[2], 9), np.uint8))
"""


def test_nothing_beyond_the_frames_is_read(tmp_path):
    path = tmp_path / "frames"
    path.touch()
    subprocess.run([sys.executable, "-c", READS_THE_LAST_FRAME, path], check=True)


def test_frames_and_results_need_not_be_contiguous():
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (6, HEIGHT, 2 * WIDTH, 3), np.uint8)[:, :, ::2]
    slots, out = rng.integers(0, 6, (4, 3)), np.zeros((8, 3, 4, 9), np.uint8)[::2]
    gather_and_crop(frames, slots, 1, 2, out)
    np.testing.assert_array_equal(out, sliced(frames, slots, 1, 2, 3, 4))
