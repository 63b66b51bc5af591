"""The minibatch that a learner trains on, as arrays; made from the mapped ring or from received arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from common.messages import Float32Array, Int64Array, UInt8Array


class DeviceArray(Protocol):
    """An array that is already on the learner's device: a torch tensor, described without torch, which replay lacks."""

    @property
    def shape(self) -> Sequence[int]:
        """As of a numpy array."""
        ...

    def __getitem__(self, index: Any, /) -> DeviceArray:
        """As of a numpy array; an array of bool selects."""
        ...


@dataclass(frozen=True)
class Minibatch:
    """B transitions (o, a, r, o'), physical units, frames stacked and cropped.

    The action is the applied one. The previous action is part of the observation; that of o' is ``action`` itself.
    """

    rows: Int64Array
    """(B,): numbers of the transitions in replay's ring; where one is the last plus 1, its o is the last one's o'."""
    frames: UInt8Array | DeviceArray | None
    """(B, h, w, S * C) uint8: the stack's frames along the channels, oldest first; None without camera."""
    proprioception: Float32Array
    """(B, P)"""
    previous_action: Float32Array
    """(B, A); zeros at the start of an attempt."""
    action: Float32Array
    """(B, A)"""
    chosen_action: Float32Array
    """(B, A): what the policy chose for o, whether or not it was applied; zeros where it chose nothing."""
    log_probability: Float32Array
    """(B,): log-density of the chosen action under the policy that chose it, in the normalised action space."""
    reward: Float32Array
    """(B,)"""
    terminated: Float32Array
    """(B,): 1 where the goal was reached, the only thing that cuts the bootstrap."""
    next_frames: UInt8Array | DeviceArray | None
    """(B, h, w, S * C) uint8"""
    next_proprioception: Float32Array
    """(B, P)"""

    @classmethod
    def of_rows(
        cls,
        first: npt.NDArray[np.void],
        second: npt.NDArray[np.void],
        rows: Int64Array,
        frames: UInt8Array | DeviceArray | None,
        next_frames: UInt8Array | DeviceArray | None,
    ) -> Minibatch:
        """Return the transitions between rows of the experience ring; copies all but the frames.

        Args:
            first: (B,) rows of o, structured as ``RingLayout.row_dtype``.
            second: (B,) the rows after them.
            rows: (B,) their numbers.
            frames: of o, stacked and cropped.
            next_frames: of o'.
        """
        return cls(
            rows=rows,
            frames=frames,
            proprioception=first["proprioception"].copy(),
            previous_action=first["action"].copy(),
            action=second["action"].copy(),
            chosen_action=second["chosen_action"].copy(),
            log_probability=second["log_probability"].copy(),
            reward=second["reward"].copy(),
            terminated=second["terminated"].astype(np.float32),
            next_frames=next_frames,
            next_proprioception=second["proprioception"].copy(),
        )
