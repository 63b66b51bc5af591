"""From numpy to the device that networks compute on, without waiting for what it has still to do."""

from __future__ import annotations

from typing import Any

import numpy.typing as npt
import torch
from torch import Tensor


def upload(array: npt.NDArray[Any], device: torch.device) -> Tensor:
    """Return ``array`` as a tensor on ``device``; on the CPU the two share their memory where the array is writable."""
    # torch refuses to promise that it will not write to a read-only array, and warns.
    tensor = torch.from_numpy(array if array.flags.writeable else array.copy())
    if device.type == "cuda":
        # A copy from any other memory makes this thread wait until the GPU has done all that it was given before.
        # torch keeps the pinned memory until the copy has been made.
        tensor = tensor.pin_memory()
    return tensor.to(device, non_blocking=True)
