"""Gather and crop in one pass. The only file that imports numba: import it where there is a camera, not before."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from common.messages import Int64Array, UInt8Array

_SIZE = np.uintp
"""Type of offsets into memory. Signed ones may be negative, and numba would look at each whether it is."""


def gather_and_crop(frames: UInt8Array, slots: Int64Array, y: int, x: int, out: UInt8Array) -> None:
    """Fill ``out`` (B, h, w, S * C) with crops of ``frames`` (F, H, W, C), oldest frame first along the channels.

    Args:
        frames: all frames there are.
        slots: (B, S) indices into ``frames``, oldest first. Nothing is checked here: they must lie in [0, F).
        y: upper edge of the crop; y + h <= H.
        x: left edge of the crop; x + w <= W.
        out: result.
    """
    colours = slots.shape[1] == 3 and frames.shape[3] == 3
    if colours and frames.flags.c_contiguous and out.flags.c_contiguous and min(frames.size, out.size) >= 4:
        # Three colour images, as in most tasks: worth three times the speed.
        _gather_three_rgb(
            _words(frames), frames.reshape(-1), frames.shape[1:3], slots, y, x, _words(out), out.reshape(-1), out.shape
        )
    else:
        _gather(frames, slots, y, x, out)


def _words(pixels: UInt8Array) -> npt.NDArray[np.uint32]:
    """Return the four bytes from every byte on: element i begins at byte i."""
    return np.ndarray((pixels.size - 3,), np.uint32, buffer=pixels, strides=(1,))


@numba.njit(nogil=True, cache=True)
def _gather(frames: UInt8Array, slots: Int64Array, y: int, x: int, out: UInt8Array) -> None:
    batch, stack = slots.shape
    height, width = out.shape[1], out.shape[2]
    channels = frames.shape[3]
    for b in range(batch):
        for row in range(height):
            target = out[b, row]
            for s in range(stack):
                source = frames[slots[b, s], y + row]
                first = s * channels
                if channels == 3:  # spelt out, because the inner loop over channels takes twice as long
                    for column in range(width):
                        target[column, first] = source[x + column, 0]
                        target[column, first + 1] = source[x + column, 1]
                        target[column, first + 2] = source[x + column, 2]
                else:
                    for column in range(width):
                        for channel in range(channels):
                            target[column, first + channel] = source[x + column, channel]


@numba.njit(nogil=True, cache=True)
def _gather_three_rgb(
    words: npt.NDArray[np.uint32],
    pixels: UInt8Array,
    frame_size: Any,
    slots: Int64Array,
    y: int,
    x: int,
    out_words: npt.NDArray[np.uint32],
    out_pixels: UInt8Array,
    out_shape: Any,
) -> None:
    """Copy each pixel as four bytes, of which the next one overwrites the fourth; the last of a row as its three."""
    frame_height, frame_width = frame_size
    batch, height, width, _ = out_shape
    three = _SIZE(3)
    for b in range(batch):
        for row in range(height):
            offset = ((y + row) * frame_width + x) * 3
            a0 = _SIZE(slots[b, 0] * frame_height * frame_width * 3 + offset)
            a1 = _SIZE(slots[b, 1] * frame_height * frame_width * 3 + offset)
            a2 = _SIZE(slots[b, 2] * frame_height * frame_width * 3 + offset)
            at = _SIZE((b * height + row) * width * 9)
            for _ in range(width - 1):
                out_words[at] = words[a0]
                out_words[at + three] = words[a1]
                out_words[at + _SIZE(6)] = words[a2]
                a0, a1, a2, at = a0 + three, a1 + three, a2 + three, at + _SIZE(9)
            for byte in range(3):
                out_pixels[at + _SIZE(byte)] = pixels[a0 + _SIZE(byte)]
                out_pixels[at + _SIZE(3 + byte)] = pixels[a1 + _SIZE(byte)]
                out_pixels[at + _SIZE(6 + byte)] = pixels[a2 + _SIZE(byte)]
