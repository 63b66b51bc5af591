"""Adam over named parameters, fused, with a state that goes into a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn


class Adam:
    """torch's fused Adam, which minimises one loss over some of its leaves."""

    def __init__(
        self,
        parameters: Mapping[str, nn.Parameter],
        lr: float,
        betas: tuple[float, float],
        max_gradient_norm: float | None = None,
    ) -> None:
        """Create an optimiser of ``parameters`` (name -> parameter).

        Args:
            parameters: what it optimises.
            lr: step size.
            betas: decay rates of the moments.
            max_gradient_norm: all gradients together are scaled down to this length; None: never.
        """
        self._max_gradient_norm = max_gradient_norm
        self._parameters = dict(parameters)
        self._leaves = list(self._parameters.values())
        self._adam = torch.optim.Adam(self._leaves, lr=lr, betas=betas, fused=True)
        # What Adam would create in its first step, created now so that a checkpoint always has the same names.
        for leaf in self._leaves:
            self._adam.state[leaf] = {
                "step": torch.zeros((), dtype=torch.float32, device=leaf.device),
                "exp_avg": torch.zeros_like(leaf),
                "exp_avg_sq": torch.zeros_like(leaf),
            }

    def minimise(self, loss: Tensor) -> None:
        """Take one step down the gradient of ``loss``, a scalar.

        Only the gradients of this optimiser's parameters are computed: the actor loss costs none of the critics'.
        """
        for leaf, gradient in zip(self._leaves, torch.autograd.grad(loss, self._leaves), strict=True):
            # The fused kernel walks parameter and gradient in memory order and ignores strides. Gradients of
            # batched products and of channels_last convolutions come in another order than their parameters.
            same_order = gradient.stride() == leaf.stride()
            leaf.grad = gradient if same_order else torch.empty_like(leaf).copy_(gradient)
        if self._max_gradient_norm is not None:
            nn.utils.clip_grad_norm_(self._leaves, self._max_gradient_norm)
        self._adam.step()

    def state(self) -> dict[str, Tensor]:
        """Return moments and step counts by name; not copies."""
        return {
            f"{kind}.{name}": value
            for name, leaf in self._parameters.items()
            for kind, value in self._adam.state[leaf].items()
        }
