"""The fused Adam steps like the plain one, whatever order the gradient's numbers come in."""

from __future__ import annotations

import torch
from torch import nn

from common.algorithms.adam import Adam

INPUTS = torch.randn(2, 5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def loss_of(weight):
    """Return a loss whose gradient comes as a transposed view: its strides are not those of the weight."""
    return torch.bmm(INPUTS, weight.transpose(1, 2)).square().sum()


def test_steps_equal_the_plain_optimisers_for_gradients_of_other_strides():
    start = torch.randn(2, 4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    fused, plain = nn.Parameter(start.clone()), nn.Parameter(start.clone())
    (gradient,) = torch.autograd.grad(loss_of(fused), fused)
    assert gradient.stride() != fused.stride()
    ours = Adam({"w": fused}, 1e-2, (0.5, 0.9))
    reference = torch.optim.Adam([plain], 1e-2, (0.5, 0.9), foreach=False)
    for _ in range(10):
        ours.minimise(loss_of(fused))
        reference.zero_grad()
        loss_of(plain).backward()
        reference.step()
    torch.testing.assert_close(fused, plain, rtol=0.0, atol=1e-12)


def test_gradients_are_scaled_down_together_to_the_longest_allowed():
    long, short = nn.Parameter(torch.tensor([3.0, 0.0])), nn.Parameter(torch.tensor([4.0]))
    adam = Adam({"long": long, "short": short}, 1e-2, (0.9, 0.999), max_gradient_norm=1.0)
    adam.minimise(0.5 * (long.square().sum() + short.square().sum()))  # the gradient is (3, 0; 4), of length 5
    torch.testing.assert_close(long.grad, torch.tensor([0.6, 0.0]), rtol=0.0, atol=1e-5)
    torch.testing.assert_close(short.grad, torch.tensor([0.8]), rtol=0.0, atol=1e-5)
    adam.minimise(0.01 * long.sum() + 0.0 * short.sum())
    torch.testing.assert_close(long.grad, torch.tensor([0.01, 0.01]))  # shorter ones are left alone


def test_only_its_own_parameters_get_gradients():
    mine, other = nn.Parameter(torch.ones(2)), nn.Parameter(torch.ones(2))
    Adam({"mine": mine}, 1e-2, (0.9, 0.999)).minimise((mine * other).sum())
    assert mine.grad is not None
    assert other.grad is None


def test_the_state_has_all_its_names_before_the_first_step():
    adam = Adam({"w": nn.Parameter(torch.ones(2))}, 1e-2, (0.9, 0.999))
    before = set(adam.state())
    assert before == {"step.w", "exp_avg.w", "exp_avg_sq.w"}
    adam.minimise(next(iter(adam._parameters.values())).sum())
    assert set(adam.state()) == before
