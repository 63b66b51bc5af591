"""From a picture as OpenCV gives it to a frame of the wanted size."""

from __future__ import annotations

import cv2

from common.errors import CameraError
from common.messages import UInt8Array
from services.robot_bridge.cameras.base import CHANNELS, PictureSize


def to_frame(picture: UInt8Array, size: PictureSize, *, resize: bool, camera: str) -> UInt8Array:
    """Return a picture, (h, w, 3) blue first, as a frame, (H, W, 3) red first.

    Args:
        picture: what came.
        size: that is wanted.
        resize: scale what is of another size.
        camera: what the error calls the camera.

    Raises:
        CameraError: not in colour, or of another size and not to be scaled.
    """
    if picture.ndim != 3 or picture.shape[2] != CHANNELS:
        raise CameraError(f"{camera} gives arrays of shape {picture.shape}: expected pictures in colour")
    came = PictureSize(*picture.shape[:2])
    if came != size:
        if not resize:
            raise CameraError(
                f"{camera} gives pictures of {came} pixels: expected {size}, the task's; choose that size there, or "
                f"set camera.resize = true"
            )
        picture = cv2.resize(picture, (size.width, size.height), interpolation=cv2.INTER_AREA)
    frame: UInt8Array = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
    return frame
