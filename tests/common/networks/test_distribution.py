"""The tanh-Gaussian: densities by hand, by integration, and where float32 is at its limits."""

from __future__ import annotations

import math

import pytest
import torch

from common.networks.distribution import LARGEST_ACTION, TanhGaussian


def distribution(mean, log_std):
    return TanhGaussian(torch.tensor([mean]), torch.tensor([log_std]))


def test_density_is_that_of_the_gaussian_divided_by_the_slope_of_tanh():
    # u = 0.2 + e^-0.5 * 0.5 = 0.50327; N(u) = exp(-0.125) / (e^-0.5 sqrt(2 pi)); slope 1 - tanh(u)^2.
    action, log_probability = distribution([0.2], [-0.5]).act(torch.tensor([[0.5]]))
    u = 0.2 + math.exp(-0.5) * 0.5
    density = math.exp(-0.125) / (math.exp(-0.5) * math.sqrt(2 * math.pi)) / (1 - math.tanh(u) ** 2)
    assert action.item() == pytest.approx(math.tanh(u), abs=1e-6)
    assert log_probability.item() == pytest.approx(math.log(density), abs=1e-6)


def test_log_densities_of_action_dimensions_add_up():
    noise = torch.tensor([[0.3, -1.2]])
    both = distribution([0.1, -0.4], [0.2, -0.3]).act(noise)[1]
    first = distribution([0.1], [0.2]).act(noise[:, :1])[1]
    second = distribution([-0.4], [-0.3]).act(noise[:, 1:])[1]
    torch.testing.assert_close(both, first + second)


def test_an_action_has_the_density_that_acting_gave_it():
    generator = torch.Generator().manual_seed(0)
    mean, log_std, noise = (torch.randn(50, 3, generator=generator, dtype=torch.float64) for _ in range(3))
    policy = TanhGaussian(mean, log_std)
    action, log_probability = policy.act(noise)
    near = (action.abs() < LARGEST_ACTION).all(dim=1)
    assert near.sum() > 30
    torch.testing.assert_close(policy.log_probability(action)[near], log_probability[near], rtol=0.0, atol=1e-8)


def test_an_action_on_its_bound_has_a_finite_density_and_gradient():
    mean = torch.zeros(1, 2, requires_grad=True)
    log_probability = TanhGaussian(mean, torch.zeros(1, 2)).log_probability(torch.tensor([[1.0, -1.0]]))
    (gradient,) = torch.autograd.grad(log_probability.sum(), mean)
    assert torch.isfinite(log_probability).all()
    assert torch.isfinite(gradient).all()


@pytest.mark.parametrize(("mean", "log_std"), [(0.0, 0.0), (0.7, -1.0), (-1.5, 0.5)])
def test_density_over_the_actions_integrates_to_one(mean, log_std):
    # Actions a = tanh(u) for a fine grid of u; trapezoids over a.
    u = torch.linspace(-20.0, 20.0, 200_001, dtype=torch.float64)
    grid = TanhGaussian(torch.full((len(u), 1), mean, dtype=torch.float64), torch.full((len(u), 1), log_std).double())
    action, log_probability = grid.act(((u - mean) / math.exp(log_std))[:, None])
    assert torch.trapezoid(log_probability.exp(), action[:, 0]).item() == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("mean", [-1e4, -30.0, 30.0, 1e4])
@pytest.mark.parametrize("log_std", [-10.0, 10.0])
def test_saturated_actions_have_finite_densities_and_gradients(mean, log_std):
    means = torch.tensor([[mean]], requires_grad=True)
    action, log_probability = TanhGaussian(means, torch.tensor([[log_std]])).act(torch.tensor([[1.0]]))
    (gradient,) = torch.autograd.grad(log_probability.sum() + action.sum(), means)
    assert torch.isfinite(log_probability).all()
    assert torch.isfinite(gradient).all()


def test_log_std_is_mapped_into_its_bounds_and_zero_to_their_middle():
    outputs = torch.tensor([[-100.0, 0.0, 100.0]])
    log_std = TanhGaussian.from_head(torch.zeros(1, 3), outputs, -10.0, 10.0).log_std
    torch.testing.assert_close(log_std, torch.tensor([[-10.0, 0.0, 10.0]]))
