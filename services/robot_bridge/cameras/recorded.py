"""A recorded video as a camera: its pictures come at the rate at which they were taken.

The whole recording is decoded before it begins. So a file that cannot be used is refused at once, taking frames never
waits for a disk or a decoder, and what is seen when follows from the clock alone.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import cv2

from common.clock import Clock
from common.config import setting
from common.errors import CameraError
from common.messages import UInt8Array
from services.robot_bridge.cameras.base import CHANNELS, Camera, CameraFrame, FrameQueue, PictureSize
from services.robot_bridge.cameras.pictures import to_frame

logger = logging.getLogger(__name__)

_USUAL_RATES_HZ = (1.0, 1000.0)
"""What a file says beyond these is no rate: pictures of a slide show, or a container without a time base."""


@dataclass(frozen=True)
class RecordedCameraSettings:
    """Keys of ``[camera]`` with ``name = "recorded"``."""

    file: str = setting()
    """A video file that OpenCV reads, e.g. MP4 or AVI."""
    rate: float = setting(0.0, low=0.0, high=1000.0)
    """Pictures per second; 0: as the file says."""
    loop: bool = setting(True)
    """Begin anew at the end; else the camera is lost there."""
    resize: bool = setting(False)
    """Scale pictures of another size to the task's."""
    capacity: int = setting(8, low=1, high=1000)
    """Frames kept until they are taken."""
    memory_mb: float = setting(500.0, low=1.0, high=1e6)
    """What the decoded recording may take, MB: at 160x90 pixels and 30 Hz, 78 MB a minute."""


class RecordedCamera(Camera):
    """See the module. The recording begins with its first picture when it is opened."""

    SETTINGS = RecordedCameraSettings

    def __init__(self, settings: RecordedCameraSettings, *, size: PictureSize, clock: Clock) -> None:
        self._settings, self._clock = settings, clock
        self._name = f"recording {settings.file}"
        self._end = f"{self._name} has ended; camera.loop = true begins it anew"
        self._pictures, rate_hz = _decode(settings, size, self._name)
        self._period_ns = 1e9 / rate_hz
        self._queue = FrameQueue(settings.capacity)
        self._shown = 0
        """Pictures that have come so far, over all rounds."""
        self._end_told = self._closed = False
        self._begun_ns = clock.now_ns()
        self._show_due()

    def take(self) -> list[CameraFrame]:
        self._show_due()
        return self._queue.take()

    @property
    def newest_capture_ns(self) -> int:
        self._show_due()
        return self._queue.newest_capture_ns

    @property
    def dropped(self) -> int:
        self._show_due()
        return self._queue.dropped

    @property
    def lost(self) -> str | None:
        self._show_due()
        return self._end if self._ended else None

    @property
    def losses(self) -> int:
        return int(self.lost is not None)

    def close(self) -> None:
        self._closed = True
        self._queue.take()

    @property
    def _ended(self) -> bool:
        if self._settings.loop:
            return False
        # The last picture stands for as long as every other one.
        return self._clock.now_ns() - self._begun_ns >= len(self._pictures) * self._period_ns

    def _show_due(self) -> None:
        """Queue what should have come by now."""
        if self._closed:
            return
        if self._ended and not self._end_told:
            self._end_told = True
            logger.warning("%s", self._end)
        due = int((self._clock.now_ns() - self._begun_ns) / self._period_ns) + 1
        if not self._settings.loop:
            due = min(due, len(self._pictures))
        if (unseen := due - self._shown - self._settings.capacity) > 0:
            self._queue.skip(unseen)
            self._shown += unseen
        while self._shown < due:
            capture_ns = self._begun_ns + round(self._shown * self._period_ns)
            self._queue.put(self._pictures[self._shown % len(self._pictures)], capture_ns)
            self._shown += 1


def _decode(settings: RecordedCameraSettings, size: PictureSize, name: str) -> tuple[list[UInt8Array], float]:
    """Read the whole file; return its pictures, (H, W, C) red first, and their rate, Hz."""
    if not Path(settings.file).is_file():
        is_folder = settings.file and Path(settings.file).is_dir()
        found = "is a folder" if is_folder else "there is no such file"
        raise CameraError(f"{name}: {found}; expected a video, camera.file = PATH")
    capture = cv2.VideoCapture(settings.file, cv2.CAP_FFMPEG)
    try:
        if not capture.isOpened():
            raise CameraError(f"{name}: expected a video that OpenCV can read, such as MP4 or AVI")
        rate_hz = settings.rate or capture.get(cv2.CAP_PROP_FPS)
        lowest, highest = _USUAL_RATES_HZ
        if not (settings.rate or lowest <= rate_hz <= highest):
            raise CameraError(f"{name}: says that it has {rate_hz:g} pictures a second; set camera.rate")
        pictures: list[UInt8Array] = []
        most = int(settings.memory_mb * 1e6 / (size.height * size.width * CHANNELS))
        while True:
            came, picture = capture.read()
            if not came:
                break
            if len(pictures) >= most:
                raise CameraError(
                    f"{name}: is longer than the {most / rate_hz:.0f} s that fit into camera.memory_mb = "
                    f"{settings.memory_mb:g}; cut it, or allow more"
                )
            pictures.append(to_frame(picture, size, resize=settings.resize, camera=name))
        said = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    finally:
        capture.release()
    if not pictures:
        raise CameraError(f"{name}: expected a video with pictures in it, found none")
    if len(pictures) < 0.9 * said:  # What a file says is an estimate in some formats.
        logger.warning("%s: of %d pictures %d can be decoded: it is damaged, or cut short", name, said, len(pictures))
    return pictures, rate_hz
