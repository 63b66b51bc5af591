"""From camera frames to the positions of what the convolutions look for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from common.messages import Float32Array
from common.networks.sizes import CHANNELS, KERNEL, map_size


class Encoder(nn.ModuleList):
    """Four 3x3 convolutions with ReLU between, then a spatial softmax (thesis 4.2.1).

    Parameters are named ``0.weight``, ``0.bias``, ``1.weight`` ... The last convolution has no bias: the softmax is
    blind to it, so its gradient would be nothing but rounding noise, which Adam scales up.
    """

    positions: Tensor

    def __init__(
        self,
        height: int,
        width: int,
        channels: int,
        strides: Sequence[int],
        *,
        dtype: torch.dtype,
        wide: torch.dtype,
    ) -> None:
        """Create an encoder.

        Args:
            height, width: size of the frames after the crop.
            channels: frames stacked times channels of a frame.
            strides: one per convolution.
            dtype: number format of parameters and features.
            wide: number format of the convolutions.
        """
        last = len(strides) - 1
        super().__init__(
            nn.Conv2d(channels if i == 0 else CHANNELS, CHANNELS, KERNEL, stride, bias=i < last, dtype=dtype)
            for i, stride in enumerate(strides)
        )
        self._wide = wide
        positions = map_positions(*map_size(height, width, strides)).to(dtype)
        self.register_buffer("positions", positions, persistent=False)

    def forward(self, frames: Tensor) -> Tensor:
        """(B, h, w, S * C) uint8 -> (B, 64) in [-1, 1]."""
        layers = []
        for i, convolution in enumerate(self):
            assert isinstance(convolution, nn.Conv2d)
            kernel = for_bytes(convolution.weight) if i == 0 else convolution.weight
            bias = None if convolution.bias is None else convolution.bias.to(self._wide)
            layers.append((kernel.to(self._wide), bias, convolution.stride[0]))
        return encode_frames(frames, layers, self.positions)


Kernel = TypeVar("Kernel", Tensor, Float32Array)
Layer = tuple[Tensor, Tensor | None, int]
"""Kernel, bias and stride of a convolution."""


def for_bytes(kernel: Kernel) -> Kernel:
    """Return the first kernel for pixels from 0 to 255; the trained one expects them from 0 to 1.

    Dividing the kernel is cheaper than dividing the images, and 0..255 is exact in bfloat16.
    """
    return kernel / 255.0


def encode_frames(frames: Tensor, layers: Sequence[Layer], positions: Tensor) -> Tensor:
    """Return what :class:`Encoder` does, for its convolutions in the number format to compute in.

    Args:
        frames: (B, h, w, S * C) uint8.
        layers: the convolutions, the first :func:`for_bytes`.
        positions: see :func:`map_positions`; the features have its number format.
    """
    # NHWC bytes seen as NCHW are what torch calls channels_last, the layout its convolutions are fastest in.
    maps = frames.permute(0, 3, 1, 2).to(layers[0][0].dtype)
    for i, (kernel, bias, stride) in enumerate(layers):
        maps = functional.conv2d(maps, kernel, bias, stride)
        if i < len(layers) - 1:
            maps = functional.relu_(maps)
    return spatial_softmax(maps.to(positions.dtype), positions)


def map_positions(rows: int, columns: int) -> Tensor:
    """Return (rows * columns, 2): x and y of each element of a map, from -1 (left, top) to +1."""

    def axis(n: int) -> Tensor:
        return torch.linspace(-1.0, 1.0, n, dtype=torch.float64) if n > 1 else torch.zeros(1, dtype=torch.float64)

    y, x = torch.meshgrid(axis(rows), axis(columns), indexing="ij")
    return torch.stack([x.flatten(), y.flatten()], dim=1)


def spatial_softmax(maps: Tensor, positions: Tensor) -> Tensor:
    """Return the expected position of each map's softmax (thesis 4.2.1): x0, y0, x1, y1 ...

    Args:
        maps: (B, channels, rows, columns).
        positions: (rows * columns, 2), see :func:`map_positions`.

    Returns:
        (B, 2 * channels).
    """
    # (B, rows * columns, channels): for channels_last maps a view.
    activations = maps.permute(0, 2, 3, 1).flatten(1, 2)
    probabilities = torch.softmax(activations, dim=1)
    return (probabilities.transpose(1, 2) @ positions).flatten(1)
