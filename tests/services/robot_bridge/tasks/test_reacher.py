"""What Reacher's camera shows, and where its target is."""

import math

import numpy as np
import pytest

from common.frame_ring import central_crop
from services.robot_bridge.tasks import load_task
from tests.services.robot_bridge.opengl import skip_without_opengl

VISUAL = ["reacher_easy_visual", "reacher_hard_visual", "reacher_extreme_visual"]


def build(name, seed=0):
    skip_without_opengl()
    task = load_task(name, rng=np.random.default_rng(seed))
    task.advance_to(0)
    return task


def place(task, joints, target=(0.0, 0.1)):
    task._world.model.geom("target").pos[:2] = target
    task._world.reset(np.array(joints))


def frame_of(task):
    (frame,) = task.read().frames
    return frame.astype(int)


def target_pixels(frame):
    """The target's red: little green beside it, unlike the arm's orange and the floor's blue."""
    red, green, blue = frame[..., 0], frame[..., 1], frame[..., 2]
    return (red > 1.4 * green) & (red > 1.4 * blue) & (np.abs(green - blue) < 0.2 * red)


def pixel_of(x, y, z=0.01):
    """Row and column of a point: the free camera looks at the middle from .99 m, 45 degrees from above."""
    scale = 120 / math.tan(math.radians(22.5))
    depth = 0.99 + (y - (z - 0.01)) * math.sqrt(0.5)
    up = (y + z - 0.01) * math.sqrt(0.5)
    return 119.5 - scale * up / depth - 85, 159.5 + scale * x / depth - 110


@pytest.mark.parametrize(("name", "radius"), [("reacher_easy_visual", 0.05), ("reacher_hard_visual", 0.015)])
@pytest.mark.parametrize("target", [(0.0, 0.05), (-0.1, -0.05), (0.09, -0.01), (0.0, -0.09)])
def test_the_target_is_seen_where_it_is_and_as_large_as_it_is(name, radius, target):
    task = build(name)
    place(task, [math.pi / 2 if target[1] < 0 else -math.pi / 2, 0.3], target)  # the arm points away
    seen = target_pixels(frame_of(task))
    np.testing.assert_allclose(np.argwhere(seen).mean(axis=0), pixel_of(*target), atol=1.5)
    scale = 120 / math.tan(math.radians(22.5)) / (0.99 + target[1] * math.sqrt(0.5))
    assert seen.sum() == pytest.approx(math.pi * (radius * scale) ** 2, rel=0.25)


def test_the_extreme_target_cannot_be_seen():
    task = build("reacher_extreme_visual")
    place(task, [-math.pi / 2, 0.3])
    assert target_pixels(frame_of(task)).sum() <= 1


@pytest.mark.parametrize("name", VISUAL)
def test_the_same_state_looks_the_same_and_another_otherwise(name):
    task, other = build(name, seed=0), build(name, seed=1)
    for each in (task, other):
        place(each, [0.5, -1.2])
    np.testing.assert_array_equal(frame_of(task), frame_of(other))
    pictures = set()
    for shoulder in np.linspace(-math.pi, math.pi, 40, endpoint=False):
        place(task, [shoulder, 0.4])
        pictures.add(central_crop([task.read().frames[0]], task.spec).tobytes())
    assert len(pictures) == 40


def test_most_targets_are_in_the_picture():
    task = build("reacher_hard_visual")
    seen = 0
    for _ in range(300):
        task.begin_episode()
        row, column = pixel_of(*task._world.model.geom("target").pos[:2])
        seen += 0 <= row < 70 and 0 <= column < 100
    assert seen / 300 == pytest.approx(0.897, abs=0.06)  # 0.8967 of 100 000; three standard errors of 300


def test_a_time_out_leaves_the_target_in_the_picture_where_it_was():
    task = build("reacher_hard_visual")
    place(task, [-2.0, 0.0], (0.05, 0.03))
    places = []
    for _ in range(5):
        task.begin_attempt()
        seen = np.argwhere(target_pixels(frame_of(task)))
        if len(seen) > 40:  # the arm does not lie over it
            places.append(seen.mean(axis=0))
    assert len(places) >= 2
    np.testing.assert_allclose(places, [pixel_of(0.05, 0.03)] * len(places), atol=1.5)


def test_a_frame_is_read_when_it_is_asked_for_and_belongs_to_the_reader():
    task = build("reacher_easy_visual")
    task.command(np.ones(2, np.float32))
    first = task.read()
    kept = first.frames.copy()
    task.advance_to(400_000_000)
    second = task.read()
    assert (first.frame_ids[0], second.frame_ids[0]) == (0, 1)
    assert (first.frame_capture_ns[0], second.frame_capture_ns[0]) == (0, 400_000_000)
    assert not np.array_equal(first.frames, second.frames)
    np.testing.assert_array_equal(first.frames, kept)
    task.close()
