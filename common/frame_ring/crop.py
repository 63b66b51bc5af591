"""The RAD random crop (thesis 3.6): margins in the TaskSpec, one offset per minibatch, the centre when acting."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from common.errors import MessageError
from common.messages import TaskSpec, UInt8Array


def crop_shape(spec: TaskSpec) -> tuple[int, int]:
    """Return (h, w) in pixels, what is left of a frame between the margins; (0, 0) without camera.

    Raises:
        MessageError: the margins leave nothing.
    """
    if not spec.has_camera:
        return 0, 0
    h, w = (int(n) for n in spec.frame_shape[:2] - 2 * spec.crop_margin)
    if min(h, w) < 1 or min(spec.crop_margin) < 0:
        raise MessageError(
            f"TaskSpec of {spec.task}: crop_margin {spec.crop_margin} does not fit frame_shape {spec.frame_shape}"
        )
    return h, w


def central_crop_offset(spec: TaskSpec) -> tuple[int, int]:
    """Return the (y, x) of the crop that acting uses, pixels."""
    return int(spec.crop_margin[0]), int(spec.crop_margin[1])


def draw_crop_offset(spec: TaskSpec, rng: np.random.Generator) -> tuple[int, int]:
    """Return (y, x) in pixels, uniform over 0 .. 2 h_y and 0 .. 2 h_x inclusive; draw anew for each minibatch."""
    y, x = rng.integers(0, 2 * spec.crop_margin, endpoint=True)
    return int(y), int(x)


def central_crop(frames: Sequence[UInt8Array], spec: TaskSpec) -> UInt8Array:
    """Return the observation that acting sees.

    Args:
        frames: the stack, S arrays (H, W, C), oldest first.
        spec: task the frames belong to.

    Returns:
        (h, w, S * C): as in :class:`common.minibatch.Minibatch`, for one observation.
    """
    (y, x), (h, w) = central_crop_offset(spec), crop_shape(spec)
    return np.concatenate([frame[y : y + h, x : x + w] for frame in frames], axis=-1)
