"""The fast SAC computes what the plain one does: parameters, gradients, and losses in bfloat16."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from common.algorithms.sac import SAC
from common.algorithms.sac_config import SACConfig
from tests.reference.plain_sac import PlainSAC
from tests.reference.tasks import make_minibatch, make_spec

CONFIG = SACConfig(batch_size=16, hidden_size=48, encoder_strides=(2, 2, 1, 1), discount=0.97)
SPECS = [make_spec(), make_spec((32, 36, 3))]
IDS = ["no camera", "camera"]


class Noise:
    """The same numbers for everyone who starts with the same seed."""

    def __init__(self, dtype):
        self.rng, self.dtype = np.random.default_rng(7), dtype

    def __call__(self, rows, columns):
        return torch.from_numpy(self.rng.standard_normal((rows, columns))).to(self.dtype)


def arrays(named):
    return {name: parameter.detach().numpy() for name, parameter in named.items()}


@pytest.mark.parametrize("spec", SPECS, ids=IDS)
def test_every_parameter_agrees_after_five_updates_in_float64(spec):
    fast = SAC(spec, CONFIG, seed=0, dtype=torch.float64, noise=Noise(torch.float64))
    plain = PlainSAC(spec, CONFIG, fast.state_dict(), Noise(torch.float64), torch.float64)
    start, rng = fast.state_dict(), np.random.default_rng(1)
    for _ in range(5):
        minibatch = make_minibatch(spec, rng)
        fast.update(minibatch)
        plain.update(minibatch)
    pairs = plain.difference(fast.state_dict(), arrays(plain.named_parameters()))
    moved = plain.difference(start, arrays(plain.named_parameters()))
    covered = {name.split(":")[0] for name in pairs}
    not_parameters = ("_adam.", "random_state", "updates")
    assert covered == {name for name in start if not any(part in name for part in not_parameters)}
    for name, (ours, theirs) in pairs.items():
        np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-9, err_msg=name)
        assert not np.array_equal(*moved[name]), f"{name} did not move"


@pytest.mark.parametrize("spec", SPECS, ids=IDS)
def test_gradients_agree_tensor_by_tensor_in_float32(spec):
    fast = SAC(spec, CONFIG, seed=0, precision="float32", noise=Noise(torch.float32))
    # Below a zero last layer there is no gradient.
    rng, state = np.random.default_rng(1), fast.state_dict()
    state["actor.2.weight"] = rng.normal(0.0, 0.1, state["actor.2.weight"].shape)
    fast.load_state_dict(state)
    plain = PlainSAC(spec, CONFIG, state, Noise(torch.float32), torch.float32)
    minibatch = make_minibatch(spec, rng)
    fast.update(minibatch)
    plain.update(minibatch)
    modules = {"actor": fast.actor, "critic": fast.critic} | ({"encoder": fast.encoder} if fast.encoder else {})
    ours = {f"{m}.{n}": p.grad.numpy() for m, module in modules.items() for n, p in module.named_parameters()}
    for name, (mine, theirs) in plain.difference(ours, plain.gradients).items():
        assert np.linalg.norm(mine - theirs) <= 1e-4 * np.linalg.norm(theirs), name


@pytest.mark.parametrize("spec", SPECS, ids=IDS)
def test_losses_in_bfloat16_stay_within_one_percent(spec):
    config = replace(CONFIG, batch_size=64, hidden_size=128)
    losses = {}
    for precision in ("float32", "bfloat16"):
        sac, rng = SAC(spec, config, seed=0, precision=precision, noise=Noise(torch.float32)), np.random.default_rng(1)
        losses[precision] = []
        for _ in range(10):
            sac.update(make_minibatch(spec, rng, 64))
            losses[precision].append([sac.metrics()["critic_loss"], sac.metrics()["actor_loss"]])
    half, full = np.array(losses["bfloat16"]), np.array(losses["float32"])
    # Of a loss's usual size: an actor loss crosses zero.
    assert (np.abs(half - full).max(axis=0) <= 0.01 * np.abs(full).mean(axis=0)).all()
