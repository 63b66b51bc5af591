"""Minibatches for a learner that cannot map the ring: each camera frame once, over the network."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from common.errors import MessageError
from common.frame_ring.view import RingView, crop_stacks
from common.messages import ArrayMinibatch, Int64Array, UInt8Array
from common.minibatch import Minibatch

MAX_PART_BYTES = 16_000_000
"""Larger messages hold up everything else on the link for too long."""


def array_minibatch(
    ring: RingView,
    rows: Int64Array,
    learner_incarnation: int,
    ordinal: int,
    max_bytes: int = MAX_PART_BYTES,
) -> list[ArrayMinibatch]:
    """Return the messages of one minibatch, in order.

    Args:
        ring: where the transitions are.
        rows: (B,) numbers of their second rows; those overtaken meanwhile are left out.
        learner_incarnation: learner that asked.
        ordinal: minibatches sent to it before.
        max_bytes: array bytes in one message; at least one frame goes into each.

    Returns:
        Nothing if no row is left.
    """
    pairs = ring.read_pairs(rows)
    pairs = pairs.select(ring.not_overtaken(pairs))
    frames: UInt8Array = np.empty((0, *ring.layout.frame_shape), np.uint8)
    index: Int64Array = np.empty((2, len(pairs.rows), 0), np.int64)
    if ring.layout.frame_stack:
        stacks = np.stack([pairs.first["stack"], pairs.second["stack"]])
        numbers, inverse = np.unique(stacks, return_inverse=True)
        index = inverse.reshape(stacks.shape)
        frames = ring.frames[ring.frame_slots(numbers)]
    left = ring.not_overtaken(pairs)
    if not left.any():
        return []
    pairs, index = pairs.select(left), index[:, left]
    first, second = pairs.first, pairs.second
    columns = {
        "rows": pairs.rows.copy(),
        "frame_index": index[0],
        "next_frame_index": index[1],
        "proprioception": first["proprioception"].copy(),
        "previous_action": first["action"].copy(),
        "next_proprioception": second["proprioception"].copy(),
        "action": second["action"].copy(),
        "chosen_action": second["chosen_action"].copy(),
        "log_probability": second["log_probability"].copy(),
        "reward": second["reward"].copy(),
        "terminated": second["terminated"].copy(),
    }
    room = max_bytes - sum(column.nbytes for column in columns.values())
    per_part = max(1, room // max(1, ring.layout.frame_bytes))
    parts = max(1, -(-len(frames) // per_part))
    return [
        ArrayMinibatch(
            learner_incarnation=learner_incarnation,
            ordinal=ordinal,
            part=part,
            parts=parts,
            frames=frames[part * per_part : (part + 1) * per_part],
            **columns,
        )
        for part in range(parts)
    ]


def minibatch_from_arrays(
    parts: Sequence[ArrayMinibatch],
    crop_shape: Sequence[int] | None = None,
    crop_offset: Sequence[int] = (0, 0),
    next_crop_offset: Sequence[int] | None = None,
) -> Minibatch:
    """Return the minibatch that replay sent as messages; the same as :meth:`RingReader.gather` makes of its rows.

    Args:
        parts: all messages of one minibatch, in order.
        crop_shape: (h, w) in pixels; None: the whole frame. Unused without camera.
        crop_offset: (y, x) of the crop of o, pixels.
        next_crop_offset: the same for o'; None: as for o.

    Raises:
        MessageError: parts are missing or do not belong together, or a frame index lies outside.
        ValueError: the crop lies outside the frames.
    """
    if not parts:
        raise MessageError("ArrayMinibatch: expected at least one part, got none")
    head = parts[0]
    for at, part in enumerate(parts):
        got = part.learner_incarnation, part.ordinal, part.part, part.parts, part.frames.shape[1:]
        want = head.learner_incarnation, head.ordinal, at, len(parts), head.frames.shape[1:]
        if got != want:
            raise MessageError(f"ArrayMinibatch: expected (learner, ordinal, part, parts, frame) {want}, got {got}")
    frames = next_frames = None
    if head.frame_index.shape[1]:
        unique = head.frames if len(parts) == 1 else np.concatenate([part.frames for part in parts])
        for name in ("frame_index", "next_frame_index"):
            index = getattr(head, name)
            if index.size and not (index.min() >= 0 and index.max() < len(unique)):
                raise MessageError(
                    f"ArrayMinibatch.{name}: expected indices from 0 to {len(unique) - 1}, "
                    f"got {index.min()} to {index.max()}"
                )
        frames = crop_stacks(unique, head.frame_index, crop_offset, crop_shape)
        other = crop_offset if next_crop_offset is None else next_crop_offset
        next_frames = crop_stacks(unique, head.next_frame_index, other, crop_shape)
    return Minibatch(
        rows=head.rows,
        frames=frames,
        proprioception=head.proprioception,
        previous_action=head.previous_action,
        action=head.action,
        chosen_action=head.chosen_action,
        log_probability=head.log_probability,
        reward=head.reward,
        terminated=head.terminated.astype(np.float32),
        next_frames=next_frames,
        next_proprioception=head.next_proprioception,
    )
