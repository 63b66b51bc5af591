"""Acting from camera frames: the encoder in torch, the actor after it in NumPy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from common.messages import Float32Array, TaskSpec, UInt8Array
from common.networks.encoder import Encoder
from common.networks.sizes import cropped_shape
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
        self._height, self._width, channels = cropped_shape(spec)
        self._top, self._left = (int(n) for n in spec.crop_margin)
        # Not in bfloat16: for a single observation converting the kernels costs more than it saves.
        dtype = torch.float32
        self._encoder = Encoder(self._height, self._width, channels, encoder_strides, dtype=dtype, wide=dtype)
        self._encoder.load_state_dict(
            {
                name.removeprefix("encoder."): torch.from_numpy(values)
                for name, values in parameters.items()
                if name.startswith("encoder.")
            }
        )
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
            features: Float32Array = self._encoder(torch.from_numpy(stacked)[None])[0].numpy()
        return features
