"""The learner's end of the ring: maps the file read-only and gathers minibatches from it."""

from __future__ import annotations

import mmap
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from common.errors import RingError
from common.frame_ring.layout import HEADER_BYTES, RingLayout
from common.frame_ring.view import BoolArray, RingView, crop_stacks
from common.messages import Int64Array
from common.minibatch import Minibatch


@dataclass(frozen=True)
class Gathered:
    """A minibatch as it was read, and which of it can be trusted."""

    minibatch: Minibatch
    valid: BoolArray
    """(B,) False where the writer overtook the gather, or the row ends no transition."""


class RingReader(RingView):
    """Read-only view of a ring that another process writes, and may stop and go on writing."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Map the ring.

        Raises:
            RingError: the file is not there or is no ring of this release.
        """
        name = os.fspath(path)
        try:
            with Path(path).open("rb") as file:
                sizes = read_layout(name, file.fileno())
                mapped = mmap.mmap(file.fileno(), sizes.file_bytes, prot=mmap.PROT_READ)
        except OSError as error:
            raise RingError(f"{name}: cannot map the experience ring: {error.strerror}") from error
        super().__init__(sizes, mapped)

    def gather(
        self,
        rows: Int64Array,
        crop_shape: Sequence[int] | None = None,
        crop_offset: Sequence[int] = (0, 0),
        next_crop_offset: Sequence[int] | None = None,
    ) -> Gathered:
        """Copy transitions out of the ring.

        Args:
            rows: (B,) numbers of the transitions' second rows, as sampled by replay. Any numbers are safe.
            crop_shape: (h, w) in pixels; None: the whole frame. Unused without camera.
            crop_offset: (y, x) of the crop of o, pixels.
            next_crop_offset: the same for o'; None: as for o.

        Raises:
            ValueError: the crop lies outside the frames.
        """
        pairs = self.read_pairs(rows)
        first, second = pairs.first, pairs.second
        frames = next_frames = None
        if self.layout.frame_stack:
            frames = crop_stacks(self.frames, self.frame_slots(first["stack"]), crop_offset, crop_shape)
            next_frames = crop_stacks(
                self.frames,
                self.frame_slots(second["stack"]),
                crop_offset if next_crop_offset is None else next_crop_offset,
                crop_shape,
            )
        minibatch = Minibatch.of_rows(first, second, pairs.rows, frames, next_frames)
        return Gathered(minibatch, valid=self.not_overtaken(pairs))


def drop_overtaken(gathered: Gathered) -> Minibatch | None:
    """Return the transitions that can be trusted, usually all; None if none is left."""
    kept, minibatch = gathered.valid, gathered.minibatch
    if kept.all():
        return minibatch if len(kept) else None
    if not kept.any():
        return None
    return Minibatch(
        rows=minibatch.rows[kept],
        frames=None if minibatch.frames is None else minibatch.frames[kept],
        proprioception=minibatch.proprioception[kept],
        previous_action=minibatch.previous_action[kept],
        action=minibatch.action[kept],
        chosen_action=minibatch.chosen_action[kept],
        log_probability=minibatch.log_probability[kept],
        reward=minibatch.reward[kept],
        terminated=minibatch.terminated[kept],
        next_frames=None if minibatch.next_frames is None else minibatch.next_frames[kept],
        next_proprioception=minibatch.next_proprioception[kept],
    )


def read_layout(path: str, file_descriptor: int) -> RingLayout:
    """Return the layout of an open ring file.

    Raises:
        RingError: no ring of this release, or cut short.
    """
    sizes = RingLayout.from_header(path, os.pread(file_descriptor, HEADER_BYTES, 0))
    length = os.fstat(file_descriptor).st_size
    if length < sizes.file_bytes:
        # Touching a page beyond the end would kill the process without an exception.
        raise RingError(f"{path}: {length} bytes, expected {sizes.file_bytes}; delete the file to start an empty ring")
    return sizes
