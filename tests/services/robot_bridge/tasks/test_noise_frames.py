"""A task that sees through a camera: what it reads, and when it can go on no longer."""

import numpy as np
import pytest

from common.clock import FakeClock
from common.errors import ConfigError
from services.robot_bridge.cameras import open_camera
from services.robot_bridge.tasks import load_task
from tests.services.robot_bridge.cameras.pictures import SIZE, number_of, write_video


@pytest.fixture
def clock():
    return FakeClock()


@pytest.fixture
def task(tmp_path, clock):
    """In front of a recording of ten pictures, 20 a second, that ends."""
    task = load_task(
        "noise_frames",
        overrides={"height": SIZE.height, "width": SIZE.width},
        pacing="realtime",
        rng=np.random.default_rng(0),
    )
    file = str(write_video(tmp_path / "video.avi", 10, rate=20.0))
    task.use_camera(lambda size: open_camera("recorded", {"file": file, "loop": False}, size=size, clock=clock))
    task.advance_to(clock.now_ns())
    task.begin_episode()
    yield task
    task.close()


def seen(reading):
    return [number_of(frame) for frame in reading.frames]


def test_its_frames_are_the_cameras(task, clock):
    assert seen(task.read()) == [0]
    clock.advance(0.04)
    assert seen(task.read()) == []
    clock.advance(0.06)
    reading = task.read()
    assert seen(reading) == [1, 2]
    assert reading.frame_ids.tolist() == [1, 2]
    assert reading.frame_capture_ns.tolist() == [1_050_000_000, 1_100_000_000]


def test_an_attempt_begins_with_a_frame_although_the_camera_has_ended(task, clock):
    clock.advance(5.0)
    task.advance_to(clock.now_ns())
    task.read()
    task.begin_attempt()
    reading = task.read()
    assert seen(reading) == [9]
    assert task.newest_frame_ns() == reading.frame_capture_ns[0] == 1_450_000_000


def test_without_a_camera_it_says_nothing_of_one():
    assert load_task("noise_frames", rng=np.random.default_rng(0)).newest_frame_ns() is None


def test_a_task_that_draws_its_frames_opens_no_camera():
    task = load_task("visual_dot_reacher", rng=np.random.default_rng(0))
    with pytest.raises(ConfigError, match="visual_dot_reacher draws its frames itself"):
        task.use_camera(lambda size: pytest.fail("it was opened"))
