"""The policy's distribution: a Gaussian squashed into [-1, 1] by tanh."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

LARGEST_ACTION = 1.0 - 1e-6
"""What was before the tanh of a float32 beyond this has been lost to rounding."""


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
        return torch.tanh(before_tanh), self._log_density(before_tanh, noise)

    def log_probability(self, action: Tensor) -> Tensor:
        """Return the log-densities (B,) of actions (B, A) in [-1, 1], as far from +-1 as :data:`LARGEST_ACTION`."""
        before_tanh = torch.atanh(action.clamp(-LARGEST_ACTION, LARGEST_ACTION))
        return self._log_density(before_tanh, (before_tanh - self.mean) * torch.exp(-self.log_std))

    def _log_density(self, before_tanh: Tensor, noise: Tensor) -> Tensor:
        log_gaussian = -0.5 * noise.square() - self.log_std - 0.5 * math.log(2.0 * math.pi)
        # log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2 u)): the left side is -inf in float32 from |u| = 9 on.
        log_slope = 2.0 * (math.log(2.0) - before_tanh - functional.softplus(-2.0 * before_tanh))
        return (log_gaussian - log_slope).sum(dim=1)
