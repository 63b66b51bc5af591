"""PPO computes what the plain one does: every parameter, after several rollouts."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from common.algorithms.ppo import PPO
from common.algorithms.ppo_config import PPOConfig
from tests.reference.plain_ppo import PlainPPO
from tests.reference.tasks import make_rollout, make_spec

CONFIG = PPOConfig(
    rollout_length=40,
    batch_size=16,  # of 40, so that the last of an epoch is smaller
    hidden_size=48,
    encoder_strides=(2, 2, 1, 1),
    epochs=3,
    discount=0.97,
    gae_lambda=0.9,
    entropy_coefficient=0.01,
    max_gradient_norm=0.5,
    actor_lr=3e-3,
)
SPECS = [make_spec(), make_spec((32, 36, 3))]
IDS = ["no camera", "camera"]


class Noise:
    """The same numbers for everyone who starts with the same seed."""

    def __init__(self):
        self.rng = np.random.default_rng(7)

    def __call__(self, rows, columns):
        return torch.from_numpy(self.rng.standard_normal((rows, columns)))


class Shuffle:
    """The same orders for everyone who starts with the same seed."""

    def __init__(self):
        self.rng = np.random.default_rng(8)

    def __call__(self, count):
        return torch.from_numpy(self.rng.permutation(count))


@pytest.mark.parametrize("spec", SPECS, ids=IDS)
def test_every_parameter_agrees_after_three_rollouts_in_float64(spec):
    fast = PPO(spec, CONFIG, seed=0, dtype=torch.float64, shuffle=Shuffle(), noise=Noise())
    start, rng = fast.state_dict(), np.random.default_rng(1)
    plain = PlainPPO(spec, CONFIG, start, Shuffle(), Noise(), torch.float64)
    for _ in range(3):
        rollout = make_rollout(spec, rng, CONFIG.rollout_length)
        fast.update(rollout)
        plain.update(rollout)
        assert 0.0 < fast.metrics()["clipped"] < 1.0  # both sides of the surrogate are compared
    state, named = fast.state_dict(), plain.named_parameters()
    not_parameters = ("_adam.", "random_state", "updates")
    assert set(named) == {name for name in state if not any(part in name for part in not_parameters)}
    for name, parameter in named.items():
        np.testing.assert_allclose(state[name], parameter.detach().numpy(), rtol=0.0, atol=1e-9, err_msg=name)
        assert not np.array_equal(state[name], start[name]), f"{name} did not move"
