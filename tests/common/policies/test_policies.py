"""Acting: the initial policy, the agreement of NumPy and torch, reproducibility, float16 pushes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from common.networks.distribution import TanhGaussian
from common.networks.encoder import Encoder
from common.networks.mlp import Actor
from common.policies import Observation, initial_policy, pack_weights, policy_from_weights
from common.policies.sparse_layer import SparseLayer
from common.policies.torch_policy import TorchPolicy
from common.policies.unit_range import action_range, proprioception_range
from common.policies.weights import initial_parameters
from tests.reference.tasks import make_observation, make_spec

STRIDES = (2, 2, 1, 1)
SPECS = [make_spec(), make_spec((32, 36, 3))]
IDS = ["no camera", "camera"]


def random_parameters(spec, seed=0, hidden_size=32):
    rng = np.random.default_rng(seed)
    parameters = initial_parameters(spec, hidden_size, STRIDES, rng)
    head = parameters["actor.2.weight"]
    head[:] = rng.normal(0.0, 0.1, head.shape)
    return parameters


def make_policy(spec, parameters, dtype="float32", hidden_size=32):
    weights = pack_weights(
        parameters,
        version=2,
        updates=100,
        algorithm="sac",
        hidden_size=hidden_size,
        encoder_strides=STRIDES if spec.has_camera else (),
        dtype=dtype,
    )
    return policy_from_weights(spec, weights)


def torch_action(spec, parameters, observation, noise):
    """Act with the learner's networks on the same observation."""
    tensors = {name: torch.from_numpy(values) for name, values in parameters.items()}
    own = {"dtype": torch.float32, "wide": torch.float32}
    parts = []
    if spec.has_camera:
        top, left = spec.crop_margin
        height, width = spec.frame_shape[0] - 2 * top, spec.frame_shape[1] - 2 * left
        cropped = observation.frames[:, top : top + height, left : left + width]
        stacked = np.ascontiguousarray(cropped.transpose(1, 2, 0, 3)).reshape(1, height, width, -1)
        encoder = Encoder(height, width, stacked.shape[3], STRIDES, **own)
        encoder.load_state_dict({n[8:]: t for n, t in tensors.items() if n.startswith("encoder.")})
        parts.append(encoder(torch.from_numpy(stacked)))
    parts.append(torch.from_numpy(proprioception_range(spec).to_unit(observation.proprioception))[None])
    parts.append(torch.from_numpy(action_range(spec).to_unit(observation.previous_action))[None])
    vector = torch.cat(parts, dim=1)
    actor = Actor(vector.shape[1], len(parameters["actor.0.bias"]), len(spec.action_low), **own)
    actor.load_state_dict({n[6:]: t for n, t in tensors.items() if n.startswith("actor.")})
    distribution = TanhGaussian.from_head(*actor(vector), -10.0, 10.0)
    action, log_probability = distribution.act(torch.from_numpy(noise)[None])
    return action_range(spec).to_physical(action[0].detach().numpy()), log_probability.item()


@pytest.mark.parametrize("spec", SPECS, ids=IDS)
def test_a_policy_acts_as_the_learners_networks_do(spec):
    parameters, rng = random_parameters(spec), np.random.default_rng(3)
    policy = make_policy(spec, parameters)
    assert policy.version == 2
    for seed in range(5):
        observation = make_observation(spec, rng)
        noise = np.random.default_rng(seed).standard_normal(2, np.float32)
        chosen = policy.act(observation, np.random.default_rng(seed))
        action, log_probability = torch_action(spec, parameters, observation, noise)
        assert chosen.action.dtype == np.float32
        np.testing.assert_allclose(chosen.action, action, atol=1e-5)
        assert chosen.log_probability == pytest.approx(log_probability, abs=1e-4)


# Without camera 512 and 1024 skip units that are zero; 520 does not, nor do those with camera.
@pytest.mark.parametrize("hidden_size", [512, 520, 1024])
@pytest.mark.parametrize("spec", SPECS, ids=IDS)
@pytest.mark.parametrize("dtype", ["float32", "float16"])
def test_a_wide_policy_acts_as_the_learners_networks_do(spec, hidden_size, dtype):
    parameters, rng = random_parameters(spec, hidden_size=hidden_size), np.random.default_rng(3)
    parameters = {name: values.astype(dtype).astype(np.float32) for name, values in parameters.items()}
    policy = make_policy(spec, parameters, dtype, hidden_size)
    for _ in range(5):
        observation = make_observation(spec, rng)
        chosen = policy.act(observation, rng, deterministic=True)
        action, log_probability = torch_action(spec, parameters, observation, np.zeros(2, np.float32))
        np.testing.assert_allclose(chosen.action, action, atol=1e-5)
        assert chosen.log_probability == pytest.approx(log_probability, abs=1e-4)


@pytest.mark.parametrize("hidden_size", [512, 1024])
def test_a_wide_policy_without_camera_skips_units_that_are_zero(monkeypatch, hidden_size):
    fetched = []

    def noted(layer, inputs):
        fetched.append(inputs)
        return product(layer, inputs)

    product = SparseLayer.__call__
    monkeypatch.setattr(SparseLayer, "__call__", noted)
    for spec, expected in zip(SPECS, (1, 0), strict=True):
        fetched.clear()
        policy = make_policy(spec, random_parameters(spec, hidden_size=hidden_size), hidden_size=hidden_size)
        policy.act(make_observation(spec, np.random.default_rng(0)), np.random.default_rng(0))
        assert len(fetched) == expected
        for inputs in fetched:
            assert 0.2 < (inputs == 0.0).mean() < 0.8


@pytest.mark.parametrize("spec", SPECS, ids=IDS)
def test_the_initial_policy_is_standard_normal_before_the_tanh_for_any_observation(spec):
    policy, rng = initial_policy(spec, 32, STRIDES, seed=5), np.random.default_rng(0)
    assert policy.version == 0
    for seed in range(3):
        chosen = policy.act(make_observation(spec, rng), np.random.default_rng(seed))
        noise = np.random.default_rng(seed).standard_normal(2, np.float32)
        np.testing.assert_allclose(action_range(spec).to_unit(chosen.action), np.tanh(noise), atol=1e-6)
        density = np.exp(-(noise**2) / 2) / math.sqrt(2 * math.pi) / (1 - np.tanh(noise) ** 2)
        assert chosen.log_probability == pytest.approx(float(np.log(density).sum()), abs=1e-4)


@pytest.mark.parametrize("spec", SPECS, ids=IDS)
def test_the_deterministic_action_is_the_centre_and_draws_nothing(spec):
    policy = make_policy(spec, random_parameters(spec))
    observation, rng = make_observation(spec, np.random.default_rng(0)), np.random.default_rng(1)
    first = policy.act(observation, rng, deterministic=True)
    again = policy.act(observation, rng, deterministic=True)
    np.testing.assert_array_equal(first.action, again.action)
    assert rng.bit_generator.state == np.random.default_rng(1).bit_generator.state


@pytest.mark.parametrize("spec", SPECS, ids=IDS)
def test_equal_generators_give_equal_actions(spec):
    policy, observation = make_policy(spec, random_parameters(spec)), make_observation(spec, np.random.default_rng(0))
    actions = [policy.act(observation, np.random.default_rng(9)).action for _ in range(2)]
    np.testing.assert_array_equal(*actions)


@pytest.mark.parametrize("spec", SPECS, ids=IDS)
def test_a_float16_push_changes_actions_by_less_than_a_thousandth_of_their_range(spec):
    parameters, rng = random_parameters(spec, hidden_size=256), np.random.default_rng(2)
    full = make_policy(spec, parameters, hidden_size=256)
    half = make_policy(spec, parameters, "float16", hidden_size=256)
    for _ in range(20):
        observation = make_observation(spec, rng)
        actions = [policy.act(observation, rng, deterministic=True).action for policy in (full, half)]
        units = [action_range(spec).to_unit(action) for action in actions]
        assert np.abs(units[0] - units[1]).max() <= 1e-3


def test_only_the_central_crop_is_seen():
    spec = make_spec((32, 36, 3), crop_margin=(2, 3))
    policy, rng = make_policy(spec, random_parameters(spec)), np.random.default_rng(0)
    assert isinstance(policy, TorchPolicy)
    frames = make_observation(spec, rng).frames
    border = frames.copy()
    border[:, :2], border[:, -2:], border[:, :, :3], border[:, :, -3:] = 0, 255, 7, 9
    np.testing.assert_array_equal(policy.features(frames), policy.features(border))
    inside = frames.copy()
    inside[:, 2, 3] ^= 255
    assert not np.array_equal(policy.features(frames), policy.features(inside))


def test_bounds_map_to_one_and_values_outside_are_not_clipped():
    spec = make_spec()  # first action dimension -2..1, first proprioception -3..2
    assert action_range(spec).to_unit(np.array([-2.0, 4.0], np.float32)).tolist() == [-1.0, 1.0]
    assert action_range(spec).to_physical(np.array([1.0, -1.0], np.float32)).tolist() == [1.0, -1.0]
    values = proprioception_range(spec).to_unit(np.array([4.5, 0.0, 0.0], np.float32))
    assert values[0] == pytest.approx(2.0)


def test_a_zero_previous_action_is_mapped_like_any_other():
    spec = make_spec()
    parameters = random_parameters(spec)
    policy = make_policy(spec, parameters)
    zeros = Observation(None, np.zeros(3, np.float32), np.zeros(2, np.float32))
    noise = np.zeros(2, np.float32)
    expected, _ = torch_action(spec, parameters, zeros, noise)
    chosen = policy.act(zeros, np.random.default_rng(0), deterministic=True)
    np.testing.assert_allclose(chosen.action, expected, atol=1e-6)
