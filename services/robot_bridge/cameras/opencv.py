"""A camera that OpenCV can open: a device of this computer, or a stream from an address.

The device is read in a thread of its own, for a read waits until the next frame comes. When no more come, the thread
lets go of the device and opens it anew, again and again, until it is there.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from common.clock import Clock
from common.config import setting
from common.errors import CameraError, ConfigError
from services.robot_bridge.cameras.base import Camera, CameraFrame, FrameQueue, PictureSize
from services.robot_bridge.cameras.pictures import to_frame

logger = logging.getLogger(__name__)

NO_DEVICE = -1
UNDECODABLE_IN_A_ROW = 3
"""So many pictures of a stream that cannot be decoded are left out; with the next one it has ended, for all we know."""
_CLOSING_TAKES_S = 2.0
"""How much longer than opening or reading the thread may take to end."""


@dataclass(frozen=True)
class OpenCVCameraSettings:
    """Keys of ``[camera]`` with ``name = "opencv"``; one of ``device`` and ``url`` has to be given."""

    device: int = setting(NO_DEVICE, low=NO_DEVICE, high=255)
    """Number of a camera of this computer, 0 for /dev/video0."""
    url: str = setting("")
    """Address of a stream, e.g. http://192.168.1.30:8080/video or rtsp://192.168.1.30/stream."""
    width: int = setting(0, low=0, high=16384)
    """Width of the pictures that a device is asked for, pixels; 0: the task's."""
    height: int = setting(0, low=0, high=16384)
    """Height of the pictures that a device is asked for, pixels; 0: the task's."""
    rate: float = setting(30.0, low=0.0, high=1000.0)
    """Pictures per second that a device is asked for; 0: whatever it gives."""
    resize: bool = setting(False)
    """Scale pictures of another size to the task's."""
    capacity: int = setting(8, low=1, high=1000)
    """Frames kept until they are taken."""
    open_timeout: float = setting(5.0, low=0.1, high=60.0)
    """How long opening a stream may take, seconds."""
    read_timeout: float = setting(2.0, low=0.1, high=60.0)
    """A stream that brings nothing for this long is lost, seconds. (A device: OpenCV's own 10 s.)"""
    reconnect_after: float = setting(1.0, low=0.01, high=60.0)
    """Time between two attempts to open a lost camera, seconds."""

    def __post_init__(self) -> None:
        if (self.device == NO_DEVICE) == (not self.url):
            raise ConfigError(f"device = {self.device}, url = {self.url!r}: expected one of the two, e.g. device = 0")
        if self.url and ("://" not in self.url or self.url.startswith("file:")):
            raise ConfigError(f'url = {self.url!r}: expected http://..., rtsp://...; a file is name = "recorded"')
        if bool(self.width) != bool(self.height):
            raise ConfigError(f"width = {self.width}, height = {self.height}: expected both or neither")


class OpenCVCamera(Camera):
    """See the module. The capture time is when the frame had come and been decoded; what it took before, in the camera
    and on its way, nobody here can know."""

    SETTINGS = OpenCVCameraSettings

    def __init__(self, settings: OpenCVCameraSettings, *, size: PictureSize, clock: Clock) -> None:
        self._settings, self._size, self._clock = settings, size, clock
        self._name = f"camera {settings.url}" if settings.url else f"camera {settings.device}"
        self._queue = FrameQueue(settings.capacity)
        self._changed = clock.condition()
        self._closed = False
        self._lost: str | None = None
        self._losses = 0
        self._undecodable = 0
        # Here and not in the thread: whoever names a camera that is not there shall hear it at once.
        capture = self._open()
        self._thread = clock.thread(lambda: self._run(capture), "camera")
        self._thread.start()

    def take(self) -> list[CameraFrame]:
        return self._queue.take()

    @property
    def newest_capture_ns(self) -> int:
        return self._queue.newest_capture_ns

    @property
    def dropped(self) -> int:
        return self._queue.dropped + self._undecodable

    @property
    def lost(self) -> str | None:
        return self._lost

    @property
    def losses(self) -> int:
        return self._losses

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        # Only the thread may release the device: it may be inside a call.
        longest_s = max(self._settings.open_timeout, self._settings.read_timeout)
        self._thread.join(longest_s + _CLOSING_TAKES_S)
        if self._thread.is_alive():
            logger.warning("%s does not answer: it is released when it does", self._name)

    # ------------------------------------------------------------------ the thread

    def _run(self, capture: Any) -> None:
        while not self._closed:
            reason = self._read_until_lost(capture)
            capture.release()
            if not self._closed:
                self._lost = reason
                self._losses += 1
                logger.warning("%s; trying to open it every %g s", reason, self._settings.reconnect_after)
                capture = self._reopen()
        capture.release()

    def _read_until_lost(self, capture: Any) -> str:
        while not self._closed:
            try:
                self._read(capture)
            except CameraError as error:
                return str(error)
        return ""

    def _reopen(self) -> Any:
        """Open the device as soon as that is possible; a closed capture if the camera is closed before."""
        while not self._closed:
            try:
                capture = self._open()
            except CameraError as error:
                self._lost = str(error)
                with self._changed:
                    if not self._closed:
                        self._clock.wait(self._changed, self._settings.reconnect_after)
            else:
                logger.warning("%s is back", self._name)
                self._lost = None
                return capture
        return cv2.VideoCapture()

    # ------------------------------------------------------------------ the device

    def _open(self) -> Any:
        """Open the device and read a first frame from it."""
        capture = self._open_stream() if self._settings.url else self._open_device()
        try:
            self._read(capture)
        except BaseException:
            capture.release()
            raise
        return capture

    def _open_stream(self) -> Any:
        settings = self._settings
        timeouts = [
            *(cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, round(settings.open_timeout * 1e3)),
            *(cv2.CAP_PROP_READ_TIMEOUT_MSEC, round(settings.read_timeout * 1e3)),
        ]
        # More threads than one decode several frames at once, and each comes later by as many.
        capture = cv2.VideoCapture(settings.url, cv2.CAP_FFMPEG, [*timeouts, cv2.CAP_PROP_N_THREADS, 1])
        if not capture.isOpened():
            raise CameraError(
                f"{self._name} cannot be reached, or sends no video: expected a stream within "
                f"{settings.open_timeout:g} s; is its server running, and the address right?"
            )
        return capture

    def _open_device(self) -> Any:
        settings = self._settings
        there = sorted(path.name.removeprefix("video") for path in Path("/dev").glob("video*"))
        if str(settings.device) not in there:
            raise CameraError(
                f"{self._name} does not exist: expected one of this computer's cameras, device = "
                f"{', '.join(there) or '(it has none)'}; is it plugged in?"
            )
        capture = cv2.VideoCapture(settings.device, cv2.CAP_V4L2)
        if not capture.isOpened():
            raise CameraError(f"{self._name} cannot be opened: is another program using it, may you read it?")
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, settings.width or self._size.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, settings.height or self._size.height)
        if settings.rate:
            capture.set(cv2.CAP_PROP_FPS, settings.rate)
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # An old frame in the driver's queue is of no use.
        return capture

    def _read(self, capture: Any) -> None:
        """Wait for the next frame and queue it; pictures of a stream that cannot be decoded are left out.

        Raises:
            CameraError: none comes, or it is of a wrong size.
        """
        for undecodable in range(UNDECODABLE_IN_A_ROW + 1):
            begun_ns = self._clock.now_ns()
            try:
                came, picture = capture.read()
            except cv2.error as error:
                raise CameraError(f"{self._name} is lost: {error}") from error
            capture_ns = self._clock.now_ns()
            if came:
                frame = to_frame(picture, self._size, resize=self._settings.resize, camera=self._name)
                self._queue.put(frame, capture_ns)
                self._count_undecodable(undecodable)
                return
            if not self._settings.url:
                raise CameraError(f"{self._name} is lost: expected a frame, none came")
            if (capture_ns - begun_ns) * 1e-9 >= 0.9 * self._settings.read_timeout:
                timeout_s = self._settings.read_timeout
                raise CameraError(f"{self._name} is lost: expected a frame within {timeout_s:g} s, none came")
            if self._closed:
                return
        raise CameraError(f"{self._name} is lost: the stream has ended, or what came is no picture")

    def _count_undecodable(self, count: int) -> None:
        before, self._undecodable = self._undecodable, self._undecodable + count
        # With the first, the tenth, the hundredth: a bad link must not fill the log.
        if count and (before == 0 or len(str(self._undecodable)) > len(str(before))):
            logger.warning("%s: pictures that cannot be decoded are left out, %d so far", self._name, self._undecodable)
