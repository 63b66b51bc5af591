"""The networks after the encoder: two hidden layers with ReLU (thesis 4.2.2)."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from common.networks.product import batched_linear, linear


class Perceptron(nn.ModuleList):
    """Three layers with ReLU between.

    Parameters are named ``0.weight`` (H, inputs), ``0.bias`` ... ``2.bias``.
    """

    def __init__(self, inputs: int, hidden_size: int, outputs: int, *, dtype: torch.dtype, wide: torch.dtype) -> None:
        """Create layers with parameters in ``dtype``, of which the hidden-to-hidden one computes in ``wide``."""
        super().__init__(
            [
                nn.Linear(inputs, hidden_size, dtype=dtype),
                nn.Linear(hidden_size, hidden_size, dtype=dtype),
                nn.Linear(hidden_size, outputs, dtype=dtype),
            ]
        )
        self._wide = wide

    def outputs(self, vector: Tensor) -> Tensor:
        """(B, inputs) -> (B, outputs)."""
        first, hidden, last = self
        assert isinstance(hidden, nn.Linear)
        x = functional.relu_(first(vector)).to(self._wide)
        x = functional.relu_(linear(x, hidden.weight.to(self._wide), hidden.bias.to(self._wide)))
        outputs: Tensor = last(x.to(vector.dtype))
        return outputs


class Actor(Perceptron):
    """Observation vector -> mean and unbounded log standard deviation; parameters as of :class:`Perceptron`."""

    def __init__(
        self, inputs: int, hidden_size: int, action_size: int, *, dtype: torch.dtype, wide: torch.dtype
    ) -> None:
        """Create an actor; see :class:`Perceptron`."""
        super().__init__(inputs, hidden_size, 2 * action_size, dtype=dtype, wide=wide)

    def forward(self, vector: Tensor) -> tuple[Tensor, Tensor]:
        """(B, inputs) -> two of (B, A)."""
        mean, log_std = self.outputs(vector).chunk(2, dim=1)
        return mean, log_std


class StateValue(Perceptron):
    """Observation vector -> value v of the state; parameters as of :class:`Perceptron`."""

    def __init__(
        self, inputs: int, hidden_size: int, rng: np.random.Generator, *, dtype: torch.dtype, wide: torch.dtype
    ) -> None:
        """Create a critic with random weights from ``rng`` and zero biases; see :class:`Perceptron`."""
        super().__init__(inputs, hidden_size, 1, dtype=dtype, wide=wide)
        with torch.no_grad():
            for layer in self:
                assert isinstance(layer, nn.Linear)
                bound = 1.0 / math.sqrt(layer.in_features)
                layer.weight.copy_(torch.from_numpy(rng.uniform(-bound, bound, tuple(layer.weight.shape))))
                layer.bias.zero_()

    def forward(self, vector: Tensor) -> Tensor:
        """(B, inputs) -> (B,)."""
        return self.outputs(vector).squeeze(1)


class TwinQ(nn.Module):
    """Two critics q_1, q_2 as one batched product per layer: (observation vector, action) -> action values."""

    def __init__(
        self,
        inputs: int,
        hidden_size: int,
        rng: np.random.Generator,
        *,
        dtype: torch.dtype,
        wide: torch.dtype,
    ) -> None:
        """Create two critics with independent random layers.

        Args:
            inputs: sizes of observation vector and action together.
            hidden_size: width of each critic's hidden layers.
            rng: source of the initial parameters.
            dtype: number format of the parameters.
            wide: number format in which the hidden-to-hidden layers compute.
        """
        super().__init__()
        self._wide = wide

        def layer(n_in: int, n_out: int) -> tuple[nn.Parameter, nn.Parameter]:
            bound = 1.0 / math.sqrt(n_in)
            weight = torch.from_numpy(rng.uniform(-bound, bound, (2, n_in, n_out))).to(dtype)
            return nn.Parameter(weight), nn.Parameter(torch.zeros(2, 1, n_out, dtype=dtype))

        self.weight0, self.bias0 = layer(inputs, hidden_size)
        self.weight1, self.bias1 = layer(hidden_size, hidden_size)
        self.weight2, self.bias2 = layer(hidden_size, 1)

    def forward(self, vector: Tensor, action: Tensor, *, frozen: bool = False) -> Tensor:
        """(B, vector), (B, A) -> (2, B); if ``frozen``, the gradient reaches the arguments, not the parameters."""
        parameters = (self.weight0, self.bias0, self.weight1, self.bias1, self.weight2, self.bias2)
        weight0, bias0, weight1, bias1, weight2, bias2 = (p.detach() if frozen else p for p in parameters)
        inputs = torch.cat([vector, action], dim=1).expand(2, -1, -1)
        x = functional.relu_(torch.baddbmm(bias0, inputs, weight0)).to(self._wide)
        x = functional.relu_(batched_linear(x, weight1.to(self._wide), bias1.to(self._wide))).to(vector.dtype)
        return torch.baddbmm(bias2, x, weight2).squeeze(2)
