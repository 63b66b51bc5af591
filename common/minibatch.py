"""The minibatch that a learner trains on, as arrays; made from the mapped ring or from received arrays."""

from __future__ import annotations

from dataclasses import dataclass

from common.messages import Float32Array, UInt8Array


@dataclass(frozen=True)
class Minibatch:
    """B transitions (o, a, r, o'), physical units, frames stacked and cropped.

    The action is the applied one. The previous action is part of the observation; that of o' is ``action`` itself.
    """

    frames: UInt8Array | None
    """(B, h, w, S * C): the stack's frames along the channels, oldest first; None without camera."""
    proprioception: Float32Array
    """(B, P)"""
    previous_action: Float32Array
    """(B, A); zeros at the start of an attempt."""
    action: Float32Array
    """(B, A)"""
    reward: Float32Array
    """(B,)"""
    terminated: Float32Array
    """(B,): 1 where the goal was reached, the only thing that cuts the bootstrap."""
    next_frames: UInt8Array | None
    """(B, h, w, S * C)"""
    next_proprioception: Float32Array
    """(B, P)"""
