"""What is asked of a camera: its new frames, numbered and with the times at which they were taken."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass
from typing import Any, ClassVar

from common.clock import Clock
from common.messages import UInt8Array

CHANNELS = 3
"""Red, green, blue."""


@dataclass(frozen=True)
class PictureSize:
    """Of the frames that are wanted, pixels."""

    height: int
    width: int

    def __str__(self) -> str:
        return f"{self.width}x{self.height}"


@dataclass(frozen=True)
class CameraFrame:
    """One picture and when it was taken."""

    frame: UInt8Array
    """(H, W, C): channels are red, green, blue. Nobody writes into it."""
    frame_id: int
    """Consecutive over the camera's lifetime, whatever becomes of its device; a gap is a frame that was dropped."""
    capture_ns: int
    """When it was taken, on the camera's clock."""


class Camera(ABC):
    """A camera that takes pictures whether anyone looks or not.

    Nothing here waits: :meth:`take` returns what has come. A camera that is lost, because its plug was pulled or its
    server is gone, says so in :attr:`lost` and goes on trying; whoever uses it looks at the age of the newest frame.
    """

    SETTINGS: ClassVar[type]
    """Dataclass of the camera's settings (:func:`common.config.setting`), the keys of ``[camera]``."""

    @abstractmethod
    def __init__(self, settings: Any, *, size: PictureSize, clock: Clock) -> None:
        """Open the camera; its first frame is there when this returns.

        Raises:
            CameraError: there is no such camera, nothing comes from it, or its pictures are not of ``size``.
        """

    @abstractmethod
    def take(self) -> list[CameraFrame]:
        """Return the frames that are new since the last call, oldest first; never waits.

        Only so many are kept for whoever does not look: the oldest are dropped.
        """

    @property
    @abstractmethod
    def newest_capture_ns(self) -> int:
        """When the newest frame was taken, whether it has been handed out or not."""

    @property
    @abstractmethod
    def dropped(self) -> int:
        """Frames that nobody took in time, or that could not be decoded."""

    @property
    @abstractmethod
    def lost(self) -> str | None:
        """Why no frames come at present, as a sentence for the user; None while they do."""

    @property
    @abstractmethod
    def losses(self) -> int:
        """How often the camera has been lost."""

    @abstractmethod
    def close(self) -> None:
        """Let go of the device; no frames come any more. May be called twice."""


class FrameQueue:
    """Frames between a camera and whoever takes them: numbered, bounded, for two threads."""

    def __init__(self, capacity: int) -> None:
        self._frames: deque[CameraFrame] = deque(maxlen=capacity)
        self._lock = threading.Lock()
        self._next_frame_id = 0
        self.dropped = 0
        """Frames that had to make room for newer ones."""
        self.newest_capture_ns = 0
        """Of the newest frame that came; 0 before the first."""

    def put(self, frame: UInt8Array, capture_ns: int) -> None:
        """Add a frame; the oldest goes if there is no room."""
        frame.flags.writeable = False
        with self._lock:
            self.dropped += len(self._frames) == self._frames.maxlen
            self._frames.append(CameraFrame(frame, self._next_frame_id, capture_ns))
            self._next_frame_id += 1
            self.newest_capture_ns = capture_ns

    def skip(self, count: int) -> None:
        """Number ``count`` frames that nobody can take any more, and drop all that are waiting."""
        with self._lock:
            self.dropped += count + len(self._frames)
            self._frames.clear()
            self._next_frame_id += count

    def take(self) -> list[CameraFrame]:
        """Return all that is here, oldest first."""
        with self._lock:
            taken = list(self._frames)
            self._frames.clear()
        return taken
