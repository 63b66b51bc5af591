"""In which number format the expensive layers compute."""

from __future__ import annotations

from typing import Literal

import torch

from common.cpu_tuning import has_bfloat16

Precision = Literal["float32", "bfloat16", "auto"]


def wide_dtype(precision: Precision, device: torch.device, dtype: torch.dtype) -> torch.dtype:
    """Return the format of the convolutions and of the hidden-to-hidden layers.

    Only they are worth bfloat16. Parameters, first and last layers, softmax, distribution, losses and targets stay
    in ``dtype``, which keeps the losses within 1 % of those without bfloat16.

    Args:
        precision: ``float32`` leaves everything in ``dtype``; ``auto`` takes bfloat16 where the processor or GPU
            multiplies in it and ``dtype`` is float32.
        device: where the networks compute.
        dtype: format of the parameters.
    """
    if precision == "bfloat16":
        return torch.bfloat16
    if precision == "auto" and dtype == torch.float32:
        # From Ampere on; torch would say that older GPUs can too, because it converts there and back.
        has = torch.cuda.get_device_capability(device)[0] >= 8 if device.type == "cuda" else has_bfloat16()
        return torch.bfloat16 if has else dtype
    return dtype
