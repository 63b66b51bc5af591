"""The device that updates run on: is it there, and what do its numbers mean."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from common.errors import ConfigError, ServiceError

logger = logging.getLogger(__name__)


def open_device(name: str) -> torch.device:
    """Return the device called ``name``, ready to compute.

    Raises:
        ConfigError: there is no such device, or torch cannot use it.
    """
    device = torch.device(name)
    if device.type == "cpu":
        return device
    try:
        # The first kernel takes all there is: a driver, a GPU of this number, and code for its architecture.
        torch.zeros((), device=device).item()
    except (RuntimeError, AssertionError) as error:  # the latter from a torch that was built without CUDA
        reason = str(error).strip().partition("\n")[0].rstrip(".")
        raise ConfigError(
            f"learner.device = {name!r}: expected a GPU that torch can use, it sees {torch.cuda.device_count()}; "
            f"{reason}. Does nvidia-smi list the GPU? `--set learner.device=cpu` learns without one"
        ) from error
    # By default torch lets convolutions round float32 to TF32's 10 bits, and products not. Where that precision is
    # enough, bfloat16 is too, and is faster: float32 means float32, as on the CPU.
    torch.backends.cudnn.conv.fp32_precision = "ieee"
    torch.backends.cuda.matmul.fp32_precision = "ieee"
    properties = torch.cuda.get_device_properties(device)
    logger.info("updates run on %s: %s, %.1f GB", device, properties.name, properties.total_memory / 1e9)
    return device


@contextmanager
def too_little_memory_explained(device: torch.device) -> Iterator[None]:
    """Turn a GPU's lack of memory into a :class:`ServiceError` that says what needs less."""
    try:
        yield
    except torch.OutOfMemoryError as error:
        raise ServiceError(
            f"{device} has too little memory for the updates: {error}. What needs less: `--set learner.frames=host`, "
            "a smaller algorithm.batch_size, or no other program on this GPU"
        ) from error
