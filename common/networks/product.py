"""The wide layers' matrix products, by the fastest kernel that torch ships.

In bfloat16 that is what torch takes by itself. In float32 torch takes MKL, which on processors of other makers than
Intel does without their widest instructions; oneDNN, which torch has for its convolutions, uses them: twice as fast
on an AMD Zen 5, with the same float32 arithmetic.
"""

from __future__ import annotations

import platform
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional


def linear(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """(B, K), (N, K), (N,) -> x weight^T + bias, (B, N)."""
    if not _is_for_onednn(x, weight):
        return functional.linear(x, weight, bias)
    return _onednn_products(x[None], weight.T[None])[0] + bias


def batched_linear(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """(n, B, K), (n, K, N), (n, 1, N) -> x weight + bias, (n, B, N): n layers side by side."""
    if not _is_for_onednn(x, weight):
        return torch.baddbmm(bias, x, weight)
    return _onednn_products(x, weight) + bias


class _OneDnnProducts(torch.autograd.Function):
    """(n, B, K), (n, K, N) -> (n, B, N)."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor) -> Tensor:
        ctx.save_for_backward(x, weight)
        return _multiplied(x, weight)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None]:
        (gradient,), (x, weight) = gradients, ctx.saved_tensors
        wants_x, wants_weight = ctx.needs_input_grad
        to_x = _multiplied(gradient, weight.mT) if wants_x else None
        to_weight = None
        if wants_weight:
            # In the layout of the parameter, which may be the transposed one: an optimiser wants both alike.
            in_order = weight.is_contiguous()
            to_weight = _multiplied(x.mT, gradient) if in_order else _multiplied(gradient.mT, x).mT
        return to_x, to_weight


def _onednn_products(x: Tensor, weight: Tensor) -> Tensor:
    result: Tensor = _OneDnnProducts.apply(x, weight)
    return result


def _multiplied(a: Tensor, b: Tensor) -> Tensor:
    # torch.compile's operator for a linear layer on the CPU; torch.nn.functional has none for ordinary tensors.
    operator = torch.ops.mkldnn._linear_pointwise
    results = [operator(one, other.mT, None, "none", [], "") for one, other in zip(a, b, strict=True)]
    return results[0][None] if len(results) == 1 else torch.stack(results)


def _is_for_onednn(x: Tensor, weight: Tensor) -> bool:
    return x.dtype == weight.dtype == torch.float32 and x.device.type == "cpu" and _has_onednn()


@cache
def _has_onednn() -> bool:
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return False
    built_in: bool = torch.backends.mkldnn.is_available()  # type: ignore[no-untyped-call]
    return built_in and hasattr(torch.ops.mkldnn, "_linear_pointwise")
