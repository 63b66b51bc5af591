"""What Soft Actor-Critic promises, property by property."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from common.algorithms.sac import SAC
from common.algorithms.sac_config import SACConfig
from common.errors import ConfigError
from common.minibatch import Minibatch
from common.policies import initial_policy, policy_from_weights
from tests.reference.tasks import make_minibatch, make_observation, make_spec

CONFIG = SACConfig(batch_size=8, hidden_size=16, encoder_strides=(2, 2, 1, 1))
SPEC = make_spec()


def zero_noise(rows, columns):
    return torch.zeros(rows, columns, dtype=torch.float64)


def critic_loss(minibatch, config=CONFIG):
    sac = SAC(SPEC, config, seed=0, dtype=torch.float64, noise=zero_noise)
    sac.update(minibatch)
    return sac.metrics()["critic_loss"]


def test_only_terminated_cuts_the_bootstrap():
    minibatch = make_minibatch(SPEC, np.random.default_rng(0), 8)
    elsewhere = replace(minibatch, next_proprioception=minibatch.next_proprioception + 1.0)
    ended = {"terminated": np.ones(8, np.float32)}
    going_on = {"terminated": np.zeros(8, np.float32)}
    # Where the goal was reached, what comes next has no value; anywhere else, a time limit included, it has.
    assert critic_loss(replace(minibatch, **ended)) == critic_loss(replace(elsewhere, **ended))
    assert critic_loss(replace(minibatch, **going_on)) != critic_loss(replace(elsewhere, **going_on))


def test_the_critic_loss_of_a_terminal_minibatch_is_the_squared_error_to_the_reward():
    minibatch = replace(make_minibatch(SPEC, np.random.default_rng(0), 8), terminated=np.ones(8, np.float32))
    sac = SAC(SPEC, CONFIG, seed=0, dtype=torch.float64, noise=zero_noise)
    batch = sac._batch(minibatch)
    q = sac.critic(batch.vector, batch.action).detach().numpy()
    expected = ((q - minibatch.reward) ** 2).mean(axis=1).sum()
    sac.update(minibatch)
    assert sac.metrics()["critic_loss"] == pytest.approx(expected, rel=1e-12)


def test_the_temperature_falls_while_the_entropy_is_above_its_target_and_rises_below_it():
    minibatch = make_minibatch(SPEC, np.random.default_rng(0), 8)
    for target, sign in ((-50.0, -1.0), (50.0, 1.0)):
        sac = SAC(SPEC, replace(CONFIG, target_entropy=target), seed=0)
        before = sac.log_temperature.item()
        sac.update(minibatch)
        assert np.sign(sac.log_temperature.item() - before) == sign


def test_the_default_target_entropy_is_minus_the_action_size():
    assert SAC(make_spec(action_size=3), CONFIG, seed=0).target_entropy == -3.0


@pytest.mark.parametrize("zero_initialised_head", [True, False])
@pytest.mark.parametrize("spec", [SPEC, make_spec((32, 36, 3))], ids=["no camera", "camera"])
def test_learner_and_actor_begin_with_the_same_policy(spec, zero_initialised_head):
    config = replace(CONFIG, zero_initialised_head=zero_initialised_head)
    learners = policy_from_weights(spec, SAC(spec, config, seed=4).policy_weights(1, "float32"))
    actors, other = (
        initial_policy(spec, 16, config.encoder_strides, seed, zero_initialised_head=zero_initialised_head)
        for seed in (4, 5)
    )
    observation = make_observation(spec, np.random.default_rng(0))
    mine, theirs, others = (
        policy.act(observation, np.random.default_rng(1), deterministic=True).action
        for policy in (learners, actors, other)
    )
    np.testing.assert_array_equal(mine, theirs)
    # A zero head makes all seeds' policies alike; a random one tells them apart.
    assert np.array_equal(mine, others) == zero_initialised_head


def test_targets_move_by_their_own_shares():
    spec = make_spec((32, 36, 3))
    sac = SAC(spec, replace(CONFIG, critic_tau=0.25, encoder_tau=0.5), seed=0, dtype=torch.float64)
    before = sac.state_dict()
    sac.update(make_minibatch(spec, np.random.default_rng(0), 8))
    after = sac.state_dict()
    for name, share in (("critic.weight1", 0.25), ("encoder.2.weight", 0.5)):
        expected = share * after[name] + (1 - share) * before[f"target_{name}"]
        np.testing.assert_allclose(after[f"target_{name}"], expected, atol=1e-15)


def test_the_actor_loss_does_not_reach_the_encoder():
    spec = make_spec((32, 36, 3))
    sac = SAC(spec, replace(CONFIG, critic_lr=0.0), seed=0)
    before = sac.state_dict()
    sac.update(make_minibatch(spec, np.random.default_rng(0), 8))
    after = sac.state_dict()
    assert all(np.array_equal(before[name], after[name]) for name in before if name.startswith("encoder."))
    assert not np.array_equal(before["actor.2.weight"], after["actor.2.weight"])


def test_initial_twins_differ_and_targets_start_as_copies():
    state = SAC(SPEC, CONFIG, seed=0).state_dict()
    assert not np.array_equal(state["critic.weight1"][0], state["critic.weight1"][1])
    np.testing.assert_array_equal(state["critic.weight1"], state["target_critic.weight1"])
    assert not state["actor.2.weight"].any()


def test_networks_learn_the_value_of_a_two_step_task():
    # One transition to the goal, one before it: with discount 1 and almost no entropy bonus, -1 and -2.
    config = replace(CONFIG, initial_temperature=1e-6, temperature_lr=0.0, critic_lr=3e-3, critic_tau=0.1)
    far, near = np.full(3, -1.0, np.float32), np.full(3, 1.0, np.float32)
    # The actor stays as it is and there is no noise: the next action is always the one in the minibatch.
    sac = SAC(SPEC, replace(config, actor_lr=0.0), seed=0, precision="float32", noise=torch.zeros)
    centre = np.tile((SPEC.action_low + SPEC.action_high) / 2, (8, 1))
    minibatch = Minibatch(
        rows=np.arange(8),
        frames=None,
        proprioception=np.stack([far, near] * 4),
        previous_action=centre,
        action=centre,
        chosen_action=centre,
        log_probability=np.zeros(8, np.float32),
        reward=-np.ones(8, np.float32),
        terminated=np.array([0.0, 1.0] * 4, np.float32),
        next_frames=None,
        next_proprioception=np.stack([near, near] * 4),
    )
    for _ in range(400):
        sac.update(minibatch)
    batch = sac._batch(minibatch)
    q = sac.critic(batch.vector, batch.action).mean(dim=0)
    np.testing.assert_allclose(q.detach().numpy(), [-2.0, -1.0] * 4, atol=0.05)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_frames_as_tensors_teach_the_same_to_the_last_bit(precision):
    spec, rng = make_spec((32, 36, 3)), np.random.default_rng(0)
    from_arrays, from_tensors = (SAC(spec, CONFIG, seed=0, precision=precision) for _ in range(2))
    for _ in range(3):
        minibatch = make_minibatch(spec, rng, 8)
        from_arrays.update(minibatch)
        tensors = {name: torch.tensor(getattr(minibatch, name)) for name in ("frames", "next_frames")}
        from_tensors.update(replace(minibatch, **tensors))
    expected, got = from_arrays.state_dict(), from_tensors.state_dict()
    for name, value in expected.items():
        np.testing.assert_array_equal(got[name], value, err_msg=name)


def test_a_checkpoint_from_another_kind_of_device_is_gone_on_from_with_other_random_numbers():
    original, resumed = SAC(SPEC, CONFIG, seed=0), SAC(SPEC, CONFIG, seed=1)
    original.update(make_minibatch(SPEC, np.random.default_rng(0), 8))
    state, own = original.state_dict(), resumed.state_dict()["random_state"]
    gpus = np.arange(16, dtype=np.uint8)  # seed and offset, 8 bytes each
    resumed.load_state_dict(state | {"random_state": gpus})
    for name, value in resumed.state_dict().items():
        np.testing.assert_array_equal(value, own if name == "random_state" else state[name], err_msg=name)
    assert resumed.updates == 1


@pytest.mark.parametrize("wrong", [np.zeros(0, np.uint8), np.zeros(16), np.zeros((2, 8), np.uint8)], ids=str)
def test_a_random_state_that_is_none_is_refused(wrong):
    sac = SAC(SPEC, CONFIG, seed=0)
    with pytest.raises(ConfigError, match=r"random_state: expected \[5056\]"):
        sac.load_state_dict(sac.state_dict() | {"random_state": wrong})


def test_with_pending_actions_it_learns_from_the_chosen_action_and_without_from_the_applied_one():
    minibatch = make_minibatch(SPEC, np.random.default_rng(0), 8)
    otherwise_applied = replace(minibatch, action=-minibatch.action, terminated=np.ones(8, np.float32))
    minibatch = replace(minibatch, terminated=np.ones(8, np.float32))
    otherwise_chosen = replace(minibatch, chosen_action=-minibatch.chosen_action)
    # At the end of an episode nothing follows, so the applied action is no part of what comes next either.
    assert critic_loss(minibatch) == critic_loss(otherwise_chosen) != critic_loss(otherwise_applied)
    config = replace(CONFIG, pending_actions=1)
    assert critic_loss(minibatch, config) == critic_loss(otherwise_applied, config)
    assert critic_loss(minibatch, config) != critic_loss(otherwise_chosen, config)
