"""What Proximal Policy Optimization promises, property by property."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from common.algorithms.ppo import PPO
from common.algorithms.ppo_config import PPOConfig
from common.policies import Observation, initial_policy, policy_from_weights
from tests.reference.tasks import make_minibatch, make_observation, make_rollout, make_spec

CONFIG = PPOConfig(rollout_length=40, batch_size=16, hidden_size=16, encoder_strides=(2, 2, 1, 1))
SPEC = make_spec()
VISUAL = make_spec((32, 36, 3))


def acted_out(policy, spec, rollout, frames, rng):
    """Return the rollout with the actions that ``policy`` chooses on its observations."""
    chosen = [
        policy.act(
            Observation(frames[i] if spec.has_camera else None, rollout.proprioception[i], rollout.previous_action[i]),
            rng,
        )
        for i in range(len(rollout.reward))
    ]
    return replace(
        rollout,
        chosen_action=np.stack([c.action for c in chosen]),
        log_probability=np.array([c.log_probability for c in chosen], np.float32),
    )


def prepared(ppo, minibatch):
    """Return the rollout as an update begins with it."""
    slices = ppo._rollout(minibatch)
    while True:
        try:
            next(slices)
        except StopIteration as end:
            return end.value[0]


def parameters(ppo, network):
    return {name: value for name, value in ppo.state_dict().items() if name.startswith(f"{network}.")}


def assert_equal(one, other):
    for name, value in one.items():
        np.testing.assert_array_equal(value, other[name], err_msg=name)


@pytest.mark.parametrize("spec", [SPEC, VISUAL], ids=["no camera", "camera"])
def test_the_acting_policys_probabilities_are_the_learners_before_it_learns(spec):
    # One gradient step: what it measures is how far the learner is from the policy that acted.
    config = replace(CONFIG, epochs=1, batch_size=40)
    ppo, rng = PPO(spec, config, seed=0), np.random.default_rng(0)
    for _ in range(3):
        rollout, frames = make_rollout(spec, rng), None
        if spec.has_camera:
            sizes = spec.dimensions
            frames = rng.integers(0, 256, (40, sizes.S, sizes.H, sizes.W, sizes.C), dtype=np.uint8)
            top, left = spec.crop_margin
            # (S, H, W, C) -> the central crop, frames along the channels
            middle = frames[:, :, top : sizes.H - top, left : sizes.W - left].transpose(0, 2, 3, 1, 4)
            rollout = replace(rollout, frames=middle.reshape(*middle.shape[:3], -1))
        policy = policy_from_weights(spec, ppo.policy_weights(1, "float32"))
        ppo.update(acted_out(policy, spec, rollout, frames, rng))
        assert ppo.metrics()["kl"] < 1e-8
        assert ppo.metrics()["clipped"] == 0.0


@pytest.mark.parametrize("spec", [SPEC, VISUAL], ids=["no camera", "camera"])
def test_the_actor_begins_with_the_same_policy(spec):
    ours = policy_from_weights(spec, PPO(spec, CONFIG, seed=4).policy_weights(1, "float32"))
    actors = initial_policy(spec, CONFIG.hidden_size, CONFIG.encoder_strides, 4)
    observation = make_observation(spec, np.random.default_rng(0))
    one, other = (policy.act(observation, np.random.default_rng(1)) for policy in (ours, actors))
    np.testing.assert_array_equal(one.action, other.action)


def test_a_time_limit_bootstraps_and_the_goal_does_not():
    ppo = PPO(SPEC, replace(CONFIG, discount=0.9), seed=0, dtype=torch.float64)
    minibatch = make_minibatch(SPEC, np.random.default_rng(0), 8)  # no transition follows another
    for terminated in (np.zeros(8, np.float32), np.ones(8, np.float32)):
        rollout = prepared(ppo, replace(minibatch, terminated=terminated))
        with torch.no_grad():
            next_value = ppo.critic(ppo._vector(minibatch.next_proprioception, minibatch.action)).numpy()
        expected = minibatch.reward + 0.9 * (1.0 - terminated.astype(np.float64)) * next_value
        np.testing.assert_allclose(rollout.value_target.numpy(), expected, rtol=1e-12)


def test_it_learns_from_the_chosen_action_and_not_from_the_applied_one():
    config, rollout = replace(CONFIG, critic_lr=0.0), make_rollout(SPEC, np.random.default_rng(0))
    other_chosen = replace(rollout, chosen_action=rollout.chosen_action[::-1].copy())
    actors = {}
    for name, data in {"one": rollout, "other": other_chosen}.items():
        ppo = PPO(SPEC, config, seed=0)
        ppo.update(data)
        actors[name] = parameters(ppo, "actor")
    assert not np.array_equal(actors["one"]["actor.2.weight"], actors["other"]["actor.2.weight"])
    # The applied action is what the next observation has as its previous one, and nothing else.
    batch = prepared(PPO(SPEC, config, seed=0), rollout)
    low, high = SPEC.action_low, SPEC.action_high
    np.testing.assert_allclose(batch.action, 2 * (rollout.chosen_action - low) / (high - low) - 1, atol=1e-6)


def test_an_action_that_rounding_has_put_on_its_bound_teaches_the_actor_nothing():
    rollout = make_rollout(SPEC, np.random.default_rng(0))
    at_the_bound = rollout.chosen_action.copy()
    at_the_bound[:, 1] = SPEC.action_high[1]
    ppo = PPO(SPEC, CONFIG, seed=0)
    before = parameters(ppo, "actor")
    ppo.update(replace(rollout, chosen_action=at_the_bound))
    assert_equal(before, parameters(ppo, "actor"))


@pytest.mark.parametrize("log_probability", [-500.0, 500.0])
def test_a_rollout_of_another_policy_leaves_finite_numbers(log_probability):
    rollout = make_rollout(SPEC, np.random.default_rng(0))
    ppo = PPO(SPEC, CONFIG, seed=0)
    ppo.update(replace(rollout, log_probability=np.full(40, log_probability, np.float32)))
    assert all(np.isfinite(value).all() for value in ppo.state_dict().values())
    assert all(np.isfinite(value) for value in ppo.metrics().values())


def test_the_surrogate_does_not_reach_the_encoder():
    rollout, encoders = make_rollout(VISUAL, np.random.default_rng(0)), []
    for actor_lr in (0.0, 1e-2):
        ppo = PPO(VISUAL, replace(CONFIG, actor_lr=actor_lr), seed=0)
        ppo.update(rollout)
        encoders.append(parameters(ppo, "encoder"))
    assert_equal(*encoders)


def test_an_epoch_takes_each_transition_once_and_an_update_so_many_epochs():
    seen = []

    def in_order(count):
        seen.append(count)
        return torch.arange(count)

    ppo = PPO(SPEC, replace(CONFIG, epochs=4), seed=0, shuffle=in_order)
    taken = []
    take = ppo._take_gradient_step
    ppo._take_gradient_step = lambda batch: taken.append(len(batch.vector)) or take(batch)
    ppo.update(make_rollout(SPEC, np.random.default_rng(0)))
    assert seen == [40] * 4
    assert taken == [16, 16, 8] * 4
    assert ppo.updates == 1


@pytest.mark.parametrize("spec", [SPEC, VISUAL], ids=["no camera", "camera"])
def test_a_slice_is_one_minibatch_of_values_or_one_gradient_step(spec):
    ppo, computed = PPO(spec, replace(CONFIG, epochs=2), seed=0), []
    critic, take = ppo.critic.forward, ppo._take_gradient_step
    ppo.critic.forward = lambda seen: computed.append(len(seen)) or critic(seen)
    ppo._take_gradient_step = lambda batch: computed.append("step") or take(batch)
    rollout, slices = replace(make_rollout(spec, np.random.default_rng(0)), rows=np.arange(40)), []
    for _ in ppo.update_in_slices(rollout):
        slices.append(computed[:])
        computed.clear()
    slices.append(computed)
    # Nothing before the first; the values of 40 observations; of the one next observation that is no other's.
    assert slices == [[], [16], [16], [8], [1], *[["step", 16], ["step", 16], ["step", 8]] * 2]


def test_longer_gradients_are_scaled_down():
    rollout = make_rollout(SPEC, np.random.default_rng(0))
    ppo = PPO(SPEC, replace(CONFIG, max_gradient_norm=1e-3, epochs=1), seed=0)
    ppo.update(rollout)
    for network in (ppo.actor, ppo.critic):
        norm = torch.sqrt(sum(p.grad.square().sum() for p in network.parameters()))
        assert float(norm) == pytest.approx(1e-3, rel=1e-3)


def test_precision_auto_is_that_of_acting():
    rollout, states = make_rollout(SPEC, np.random.default_rng(0)), []
    for precision in ("auto", "float32"):
        ppo = PPO(SPEC, CONFIG, seed=0, precision=precision)
        ppo.update(rollout)
        states.append(ppo.state_dict())
    assert_equal(*states)


def test_frames_as_tensors_teach_the_same_to_the_last_bit():
    rollout = make_rollout(VISUAL, np.random.default_rng(0))
    on_device = replace(
        rollout, frames=torch.from_numpy(rollout.frames), next_frames=torch.from_numpy(rollout.next_frames)
    )
    from_arrays, from_tensors = (PPO(VISUAL, CONFIG, seed=0) for _ in range(2))
    from_arrays.update(rollout)
    from_tensors.update(on_device)
    assert_equal(from_arrays.state_dict(), from_tensors.state_dict())


def test_it_learns_which_action_is_rewarded():
    # One observation, one step: the reward falls with the first action's distance from three quarters of its range.
    config = replace(CONFIG, batch_size=64, epochs=5, actor_lr=3e-3)
    ppo, rng = PPO(SPEC, config, seed=0), np.random.default_rng(0)
    template = make_minibatch(SPEC, rng, 128)
    still = {name: np.zeros_like(getattr(template, name)) for name in ("proprioception", "previous_action")}
    low, high = SPEC.action_low[0], SPEC.action_high[0]
    wanted = low + 0.75 * (high - low)
    for _ in range(15):
        policy = policy_from_weights(SPEC, ppo.policy_weights(1, "float32"))
        rollout = acted_out(policy, SPEC, replace(template, **still), None, rng)
        reward = 1.0 - np.abs(rollout.chosen_action[:, 0] - wanted)
        ppo.update(replace(rollout, reward=reward, terminated=np.ones(128, np.float32)))
    policy = policy_from_weights(SPEC, ppo.policy_weights(1, "float32"))
    nothing = Observation(None, np.zeros(3, np.float32), np.zeros(2, np.float32))
    assert policy.act(nothing, rng, deterministic=True).action[0] == pytest.approx(wanted, abs=0.3)
