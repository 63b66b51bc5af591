"""Minibatches from frames that stay on the learner's device.

A frame is part of some hundred minibatches. Here it crosses the bus once, when it is new, and not in each of them; a
minibatch brings only row fields and frame numbers, and is stacked and cropped where it is used.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Sequence

import torch
from torch import Tensor

from common.algorithms.upload import upload
from common.frame_ring import Gathered, RingReader
from common.messages import Int64Array
from common.minibatch import Minibatch

logger = logging.getLogger(__name__)

CHUNK_BYTES = 16 * 2**20
"""Most that is copied at once, so that taking over a full ring needs little of the host's pinned memory."""
UPDATE_BYTES = 2**30
"""GPU memory left for updates. Those of the thesis's images, 256 transitions in float32, take .4 GB (on the CPU)."""


class DeviceRingReader(RingReader):
    """Reads rows from the mapped ring, and frames from a copy of all of the ring's frames on the device.

    A frame has the same slot in both. What a slot of the copy holds needs no record: :meth:`RingView.not_overtaken`,
    asked after the last copy, is False for every frame that was torn meanwhile or is no longer in its slot.

    Everything goes through the device's default stream, in the order of the calls: a frame is not replaced before the
    minibatches that were gathered from it are complete, and an update never sees half of a minibatch.

    Where the device has too little memory the frames stay on the host, and this is a plain :class:`RingReader`.
    """

    def __init__(self, path: str | os.PathLike[str], device: torch.device) -> None:
        """Map the ring and make room for its frames on ``device``; see :class:`RingReader`."""
        super().__init__(path)
        self._device = device
        self._copied = 0
        """Number of the first frame that was not there when the last copy was made."""
        self._chunk = max(1, CHUNK_BYTES // max(1, self.layout.frame_bytes))
        self._copy = self._room() if self.layout.frame_stack else None

    @property
    def on_device(self) -> bool:
        """True if minibatches have their frames on the device."""
        return self._copy is not None

    def gather(
        self,
        rows: Int64Array,
        crop_shape: Sequence[int] | None = None,
        crop_offset: Sequence[int] = (0, 0),
        next_crop_offset: Sequence[int] | None = None,
    ) -> Gathered:
        """See :class:`RingReader`; the frames are tensors on the device, of the same bytes."""
        if self._copy is None:
            return super().gather(rows, crop_shape, crop_offset, next_crop_offset)
        # In this order: a row that is there has all its frames there.
        pairs = self.read_pairs(rows)
        self._catch_up(self._copy)
        valid = self.not_overtaken(pairs)
        offsets = crop_offset, crop_offset if next_crop_offset is None else next_crop_offset
        try:
            frames, next_frames = (
                crop_stacks(self._copy, self.frame_slots(records["stack"]), offset, crop_shape)
                for records, offset in zip((pairs.first, pairs.second), offsets, strict=True)
            )
        except torch.OutOfMemoryError as error:
            self._copy = None
            _keep_on_host(str(error).partition(". ")[0])
            return super().gather(rows, crop_shape, crop_offset, next_crop_offset)
        return Gathered(Minibatch.of_rows(pairs.first, pairs.second, pairs.rows, frames, next_frames), valid)

    def _catch_up(self, copy: Tensor) -> None:
        """Copy what is new since the last time, at most all that the ring holds."""
        capacity, end = self.layout.capacity_frames, self.frames_appended
        number = max(self._copied, end - capacity)
        while number < end:
            slot = number % capacity
            count = min(end - number, capacity - slot, self._chunk)
            pinned = self._device.type == "cuda"
            staged = torch.empty((count, *self.layout.frame_shape), dtype=torch.uint8, pin_memory=pinned)
            staged.numpy()[:] = self.frames[slot : slot + count]
            copy[slot : slot + count].copy_(staged, non_blocking=True)
            number += count
        self._copied = end

    def _room(self) -> Tensor | None:
        shape = self.layout.capacity_frames, *self.layout.frame_shape
        needed, free = math.prod(shape), free_bytes(self._device)
        if needed + UPDATE_BYTES > free:
            _keep_on_host(
                f"{needed / 1e9:.1f} GB, and {UPDATE_BYTES / 1e9:.1f} GB for updates, do not fit into the "
                f"{free / 1e9:.1f} GB free on {self._device}"
            )
            return None
        try:
            room = torch.empty(shape, dtype=torch.uint8, device=self._device)
        except torch.OutOfMemoryError as error:
            _keep_on_host(str(error).partition(". ")[0])
            return None
        logger.info("the frames of the ring are kept on %s: %.2f GB", self._device, needed / 1e9)
        return room


def crop_stacks(frames: Tensor, slots: Int64Array, offset: Sequence[int], shape: Sequence[int] | None) -> Tensor:
    """Return (B, h, w, S * C): stacks of ``frames`` (F, H, W, C), oldest first along the channels, cropped.

    Args:
        frames: all frames there are.
        slots: (B, S) indices into ``frames``, oldest first; not checked, and one outside ends all work of a GPU.
        offset: (y, x) of the crop, pixels.
        shape: (h, w) of the crop, pixels; None: the whole frame.

    Raises:
        ValueError: the crop lies outside.
    """
    _, height, width, channels = frames.shape
    (y, x), (h, w) = offset, shape or (height, width)
    if not (0 <= y <= height - h and 0 <= x <= width - w):
        raise ValueError(f"crop of {h} x {w} at ({y}, {x}) lies outside frames of {height} x {width}")
    stacks = frames[:, y : y + h, x : x + w][upload(slots, frames.device)]  # (B, S, h, w, C)
    return stacks.permute(0, 2, 3, 1, 4).reshape(len(slots), h, w, slots.shape[1] * channels)


def free_bytes(device: torch.device) -> float:
    """Return how much memory of a GPU is free; without bound for the CPU, whose system lends more than it has."""
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else math.inf


def _keep_on_host(reason: str) -> None:
    logger.warning(
        "the frames stay in the computer's memory, and each minibatch is copied to the device: %s; "
        "a smaller algorithm.replay_capacity would need less",
        reason,
    )
