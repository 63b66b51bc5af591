"""Actor, state value and twin critics."""

from __future__ import annotations

import numpy as np
import torch
from torch.nn import functional

from common.networks.mlp import Actor, StateValue, TwinQ


def make_critics(wide=torch.float32):
    return TwinQ(7, 32, np.random.default_rng(0), dtype=torch.float32, wide=wide)


def test_the_batched_critics_are_two_independent_perceptrons():
    critics = make_critics()
    vector, action = torch.randn(5, 4), torch.randn(5, 3)
    values = critics(vector, action)
    assert values.shape == (2, 5)
    assert not torch.allclose(values[0], values[1])
    for twin in range(2):
        x = torch.cat([vector, action], dim=1)
        for layer in range(3):
            weight, bias = getattr(critics, f"weight{layer}")[twin], getattr(critics, f"bias{layer}")[twin]
            x = functional.linear(x if layer == 0 else x.relu(), weight.T, bias[0])
        torch.testing.assert_close(values[twin], x[:, 0])


def test_initial_layers_lie_within_the_inverse_root_of_their_inputs():
    critics = make_critics()
    assert 0.9 * 7**-0.5 < critics.weight0.abs().max() <= 7**-0.5
    assert 0.9 * 32**-0.5 < critics.weight1.abs().max() <= 32**-0.5


def test_the_actor_returns_mean_and_log_std_of_its_last_layer():
    actor = Actor(4, 16, 3, dtype=torch.float32, wide=torch.float32)
    with torch.no_grad():
        actor[2].weight.zero_()
        actor[2].bias.copy_(torch.arange(6.0))
    mean, log_std = actor(torch.randn(2, 4))
    assert mean.tolist() == [[0.0, 1.0, 2.0]] * 2
    assert log_std.tolist() == [[3.0, 4.0, 5.0]] * 2


def test_the_state_value_is_one_number_for_each_observation():
    value = StateValue(4, 32, np.random.default_rng(0), dtype=torch.float32, wide=torch.float32)
    x = vector = torch.randn(5, 4)
    for i, layer in enumerate(value):
        x = functional.linear(x if i == 0 else x.relu(), layer.weight, layer.bias)
    torch.testing.assert_close(value(vector), x[:, 0])
    assert 0.9 * 32**-0.5 < value[1].weight.abs().max() <= 32**-0.5


def test_a_bfloat16_hidden_layer_changes_values_little_and_gradients_stay_float32():
    vector, action = torch.randn(64, 4), torch.randn(64, 3)
    full, half = make_critics(), make_critics(wide=torch.bfloat16)
    values = half(vector, action)
    torch.testing.assert_close(values, full(vector, action), atol=5e-3, rtol=0.0)
    gradients = torch.autograd.grad(values.sum(), list(half.parameters()))
    assert {gradient.dtype for gradient in gradients} == {torch.float32}


def test_frozen_critics_pass_the_gradient_to_the_action_and_keep_none():
    critics, vector = make_critics(), torch.randn(5, 4)
    action = torch.randn(5, 3, requires_grad=True)
    values, frozen = critics(vector, action), critics(vector, action, frozen=True)
    torch.testing.assert_close(frozen, values)
    torch.testing.assert_close(torch.autograd.grad(frozen.sum(), action), torch.autograd.grad(values.sum(), action))
    # A leaf that is reached by nothing has no gradient at all.
    reached = torch.autograd.grad(
        critics(vector, action, frozen=True).sum(), [action, *critics.parameters()], allow_unused=True
    )
    assert [gradient is not None for gradient in reached] == [True, *[False] * 6]
