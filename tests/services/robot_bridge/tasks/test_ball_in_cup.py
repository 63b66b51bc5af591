"""What Ball-in-Cup's camera shows, and what stops in it."""

import numpy as np
import pytest

from services.robot_bridge.tasks import load_task
from tests.services.robot_bridge.opengl import skip_without_opengl

CYCLE_NS = 40_000_000


def build(name="ball_in_cup"):
    task = load_task(name, rng=np.random.default_rng(0))
    task.advance_to(0)
    return task


def ball_at(task, x, z, cup=(0.0, 0.0)):
    """Put the ball at (x, z), metres, by the world's coordinates; its joints are relative to (0, .2)."""
    task._world.reset(np.array([*cup, x, z - 0.2]))


# The target is a box about (0, .55) with half-sides of .05; the ball's radius of .025 must be inside.
@pytest.mark.parametrize(
    ("x", "z", "inside"),
    [
        (0.0, 0.55, True),
        (0.0249, 0.55, True),
        (-0.0249, 0.5749, True),
        (0.0251, 0.55, False),
        (0.0, 0.5751, False),
        (0.0, 0.5249, False),
        (0.0, 0.3, False),
    ],
)
def test_the_goal_is_a_ball_wholly_inside_the_cup(x, z, inside):
    task = build()
    ball_at(task, x, z)
    assert task.outcome().terminated is inside
    ball_at(task, x + 0.1, z - 0.05, cup=(0.1, -0.05))  # the target moves with the cup
    assert task.outcome().terminated is inside


def test_a_start_touches_nothing():
    task = build()
    for _ in range(300):
        task.begin_attempt()
        assert not task._world.in_contact


def test_a_stop_brakes_the_cup_and_leaves_the_ball_to_gravity():
    task = build()
    ball_at(task, 0.1, 0.4)
    task.command(np.ones(2, np.float32))
    task.advance_to(5 * CYCLE_NS)
    ball = task.read().proprioception[6:].copy()
    task.stop()
    stopped = task.read().proprioception
    np.testing.assert_array_equal(stopped[4:], [0, 0, *ball])
    # Without force, its springs bring the cup back to the middle, below which its weight and the ball's pull it.
    task.advance_to(200 * CYCLE_NS)
    x, z = task.read().proprioception[:2]
    assert abs(x) < 0.02
    assert -0.15 < z < -0.03


def frame_of(task):
    (frame,) = task.read().frames
    return frame.astype(int)


def test_the_ball_moves_through_the_picture_and_the_string_hangs_between():
    skip_without_opengl()
    task = build("ball_in_cup_visual")
    seen = []
    for x in (-0.1, 0.0, 0.1):
        ball_at(task, x, 0.4)
        frame = frame_of(task)
        frame[:55] = 0  # the cup
        orange = (frame[..., 0] > 1.5 * frame[..., 2]) & (frame[..., 0] > 80)
        seen.append(np.argwhere(orange).mean(axis=0))
        # The free camera looks at z = .274 m from 1.002 m, 45 degrees from above: the ball is .913 m away, and there
        # are 120 / tan(22.5 deg) / .913 = 317 pixels per metre.
        assert orange.sum() == pytest.approx(np.pi * (0.025 * 317) ** 2, rel=0.15)
    expected = [(119.5 - 0.126 * np.sqrt(0.5) * 317 - 20, 159.5 + x * 317 - 100) for x in (-0.1, 0.0, 0.1)]
    np.testing.assert_allclose(seen, expected, atol=1.5)


def test_positions_are_only_in_the_frames():
    skip_without_opengl()
    task = build("ball_in_cup_visual")
    ball_at(task, 0.1, 0.4)
    first = task.read()
    ball_at(task, -0.1, 0.4)
    second = task.read()
    np.testing.assert_array_equal(first.proprioception, np.zeros(4))
    np.testing.assert_array_equal(second.proprioception, np.zeros(4))
    assert not np.array_equal(first.frames, second.frames)
