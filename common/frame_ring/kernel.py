"""Gather and crop in one pass. The only file that imports numba: import it where there is a camera, not before."""

from __future__ import annotations

import numba

from common.messages import Int64Array, UInt8Array


@numba.njit(nogil=True, cache=True)
def gather_and_crop(frames: UInt8Array, slots: Int64Array, y: int, x: int, out: UInt8Array) -> None:
    """Fill ``out`` (B, h, w, S * C) with crops of ``frames`` (F, H, W, C), oldest frame first along the channels.

    Args:
        frames: all frames there are.
        slots: (B, S) indices into ``frames``, oldest first. Nothing is checked here: they must lie in [0, F).
        y: upper edge of the crop; y + h <= H.
        x: left edge of the crop; x + w <= W.
        out: result.
    """
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
