"""The policy's distribution: a Gaussian squashed into [-1, 1] by tanh."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True)
class TanhGaussian:
    """Independent tanh(N(mean, std^2)) in each action dimension."""

    mean: Tensor
    """(B, A), before the tanh."""
    log_std: Tensor
    """(B, A), before the tanh."""

    @classmethod
    def from_head(cls, mean: Tensor, unbounded_log_std: Tensor, low: float, high: float) -> TanhGaussian:
        """Map the actor's second output to a log standard deviation in [low, high] by tanh."""
        return cls(mean, low + 0.5 * (high - low) * (torch.tanh(unbounded_log_std) + 1.0))

    def act(self, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Return f(noise) of eq. 3.12, actions (B, A) in [-1, 1], and their log-densities (B,).

        Args:
            noise: (B, A) from N(0, 1).
        """
        before_tanh = self.mean + self.log_std.exp() * noise
        log_gaussian = -0.5 * noise.square() - self.log_std - 0.5 * math.log(2.0 * math.pi)
        # log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2 u)): the left side is -inf in float32 from |u| = 9 on.
        log_slope = 2.0 * (math.log(2.0) - before_tanh - functional.softplus(-2.0 * before_tanh))
        return torch.tanh(before_tanh), (log_gaussian - log_slope).sum(dim=1)
