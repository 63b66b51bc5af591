"""The random crop of training and the central one of acting."""

from dataclasses import replace

import numpy as np
import pytest

from common.errors import MessageError
from common.frame_ring import central_crop, central_crop_offset, crop_shape, draw_crop_offset
from tests.common.ring_cases import crop_of, frame_of, task_spec

SPEC = task_spec()


def test_the_crop_is_what_the_margins_leave():
    assert crop_shape(SPEC) == (4, 4)  # 6 - 2 * 1, 8 - 2 * 2
    assert crop_shape(task_spec(camera=False)) == (0, 0)


def test_acting_sees_the_centre():
    assert central_crop_offset(SPEC) == (1, 2)
    seen = central_crop([frame_of(i) for i in (4, 5, 6)], SPEC)
    np.testing.assert_array_equal(seen, crop_of([4, 5, 6], 1, 2, 4, 4))
    assert seen.dtype == np.uint8


def test_offsets_are_uniform_over_all_that_fit():
    rng = np.random.default_rng(0)
    drawn = [draw_crop_offset(SPEC, rng) for _ in range(3000)]
    offsets, counts = np.unique(drawn, axis=0, return_counts=True)
    assert {tuple(o) for o in offsets} == {(y, x) for y in range(3) for x in range(5)}
    expected = 3000 / 15
    assert ((counts - expected) ** 2 / expected).sum() < 36.1  # chi-square, 14 degrees of freedom, p = .001


def test_margins_that_leave_nothing_are_refused():
    for margin in ([3, 2], [-1, 0]):
        with pytest.raises(MessageError, match="crop_margin"):
            crop_shape(replace(SPEC, crop_margin=np.array(margin)))
