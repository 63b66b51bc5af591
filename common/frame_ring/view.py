"""What writer and reader share: the mapped file, and which of its rows can be used.

The protocol between them needs no lock. The writer raises the "begun" counters before it overwrites anything and the
"done" counters after. A reader copies what it wants and *then* reads "begun": whatever that has overtaken may be
torn and is thrown away.
"""

from __future__ import annotations

import mmap
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.frame_ring import layout
from common.frame_ring.layout import Records, RingLayout
from common.messages import Int64Array, UInt8Array

BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class PairRecords:
    """Copies of the rows of B transitions, and what to check after more has been copied."""

    rows: Int64Array
    """(B,) absolute numbers of the second rows."""
    first: Records
    """(B,) the rows before: o, and the action before it."""
    second: Records
    """(B,) the rows themselves: a, r, o'."""
    usable: BoolArray
    """(B,) False where the row was not yet there or ends no transition."""

    def select(self, chosen: BoolArray) -> PairRecords:
        """Return those of ``chosen`` (B,)."""
        return PairRecords(self.rows[chosen], self.first[chosen], self.second[chosen], self.usable[chosen])


class RingView:
    """The mapped ring. Row and frame numbers are absolute: they count from the ring's creation and never wrap."""

    def __init__(self, sizes: RingLayout, mapped: mmap.mmap) -> None:
        """Use a mapped ring file of the given layout."""
        self.layout = sizes
        self._mapped = mapped
        self._counters: Int64Array = np.frombuffer(mapped, "<i8", count=layout.COUNTERS, offset=layout.COUNTERS_OFFSET)
        self._rows: Records = np.frombuffer(
            mapped, sizes.row_dtype, count=sizes.capacity_rows, offset=sizes.rows_offset
        )
        pixels: UInt8Array = np.frombuffer(
            mapped, np.uint8, count=sizes.capacity_frames * sizes.frame_bytes, offset=sizes.frames_offset
        )
        self._frames: UInt8Array = pixels.reshape(sizes.capacity_frames, *sizes.frame_shape)

    @property
    def rows_appended(self) -> int:
        """Rows since the ring's creation; the number the next one will get."""
        return int(self._counters[layout.ROWS_DONE])

    @property
    def frames_appended(self) -> int:
        """Frame numbers used since the ring's creation."""
        return int(self._counters[layout.FRAMES_DONE])

    @property
    def transitions_appended(self) -> int:
        """Rows since the ring's creation that end a transition."""
        end = self.rows_appended
        return int(self._rows["transitions"][(end - 1) % self.layout.capacity_rows]) if end else 0

    def live_rows(self) -> tuple[int, int]:
        """Return (first, end): all rows outside are gone.

        Inside, all are there unless experiences came late and out of order, so check with :meth:`valid_pairs`. Row
        ``first`` itself ends no usable transition: the row before it is gone.
        """
        end = self.rows_appended
        first = max(0, self._rows_floor())
        frames_floor = self._frames_floor()
        beyond = end
        while first < beyond:  # bisection over the monotone bound
            middle = (first + beyond) // 2
            if self._rows["oldest_frame_bound"][middle % self.layout.capacity_rows] < frames_floor:
                first = middle + 1
            else:
                beyond = middle
        return min(first, end), end

    def valid_pairs(self, rows: Int64Array) -> BoolArray:
        """Return (B,) True where a row and the one before it are a transition and all of it is there."""
        at = rows % self.layout.capacity_rows
        before = (rows - 1) % self.layout.capacity_rows
        oldest = np.minimum(self._rows["oldest_frame"][at], self._rows["oldest_frame"][before])
        ends_transition = self._rows["pair"][at] != 0
        present: BoolArray = (rows >= 1) & (rows < self.rows_appended)
        valid: BoolArray = present & ends_transition & self._not_overtaken(rows - 1, oldest)
        return valid

    def read_rows(self, rows: Int64Array) -> Records:
        """Return copies of rows, structured as ``layout.row_dtype``; for live rows only, and not checked."""
        return self._rows[rows % self.layout.capacity_rows]

    def read_pairs(self, rows: Int64Array) -> PairRecords:
        """Return the records of transitions; check with :meth:`not_overtaken` after the last copy."""
        present: BoolArray = (rows >= 1) & (rows < self.rows_appended)
        first, second = self.read_rows(rows - 1), self.read_rows(rows)
        return PairRecords(rows, first, second, usable=present & (second["pair"] != 0))

    def not_overtaken(self, pairs: PairRecords) -> BoolArray:
        """Return (B,) True where what was copied before this call is whole: the transition can be used."""
        oldest = np.minimum(pairs.first["oldest_frame"], pairs.second["oldest_frame"])
        return pairs.usable & self._not_overtaken(pairs.rows - 1, oldest)

    def frame_slots(self, numbers: Int64Array) -> Int64Array:
        """Return the indices into :attr:`frames` of absolute frame numbers; always in range."""
        return numbers % self.layout.capacity_frames

    @property
    def frames(self) -> UInt8Array:
        """(capacity_frames, H, W, C): the mapped frames themselves; the writer may overwrite them at any time."""
        return self._frames

    def close(self) -> None:
        """Unmap the file; the view cannot be used any more."""
        del self._counters, self._rows, self._frames
        with suppress(BufferError):  # somebody still has the frames: unmapped when they drop them
            self._mapped.close()

    def _not_overtaken(self, rows: Int64Array, oldest: Int64Array) -> BoolArray:
        result: BoolArray = (rows >= self._rows_floor()) & (oldest >= self._frames_floor())
        return result

    def _rows_floor(self) -> int:
        return int(self._counters[layout.ROWS_BEGUN]) - self.layout.capacity_rows

    def _frames_floor(self) -> int:
        return int(self._counters[layout.FRAMES_BEGUN]) - self.layout.capacity_frames


def crop_stacks(
    frames: UInt8Array, slots: Int64Array, offset: Sequence[int], shape: Sequence[int] | None
) -> UInt8Array:
    """Return (B, h, w, S * C): stacks of ``frames`` (F, H, W, C), oldest first along the channels, cropped.

    Args:
        frames: all frames there are.
        slots: (B, S) indices into ``frames``, oldest first.
        offset: (y, x) of the crop, pixels.
        shape: (h, w) of the crop, pixels; None: the whole frame.

    Raises:
        ValueError: the crop or an index lies outside.
    """
    count, height, width, channels = frames.shape
    (y, x), (h, w) = offset, shape or (height, width)
    if not (0 <= y <= height - h and 0 <= x <= width - w):
        raise ValueError(f"crop of {h} x {w} at ({y}, {x}) lies outside frames of {height} x {width}")
    if slots.size and not (slots.min() >= 0 and slots.max() < count):
        raise ValueError(f"frame indices {slots.min()} to {slots.max()} lie outside 0 to {count - 1}")
    from common.frame_ring.kernel import gather_and_crop  # numba: only tasks with a camera pay for it

    out = np.empty((len(slots), h, w, slots.shape[1] * channels), np.uint8)
    gather_and_crop(frames, slots, y, x, out)
    return out
