"""A camera's frames as a task shows them: numbered without gaps, and one at the start of each attempt."""

from __future__ import annotations

import numpy as np

from common.messages import Int64Array, UInt8Array
from services.robot_bridge.cameras.base import Camera, CameraFrame

MOST_FRAMES = 8
"""Frames between two readings; of more, the newest. An observation needs no more than its stack."""


class FrameFeed:
    """Stands between a camera, which has a rate of its own, and the readings of a task."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._new: list[CameraFrame] = []
        self._newest: CameraFrame | None = None
        self._next_frame_id = 0
        self._begins = True
        """True until the first reading of an attempt."""

    @property
    def newest_frame_ns(self) -> int:
        """When the camera's newest frame was taken."""
        return self._camera.newest_capture_ns

    def advance(self) -> None:
        """Take what has come from the camera; to be called at least once a cycle."""
        self._new = [*self._new, *self._camera.take()][-MOST_FRAMES:]
        if self._new:
            self._newest = self._new[-1]

    def begin_attempt(self) -> None:
        """The next reading is the first of an attempt: of the frames before it, only the newest counts."""
        self._begins = True

    def read(self) -> tuple[UInt8Array, Int64Array, Int64Array]:
        """Return the frames that are new since the reading before: (k, H, W, C), ids (k,), capture times (k,).

        The first reading of an attempt has one frame: the newest there is, even if it has been seen before. Other
        readings may have none.
        """
        self.advance()
        frames = self._new
        if self._begins and self._newest is not None:
            frames = [self._newest]
            self._begins = False
        self._new = []
        ids = np.arange(self._next_frame_id, self._next_frame_id + len(frames), dtype=np.int64)
        self._next_frame_id += len(frames)
        captured = np.array([frame.capture_ns for frame in frames], np.int64)
        return self._stacked(frames), ids, captured

    def close(self) -> None:
        """Let go of the camera."""
        self._camera.close()

    def _stacked(self, frames: list[CameraFrame]) -> UInt8Array:
        if frames:
            return np.stack([frame.frame for frame in frames])
        shape = self._newest.frame.shape if self._newest else (0, 0, 0)
        return np.zeros((0, *shape), np.uint8)
