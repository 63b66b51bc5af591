"""Acting from camera frames: the encoder in torch, the actor after it in NumPy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np
import torch
from torch import Tensor

from common.messages import Float32Array, TaskSpec, UInt8Array
from common.networks.encoder import Layer, encode_frames, for_bytes, map_positions
from common.networks.sizes import cropped_shape, map_size
from common.policies.base import ChosenAction, Observation
from common.policies.numpy_policy import NumpyActor


class TorchPolicy:
    """Policy of a task with camera; acts on the central crop (thesis 3.6)."""

    def __init__(
        self,
        spec: TaskSpec,
        parameters: Mapping[str, Float32Array],
        version: int,
        encoder_strides: Sequence[int],
    ) -> None:
        """Take over ``parameters``, named and shaped as in :mod:`common.policies.weights`."""
        self.version = version
        self._height, self._width, _ = cropped_shape(spec)
        self._top, self._left = spec.crop_margin.tolist()
        # Not in bfloat16: for a single observation converting the images costs more than it saves.
        self._layers = _layers(parameters, encoder_strides)
        self._positions = _positions(self._height, self._width, tuple(encoder_strides))
        self._actor = NumpyActor(spec, parameters)

    def act(self, observation: Observation, rng: np.random.Generator, deterministic: bool = False) -> ChosenAction:
        """See :class:`common.policies.base.Policy`."""
        assert observation.frames is not None
        return self._actor.act(self.features(observation.frames), observation, rng, deterministic)

    def features(self, frames: UInt8Array) -> Float32Array:
        """(S, H, W, C) -> (64,)."""
        rows = slice(self._top, self._top + self._height)
        columns = slice(self._left, self._left + self._width)
        # (h, w, S * C), the channels in the order of the minibatch's. One channel at a time: three times as fast as
        # a concatenation, which copies C bytes at a time.
        stacked = np.empty((self._height, self._width, frames.shape[0] * frames.shape[3]), np.uint8)
        for s, frame in enumerate(frames[:, rows, columns]):
            for c in range(frames.shape[3]):
                stacked[..., s * frames.shape[3] + c] = frame[..., c]
        with torch.inference_mode():
            features = encode_frames(torch.from_numpy(stacked)[None], self._layers, self._positions)
        array: Float32Array = features[0].numpy()
        return array


def _layers(parameters: Mapping[str, Float32Array], strides: Sequence[int]) -> list[Layer]:
    layers: list[Layer] = []
    for i, stride in enumerate(strides):
        kernel, bias = parameters[f"encoder.{i}.weight"], parameters.get(f"encoder.{i}.bias")
        # Copies, because what came is read-only.
        kernel = for_bytes(kernel) if i == 0 else kernel.copy()
        layers.append((torch.from_numpy(kernel), None if bias is None else torch.from_numpy(bias.copy()), stride))
    return layers


@cache
def _positions(height: int, width: int, strides: tuple[int, ...]) -> Tensor:
    return map_positions(*map_size(height, width, strides)).to(torch.float32)
