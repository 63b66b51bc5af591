"""Gather and crop in one pass. The only file that imports numba: import it where there is a camera, not before."""

from __future__ import annotations

from typing import Any

import numba
from llvmlite import ir
from numba.extending import intrinsic

from common.messages import Int64Array, UInt8Array

_PIXELS = 7
"""Stacked pixels of three colour images that fit into a vector of 64 bytes, 9 bytes each."""
_TAKEN, _WRITTEN = 32, 64
"""Bytes that a step reads of each frame, and writes; those of its pixels are 21 and 63."""
_STACKED = [frame * _TAKEN + 3 * pixel + channel for pixel in range(8) for frame in range(3) for channel in range(3)]
"""For each byte of stacked pixels, where it lies in what was read of the three frames."""


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
    if colours and frames.flags.c_contiguous and out.flags.c_contiguous:
        # Three colour images, as in most tasks: worth vectors.
        _gather_three_rgb(frames.reshape(-1), frames.shape[1:3], slots, y, x, out.reshape(-1), out.shape)
    else:
        _gather(frames, slots, y, x, out)


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
    frames: UInt8Array, frame_size: Any, slots: Int64Array, y: int, x: int, out: UInt8Array, out_shape: Any
) -> None:
    """Stack seven pixels a step.

    What a step writes beyond its pixels, the next step or row overwrites. Rows where it would write or read beyond the
    arrays, a few of the last, are copied byte by byte.
    """
    frame_height, frame_width = frame_size
    batch, height, width, _ = out_shape
    steps = (width + _PIXELS - 1) // _PIXELS
    last_read = frames.size - _TAKEN - (steps - 1) * _PIXELS * 3
    last_written = out.size - _WRITTEN - (steps - 1) * _PIXELS * 9
    source, target = frames.ctypes.data, out.ctypes.data
    at = 0
    for b in range(batch):
        for row in range(height):
            offset = ((y + row) * frame_width + x) * 3
            a0 = slots[b, 0] * frame_height * frame_width * 3 + offset
            a1 = slots[b, 1] * frame_height * frame_width * 3 + offset
            a2 = slots[b, 2] * frame_height * frame_width * 3 + offset
            if at <= last_written and max(a0, a1, a2) <= last_read:
                for step in range(steps):
                    bytes_before = step * _PIXELS * 3
                    _stack_pixels(  # type: ignore[call-arg]  # the first argument is numba's own
                        source + a0 + bytes_before,
                        source + a1 + bytes_before,
                        source + a2 + bytes_before,
                        target + at + 3 * bytes_before,
                    )
            else:
                for pixel in range(width):
                    for channel in range(3):
                        byte = 3 * pixel + channel
                        out[at + 9 * pixel + channel] = frames[a0 + byte]
                        out[at + 9 * pixel + 3 + channel] = frames[a1 + byte]
                        out[at + 9 * pixel + 6 + channel] = frames[a2 + byte]
            at += width * 9


@intrinsic
def _stack_pixels(_: Any, oldest: Any, middle: Any, newest: Any, target: Any) -> Any:
    """Write stacked pixels of three frames; all are addresses. Compiled from loops, this would copy byte by byte."""

    def generate(_: Any, builder: Any, __: Any, addresses: Any) -> Any:
        def pointer(address: Any, size: int) -> Any:
            return builder.inttoptr(address, ir.VectorType(ir.IntType(8), size).as_pointer())

        def shuffled(first: Any, second: Any, lanes: Any) -> Any:
            return builder.shuffle_vector(first, second, ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), lanes))

        *frames, to = addresses
        old, mid, new = (builder.load(pointer(address, _TAKEN), align=1) for address in frames)
        both = list(range(2 * _TAKEN))
        stacked = shuffled(shuffled(old, mid, both), shuffled(new, new, both), _STACKED[:_WRITTEN])
        builder.store(stacked, pointer(to, _WRITTEN), align=1)
        return ir.Constant(ir.IntType(1), 0)

    return numba.types.none(oldest, middle, newest, target), generate
