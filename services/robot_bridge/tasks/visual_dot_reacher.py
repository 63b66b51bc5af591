"""Visual Dot-Reacher: the dot's position is only in the camera's frames; its velocity is felt."""

from __future__ import annotations

from typing import Any, ClassVar

import cv2
import numpy as np

from services.robot_bridge.robots.dot import MAX_SPEED, POSITION_LIMIT
from services.robot_bridge.tasks.base import SensorReading
from services.robot_bridge.tasks.dot_reacher import DotReacher

FRAME_SIZE = 44
"""Height and width of a frame, pixels."""
CROP_MARGIN = 1
"""RAD crop margin, pixels: a tenth would cut off the dot at the walls' side of a drawing this small."""
FRAME_STACK = 3
DOT_RADIUS = 3
"""Pixels."""
BACKGROUND_RGB, TARGET_RGB, DOT_RGB = (30, 30, 30), (200, 40, 40), (70, 130, 255)
_SHIFT = 4
"""OpenCV draws at 1 / 2**4 of a pixel, so that small movements are visible."""


class VisualDotReacher(DotReacher):
    """One camera frame per action cycle, drawn with OpenCV when it is read."""

    # A speed condition leaves the initial policy too few hits to learn from images within minutes.
    PRESETS: ClassVar = {
        "demo": {"target_half_width": 0.2, "target_speed": 0.0},
        "thesis": {"target_speed": 0.15, "reset_steps": 20},
    }

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        self._next_frame_id = 0
        self._background = np.full((FRAME_SIZE, FRAME_SIZE, 3), BACKGROUND_RGB, np.uint8)
        half_width = self._settings.target_half_width
        corners = self._pixels(np.array([[-half_width, -half_width], [half_width, half_width]]))
        cv2.rectangle(self._background, corners[0], corners[1], TARGET_RGB, cv2.FILLED, cv2.LINE_8, _SHIFT)

    def read(self) -> SensorReading:
        frame = self._background.copy()
        (center,) = self._pixels(self._dot.position[None])
        cv2.circle(frame, center, DOT_RADIUS << _SHIFT, DOT_RGB, cv2.FILLED, cv2.LINE_AA, _SHIFT)
        frame_id = self._next_frame_id
        self._next_frame_id += 1
        return SensorReading(
            frames=frame[None],
            frame_ids=np.array([frame_id], np.int64),
            frame_capture_ns=np.array([self._now_ns or 0], np.int64),
            proprioception=self._dot.velocity.astype(np.float32),
        )

    def _observation_spec(self) -> dict[str, Any]:
        limits = np.full(2, MAX_SPEED, np.float32)
        return {
            "algorithm_presets": {"sac": "visual_dot_reacher", "ppo": "visual_dot_reacher"},
            "proprioception_low": -limits,
            "proprioception_high": limits,
            "frame_shape": np.array([FRAME_SIZE, FRAME_SIZE, 3], np.int64),
            "frame_stack": FRAME_STACK,
            "crop_margin": np.array([CROP_MARGIN, CROP_MARGIN], np.int64),
        }

    @staticmethod
    def _pixels(positions: np.ndarray) -> list[tuple[int, int]]:
        """Map world positions (n, 2) to fixed-point pixels; the dot at a wall is still whole after the crop."""
        margin = DOT_RADIUS + CROP_MARGIN
        span = FRAME_SIZE - 1 - 2 * margin
        unit = (positions / POSITION_LIMIT + 1) / 2
        return [(round(x), round(y)) for x, y in (margin + unit * span) * (1 << _SHIFT)]
