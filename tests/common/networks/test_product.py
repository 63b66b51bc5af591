"""Products of the wide layers: the same numbers and gradients whichever kernel computes them."""

from __future__ import annotations

import pytest
import torch

from common.networks import product
from common.networks.product import batched_linear, linear

BATCH, INPUTS, OUTPUTS = 7, 40, 24


@pytest.fixture(params=["onednn", "torch"])
def kernel(request, monkeypatch):
    """Compute by oneDNN where this computer has it, or by what torch takes."""
    if request.param == "onednn" and not product._has_onednn():
        pytest.skip("oneDNN is for x86")
    monkeypatch.setattr(product, "_has_onednn", lambda: request.param == "onednn")
    return request.param


def random(*shape, dtype=torch.float32):
    generator = torch.Generator().manual_seed(sum(shape))
    return torch.randn(*shape, generator=generator, dtype=dtype).requires_grad_()


def gradients(result, *leaves):
    weights = torch.arange(result.numel(), dtype=result.dtype).view_as(result).cos()
    return torch.autograd.grad((result * weights).sum(), leaves)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16], ids=str)
def test_a_linear_layer_and_its_gradients_are_those_of_torch(kernel, dtype):
    leaves = random(BATCH, INPUTS, dtype=dtype), random(OUTPUTS, INPUTS, dtype=dtype), random(OUTPUTS, dtype=dtype)
    ours, theirs = linear(*leaves), torch.nn.functional.linear(*leaves)
    torch.testing.assert_close(ours, theirs)
    for mine, other in zip(gradients(ours, *leaves), gradients(theirs, *leaves), strict=True):
        torch.testing.assert_close(mine, other)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16], ids=str)
def test_layers_side_by_side_are_those_of_torch(kernel, dtype):
    x, weight = random(2, BATCH, INPUTS, dtype=dtype), random(2, INPUTS, OUTPUTS, dtype=dtype)
    leaves = x, weight, random(2, 1, OUTPUTS, dtype=dtype)
    ours, theirs = batched_linear(*leaves), torch.baddbmm(leaves[2], x, weight)
    torch.testing.assert_close(ours, theirs)
    for mine, other in zip(gradients(ours, *leaves), gradients(theirs, *leaves), strict=True):
        torch.testing.assert_close(mine, other)


def test_a_gradient_has_the_layout_of_its_parameter(kernel):
    x, weight, bias = random(BATCH, INPUTS), random(OUTPUTS, INPUTS), random(OUTPUTS)
    (gradient,) = gradients(linear(x, weight, bias), weight)
    assert gradient.stride() == weight.stride()
    x, weight, bias = random(2, BATCH, INPUTS), random(2, INPUTS, OUTPUTS), random(2, 1, OUTPUTS)
    (gradient,) = gradients(batched_linear(x, weight, bias), weight)
    assert gradient.stride() == weight.stride()


def test_only_the_gradients_that_are_wanted_are_computed(kernel, monkeypatch):
    x, weight, bias = random(BATCH, INPUTS), random(OUTPUTS, INPUTS), random(OUTPUTS)
    frozen = linear(x, weight.detach(), bias.detach())
    torch.testing.assert_close(gradients(frozen, x), gradients(linear(x, weight, bias), x))
    constant = linear(x.detach(), weight, bias)
    torch.testing.assert_close(gradients(constant, weight), gradients(linear(x, weight, bias), weight))
