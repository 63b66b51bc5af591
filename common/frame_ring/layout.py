"""Where everything stands in the ring's file: header, table of persisted ranges, rows, frames."""

from __future__ import annotations

import hashlib
import math
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from common.errors import RingError
from common.messages import TaskSpec

MAGIC = b"RELODRNG"
LAYOUT_VERSION = 1
"""Raised with every change of this file that would misread an older ring."""
PAGE = 4096
PERSISTED_RANGES = 4096
"""Slots in the table of persisted ranges; one is used per bridge incarnation and per lasting gap."""

Records = npt.NDArray[np.void]
"""Structured array of :attr:`RingLayout.row_dtype`."""

SOURCES = ("none", "policy", "held", "zero", "stop")
"""``action_source`` is stored as the index of its value here."""

RANGE_DTYPE = np.dtype([("incarnation", "<u8"), ("first", "<i8"), ("length", "<i8")])
"""Time steps ``first`` to ``first + length - 1`` of a bridge incarnation are persisted; length 0: a free slot."""

# Counters, one aligned 8-byte word each, so that a reader in another process never sees half of one.
# "begun" is raised before old content is overwritten, "done" after the new content is complete.
ROWS_BEGUN, ROWS_DONE, FRAMES_BEGUN, FRAMES_DONE = range(4)
COUNTERS = 4


@dataclass(frozen=True)
class RingLayout:
    """Sizes that fix the file's layout. Letters as in :mod:`common.messages`."""

    capacity_rows: int
    capacity_frames: int
    """0 without camera."""
    action_size: int
    proprioception_size: int
    frame_height: int
    frame_width: int
    frame_channels: int
    frame_stack: int
    """0 without camera."""

    @classmethod
    def of_task(cls, spec: TaskSpec, capacity_rows: int, frames_per_row: float) -> RingLayout:
        """Return the layout for a task.

        Raises:
            RingError: fewer than two rows, or a task whose camera has no pixels.
        """
        sizes = spec.dimensions
        if capacity_rows < 2:
            raise RingError(f"experience ring: capacity_rows must be at least 2, got {capacity_rows}")
        if sizes.S and 0 in (sizes.H, sizes.W, sizes.C):
            raise RingError(f"experience ring: frame_stack is {sizes.S} but frame_shape {spec.frame_shape}")
        # Two stacks without a common frame must fit, and the frames of the row being written.
        frames = max(math.ceil(capacity_rows * frames_per_row), 4 * sizes.S) if sizes.S else 0
        return cls(capacity_rows, frames, sizes.A, sizes.P, sizes.H, sizes.W, sizes.C, sizes.S)

    @cached_property
    def row_dtype(self) -> np.dtype[np.void]:
        """One experience; physical units, times in ns on the bridge's monotonic clock."""
        return np.dtype(
            [
                ("incarnation", "<u8"),
                ("seq", "<i8"),
                ("episode", "<i8"),
                ("attempt", "<i8"),
                ("step_index", "<i8"),
                ("actor_incarnation", "<u8"),
                ("stack", "<i8", (self.frame_stack,)),  # absolute frame numbers, newest last
                ("frame_ids", "<i8", (self.frame_stack,)),  # the bridge's ids of the same frames
                ("oldest_frame", "<i8"),  # smallest number in "stack"
                ("oldest_frame_bound", "<i8"),  # largest "oldest_frame" of this row and those before: monotone
                ("transitions", "<i8"),  # rows with "pair" up to this one
                ("policy_version", "<i8"),
                ("action_applied_ns", "<i8"),
                ("published_ns", "<i8"),
                ("proprioception", "<f4", (self.proprioception_size,)),  # ends with the pending actions, if there are
                ("action", "<f4", (self.action_size,)),  # applied
                ("chosen_action", "<f4", (self.action_size,)),
                ("log_probability", "<f4"),
                ("reward", "<f4"),
                ("action_source", "u1"),
                ("has_extras", "u1"),
                ("terminated", "u1"),
                ("truncated", "u1"),
                ("new_frames", "u1"),  # frames at the end of "stack" that came with this experience
                ("whole", "u1"),  # the observation is what the policy saw: nothing of it was lost
                ("pair", "u1"),  # row - 1 is the experience just before: this row ends a transition
            ],
            align=True,
        )

    @property
    def frame_shape(self) -> tuple[int, int, int]:
        """(height, width, channels)"""
        return self.frame_height, self.frame_width, self.frame_channels

    @property
    def frame_bytes(self) -> int:
        """Bytes of one frame."""
        return math.prod(self.frame_shape)

    @property
    def ranges_offset(self) -> int:
        """Byte offset of the table of persisted ranges."""
        return PAGE

    @property
    def rows_offset(self) -> int:
        """Byte offset of the first row."""
        return _page_end(self.ranges_offset + PERSISTED_RANGES * RANGE_DTYPE.itemsize)

    @property
    def frames_offset(self) -> int:
        """Byte offset of the first frame."""
        return _page_end(self.rows_offset + self.capacity_rows * self.row_dtype.itemsize)

    @property
    def file_bytes(self) -> int:
        """Size of the file."""
        return _page_end(self.frames_offset + self.capacity_frames * self.frame_bytes)

    def header(self) -> bytes:
        """Return the file's first bytes: magic, layout version, sizes, their digest."""
        head = np.zeros((), _HEADER_DTYPE)
        head["magic"], head["version"] = MAGIC, LAYOUT_VERSION
        head["sizes"] = tuple(asdict(self).values())
        return head.tobytes()[:-_DIGEST_BYTES] + _digest(head)

    @classmethod
    def from_header(cls, path: str, data: bytes) -> RingLayout:
        """Return the layout that a ring file's first bytes tell.

        Raises:
            RingError: no ring, one of another version, or a damaged header.
        """
        if len(data) < HEADER_BYTES or data[: len(MAGIC)] != MAGIC:
            raise RingError(f"{path}: not an experience ring; move it away or choose another run directory")
        head = np.frombuffer(data, _HEADER_DTYPE, count=1)[0]
        if head["version"] != LAYOUT_VERSION:
            raise RingError(
                f"{path}: experience ring of layout version {head['version']}, this release writes {LAYOUT_VERSION}; "
                "use that release, or choose another run directory"
            )
        if data[HEADER_BYTES - _DIGEST_BYTES : HEADER_BYTES] != _digest(head):
            raise RingError(f"{path}: the header is damaged; delete the file to start an empty ring")
        return cls(*(int(size) for size in head["sizes"]))

    def differences(self, wanted: RingLayout) -> str:
        """Return text that names every size in which this layout is not the wanted one."""
        have, want = asdict(self), asdict(wanted)
        return ", ".join(f"{name} {have[name]} (wanted {want[name]})" for name in have if have[name] != want[name])


_DIGEST_BYTES = 16
_HEADER_DTYPE = np.dtype([("magic", "S8"), ("version", "<u8"), ("sizes", "<i8", (8,)), ("digest", f"V{_DIGEST_BYTES}")])
HEADER_BYTES = _HEADER_DTYPE.itemsize
COUNTERS_OFFSET = 256
assert HEADER_BYTES <= COUNTERS_OFFSET


def _digest(head: Any) -> bytes:
    content = head.tobytes()[:-_DIGEST_BYTES]
    return hashlib.blake2b(content, digest_size=_DIGEST_BYTES).digest()


def _page_end(offset: int) -> int:
    return -(-offset // PAGE) * PAGE
