"""Masks of pictures whose target is known, because the test drew it."""

import cv2
import numpy as np
import pytest

from common.errors import ConfigError
from services.robot_bridge.target_detection import (
    TARGET_COLOURS,
    ColourRange,
    ColourSpace,
    centre_weights,
    colour_mask,
    largest_blob,
    mask_warning,
    share,
    weighted_share,
)

BGR, HSV = ColourSpace.BGR, ColourSpace.HSV
RED, DARK_RED, ORANGE, GREEN = (255, 0, 0), (120, 50, 50), (255, 120, 0), (0, 200, 0)
PAPER_GREEN, BAG_RED, BLACK, GREY, WHITE = (60, 160, 80), (200, 30, 60), (20, 20, 20), (128, 128, 128), (255, 255, 255)


def plain(colour, height=90, width=160):
    """A picture of one colour, red first."""
    return np.full((height, width, 3), colour, np.uint8)


def with_rectangle(colour, background=GREY, left=40, top=30, width=20, height=10):
    picture = plain(background)
    picture[top : top + height, left : left + width] = colour
    return picture


@pytest.mark.parametrize(
    ("robot", "target", "others"),
    [
        ("ur5", RED, [ORANGE, GREEN, BLACK, GREY, WHITE, (0, 0, 255), (119, 0, 0), (255, 51, 0), (255, 0, 51)]),
        ("ur5", DARK_RED, [(119, 50, 50)]),
        ("create", GREEN, [RED, GREY, WHITE, (0, 0, 255)]),
        ("create", PAPER_GREEN, [(200, 200, 160)]),
        ("franka", BAG_RED, [GREEN, GREY, WHITE, (255, 200, 200), (60, 10, 20)]),
        ("vector", BLACK, [GREY, WHITE, RED, (46, 46, 46)]),
        ("vector", (45, 45, 45), [(46, 0, 0)]),
    ],
)
def test_each_robots_range_takes_in_its_target_and_nothing_else(robot, target, others):
    colours = TARGET_COLOURS[robot]
    for other in others:
        mask = colour_mask(with_rectangle(target, other), colours)
        assert (mask.dtype, mask.shape) == (bool, (90, 160))
        assert mask[30:40, 40:60].all()
        assert mask.sum() == 200, other


def test_a_range_is_of_blue_green_and_red_in_this_order():
    blue = ColourRange(BGR, (200, 0, 0), (255, 10, 10))
    assert share(colour_mask(plain((0, 0, 255)), blue)) == 1.0
    assert share(colour_mask(plain(RED), blue)) == 0.0


def test_hues_may_go_over_the_end_of_the_scale():
    # In half degrees: (255, 0, 20) has hue 178, red 0, (255, 60, 0) 7, orange (255, 120, 0) 14.
    reds = ColourRange(HSV, (170, 100, 100), (10, 255, 255))
    assert [share(colour_mask(plain(c), reds)) for c in ((255, 0, 20), RED, (255, 60, 0), ORANGE)] == [1, 1, 1, 0]
    assert share(colour_mask(plain((255, 200, 200)), reds)) == 0  # saturation 55


def test_the_share_is_of_all_pixels():
    mask = colour_mask(with_rectangle(RED), TARGET_COLOURS["ur5"])
    assert share(mask) == 20 * 10 / (160 * 90)


def test_the_largest_blob_is_the_one_with_the_most_pixels():
    mask = np.zeros((10, 20), bool)
    mask[0:2, 0:9] = True  # 18 pixels, the larger box
    mask[5:9, 12:17] = True  # 20 pixels
    blob = largest_blob(mask)
    assert blob.share == 20 / 200
    assert blob.box == (12, 5, 5, 4)
    assert blob.box_share == 20 / 200
    # Columns 12 to 16: their middle is 14.5 of 20 from the left edge; rows 5 to 8: 7 of 10 from the top.
    assert blob.centre == pytest.approx((14.5 / 10 - 1, 7 / 5 - 1))


def test_pixels_that_touch_at_corners_are_one_blob():
    blob = largest_blob(np.eye(4, dtype=bool))
    assert (blob.share, blob.box_share) == (4 / 16, 1.0)
    assert blob.centre == pytest.approx((0.0, 0.0))


@pytest.mark.parametrize(("corner", "centre"), [((0, 0), (-0.95, -0.9)), ((9, 19), (0.95, 0.9))])
def test_a_pixel_in_the_corner_is_almost_at_the_edge(corner, centre):
    mask = np.zeros((10, 20), bool)
    mask[corner] = True
    assert largest_blob(mask).centre == pytest.approx(centre)


def test_an_empty_mask_has_no_blob_and_a_full_one_is_a_blob_in_the_middle():
    assert largest_blob(np.zeros((90, 160), bool)) is None
    blob = largest_blob(np.ones((90, 160), bool))
    assert (blob.share, blob.box, blob.box_share) == (1.0, (0, 0, 160, 90), 1.0)
    assert blob.centre == pytest.approx((0.0, 0.0))


def test_a_mask_that_is_all_or_nothing_is_named():
    mask = np.zeros((3, 4), bool)
    assert "no pixel has one of these colours: widen" in mask_warning(mask)
    mask[1, 1] = True
    assert mask_warning(mask) is None
    assert "every pixel has one of these colours: narrow" in mask_warning(~np.zeros((3, 4), bool))


def test_the_weights_favour_the_middle():
    weights = centre_weights(2, 4)
    # Columns' middles are at -3/4, -1/4, 1/4, 3/4, rows' at -1/2, 1/2.
    np.testing.assert_allclose(weights, [[0.125, 0.375, 0.375, 0.125]] * 2)
    assert centre_weights(3, 5)[1, 2] == 1.0
    large = centre_weights(90, 160)
    assert large.dtype == np.float32
    assert 0 < large.min() < 0.001
    assert 0.98 < large.max() <= 1
    np.testing.assert_allclose(large, large[::-1, ::-1], atol=1e-6)


def test_the_weighted_share_is_the_mean_of_mask_times_weights():
    mask = np.array([[True, True, False, False], [False, False, False, True]])
    weights = np.array([[0.5, 1.0, 0.25, 0.75], [0.125, 0.5, 1.0, 0.25]], np.float32)
    assert weighted_share(mask, weights) == (0.5 + 1.0 + 0.25) / 8
    assert weighted_share(np.zeros((2, 4), bool), weights) == 0.0
    assert weighted_share(np.ones((2, 4), bool), weights) == 4.375 / 8


def test_the_same_target_counts_for_more_in_the_middle_and_when_it_is_larger():
    weights = centre_weights(90, 160)

    def of_circle(centre, radius):
        picture = plain(GREY)
        cv2.circle(picture, centre, radius, RED, cv2.FILLED)
        return weighted_share(colour_mask(picture, TARGET_COLOURS["ur5"]), weights)

    assert of_circle((80, 45), 10) > of_circle((110, 45), 10) > of_circle((140, 70), 10) > 0
    assert of_circle((80, 45), 12) > of_circle((80, 45), 10)


@pytest.mark.parametrize(
    ("space", "low", "high", "match"),
    [
        (BGR, (0, 0, 256), (50, 50, 255), r"low = \(0, 0, 256\): expected B 0-255, G 0-255, R 0-255"),
        (BGR, (60, 0, 0), (50, 50, 255), "B from 60 to 50: expected low <= high"),
        (HSV, (0, 0, 0), (180, 255, 255), r"high = \(180, 255, 255\): expected H 0-179, S 0-255, V 0-255"),
        (HSV, (0, 9, 0), (10, 8, 255), "S from 9 to 8: expected low <= high"),
        (HSV, (0, -1, 0), (10, 8, 255), "expected H 0-179"),
    ],
)
def test_a_range_that_is_none_is_refused(space, low, high, match):
    with pytest.raises(ConfigError, match=match):
        ColourRange(space, low, high)
