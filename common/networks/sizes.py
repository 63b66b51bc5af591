"""Sizes of the networks; without torch."""

from __future__ import annotations

from collections.abc import Sequence

from common.errors import ConfigError
from common.messages import TaskSpec

CHANNELS = 32
"""Channels of each of the encoder's convolutions (thesis 4.2.1)."""
KERNEL = 3
"""Width and height of the encoder's kernels."""
FEATURES = 2 * CHANNELS
"""Encoder features: an (x, y) position for each channel of the last convolution."""


def cropped_shape(spec: TaskSpec) -> tuple[int, int, int]:
    """Return (height, width, S * C) of the stacked frames after the RAD crop (thesis 3.6)."""
    height, width, channels = spec.frame_shape.tolist()
    margin_y, margin_x = spec.crop_margin.tolist()
    return height - 2 * margin_y, width - 2 * margin_x, spec.frame_stack * channels


def map_size(height: int, width: int, strides: Sequence[int]) -> tuple[int, int]:
    """Return (height, width) of the last convolution's maps, for frames of ``height`` x ``width`` pixels."""
    rows, columns = height, width
    for stride in strides:
        if min(rows, columns) < KERNEL:
            raise ConfigError(f"encoder_strides = {tuple(strides)}: frames of {height}x{width} are too small")
        rows, columns = (rows - KERNEL) // stride + 1, (columns - KERNEL) // stride + 1
    return rows, columns
