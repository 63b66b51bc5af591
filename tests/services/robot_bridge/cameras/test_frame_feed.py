"""A camera's frames in the readings of a task."""

import numpy as np
import pytest

from services.robot_bridge.cameras import CameraFrame
from services.robot_bridge.cameras.frame_feed import MOST_FRAMES, FrameFeed


class ScriptedCamera:
    """Gives the frames that it is told; frame i was taken at time 10 i."""

    def __init__(self) -> None:
        self._coming = []
        self.newest_capture_ns = 0
        self.closed = False

    def show(self, *ids) -> None:
        self._coming += [CameraFrame(np.full((2, 3, 3), i, np.uint8), i, 10 * i) for i in ids]
        self.newest_capture_ns = 10 * ids[-1]

    def take(self):
        coming, self._coming = self._coming, []
        return coming

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def camera():
    return ScriptedCamera()


def read(feed):
    """What each frame shows, its id, its time."""
    frames, ids, captured = feed.read()
    assert (frames.dtype, ids.dtype, captured.dtype) == (np.uint8, np.int64, np.int64)
    assert frames.shape == (len(ids), 2, 3, 3)
    return frames[:, 0, 0, 0].tolist(), ids.tolist(), captured.tolist()


def test_a_reading_has_the_frames_since_the_one_before_none_one_or_several(camera):
    feed = FrameFeed(camera)
    camera.show(0)
    assert read(feed) == ([0], [0], [0])
    assert read(feed) == ([], [], [])
    camera.show(1)
    feed.advance()
    camera.show(2, 3)
    assert read(feed) == ([1, 2, 3], [1, 2, 3], [10, 20, 30])


def test_an_attempt_begins_with_the_newest_frame_only(camera):
    feed = FrameFeed(camera)
    camera.show(0, 1, 2)
    assert read(feed) == ([2], [0], [20])


def test_an_attempt_begins_with_a_frame_even_if_none_is_new(camera):
    feed = FrameFeed(camera)
    camera.show(5)
    read(feed)
    feed.begin_attempt()
    assert read(feed) == ([5], [1], [50])  # a frame of its own, with the time at which it was taken
    assert read(feed) == ([], [], [])


def test_ids_have_no_gap_where_the_camera_dropped_frames(camera):
    feed = FrameFeed(camera)
    camera.show(0)
    read(feed)
    camera.show(7, 9)
    assert read(feed) == ([7, 9], [1, 2], [70, 90])


def test_of_very_many_frames_the_newest_are_read(camera):
    feed = FrameFeed(camera)
    camera.show(0)
    read(feed)
    for frame in range(1, 101):
        camera.show(frame)
        feed.advance()
    shown, ids, _ = read(feed)
    assert shown == list(range(101 - MOST_FRAMES, 101))
    assert ids == list(range(1, MOST_FRAMES + 1))


def test_the_newest_frames_time_is_the_cameras(camera):
    feed = FrameFeed(camera)
    camera.show(3)
    assert feed.newest_frame_ns == 30
    feed.close()
    assert camera.closed
