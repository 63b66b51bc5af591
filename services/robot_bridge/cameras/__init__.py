"""The table of cameras. A new kind is one file and one line here, or a ``[cameras]`` row in the configuration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from common.clock import Clock
from common.config import build_section
from services.robot_bridge.cameras.base import Camera, CameraFrame, PictureSize
from services.robot_bridge.class_table import extended, load_class

CAMERAS = {
    "opencv": "services.robot_bridge.cameras.opencv:OpenCVCamera",
    "recorded": "services.robot_bridge.cameras.recorded:RecordedCamera",
}
"""Kind of camera -> ``module:Class``; imported only when chosen."""

__all__ = ["CAMERAS", "Camera", "CameraFrame", "PictureSize", "open_camera"]


def open_camera(
    name: str,
    overrides: Mapping[str, Any] | None = None,
    rows: Mapping[str, Any] | None = None,
    *,
    size: PictureSize,
    clock: Clock,
) -> Camera:
    """Open a camera of kind ``name``.

    Args:
        name: a key of the table.
        overrides: its settings.
        rows: more rows for the table.
        size: of the frames that it has to give.
        clock: what frames' capture times are read from.

    Raises:
        ConfigError: unknown kind or setting, or a value out of range.
        CameraError: there is no such camera, nothing comes from it, or its pictures are of another size.
    """
    camera_class: Any = load_class(Camera, name, extended(CAMERAS, rows, "camera"), "camera")
    settings: Any = build_section(camera_class.SETTINGS, overrides or {}, f"[camera] {name}")
    camera: Camera = camera_class(settings, size=size, clock=clock)
    return camera
