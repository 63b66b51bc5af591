"""Presets are those of the published settings; a wrong setting is refused by name."""

from __future__ import annotations

from dataclasses import asdict

import pytest

from common.algorithms import ALGORITHMS, load_algorithm
from common.algorithms.ppo_config import PPO_PRESETS, PPOConfig
from common.algorithms.presets import presets_of, resolve_config
from common.algorithms.sac_config import SAC_PRESETS, SACConfig
from common.errors import ConfigError

# Columns: capacity, steps before the first update, updates per step, actor and critic lr, temperature lr,
# critic tau, encoder tau, discount.
TABLE = {
    "create": (100_000, 1000, 1.0, 1e-3, 1e-4, 0.01, 0.05, 1.0),
    "ur5": (100_000, 2000, 0.6, 3e-4, 3e-4, 0.005, 0.005, 0.99),
    "vector": (100_000, 1000, 1.0, 1e-3, 1e-4, 0.01, 0.05, 1.0),
    "dm_reacher": (10_000, 1000, 1.0, 1e-3, 1e-4, 0.01, 0.05, 1.0),
    "dm_ball_in_cup": (10_000, 1000, 1.0, 1e-3, 1e-4, 0.01, 0.05, 1.0),
    "franka": (100_000, 5000, 0.6, 3e-4, 3e-4, 0.005, 0.005, 0.99),
}


@pytest.mark.parametrize("name", TABLE)
def test_task_presets_are_the_published_ones(name):
    config = SAC_PRESETS[name]
    assert config.actor_lr == config.critic_lr
    assert TABLE[name] == (
        config.replay_capacity,
        config.min_size_to_sample,
        config.replay_ratio,
        config.critic_lr,
        config.temperature_lr,
        config.critic_tau,
        config.encoder_tau,
        config.discount,
    )


@pytest.mark.parametrize("name", [*TABLE, "workstation"])
def test_what_all_published_presets_share(name):
    config = SAC_PRESETS[name]
    assert (config.batch_size, config.hidden_size, config.encoder_strides) == (256, 1024, (2, 2, 2, 1))
    assert (config.initial_temperature, config.policy_push_interval, config.target_entropy) == (0.1, 50, None)
    assert (config.adam_betas, config.temperature_betas) == ((0.9, 0.999), (0.5, 0.999))
    assert (config.log_std_low, config.log_std_high) == (-10.0, 10.0)


def test_the_laptop_differs_from_the_workstation_in_what_it_can_hold():
    laptop, workstation = asdict(SAC_PRESETS["laptop"]), asdict(SAC_PRESETS["workstation"])
    differing = {name: (laptop[name], workstation[name]) for name in laptop if laptop[name] != workstation[name]}
    assert differing == {"batch_size": (64, 256), "replay_capacity": (16_000, 100_000)}


def test_the_defaults_of_ppo_are_the_published_ones():
    config = PPOConfig()
    assert (config.rollout_length, config.batch_size, config.epochs) == (4096, 256, 10)
    assert (config.actor_lr, config.critic_lr, config.discount, config.gae_lambda) == (3e-4, 1e-3, 0.99, 0.97)
    assert (config.clip, config.adam_betas) == (0.2, (0.9, 0.999))
    assert (config.hidden_size, config.encoder_strides) == (1024, (2, 2, 2, 1))
    for robot in ("ur5", "create", "vector"):
        preset = PPO_PRESETS[robot]
        assert {**asdict(preset), "replay_capacity": None} == {**asdict(config), "replay_capacity": None}


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_has_presets_for_the_tasks_of_this_repository(name):
    wanted = {"dot_reacher", "visual_dot_reacher", "noise_frames", "dm_reacher", "dm_ball_in_cup"}
    wanted |= {"ur5", "create", "vector"}
    assert wanted <= set(presets_of(name))


def test_overrides_replace_settings_and_convert_lists_and_integers():
    config = resolve_config("sac", "create", {"encoder_strides": [2, 1, 1, 1], "discount": 1, "batch_size": 8})
    assert (config.encoder_strides, config.discount, config.batch_size) == ((2, 1, 1, 1), 1.0, 8)
    assert isinstance(config.discount, float)
    assert resolve_config("sac", "create", {}) == SAC_PRESETS["create"]
    assert resolve_config("sac", "create", {"zero_initialised_head": False}).zero_initialised_head is False


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("batch_size", 0),
        ("batch_size", 2.5),
        ("batch_size", True),
        ("batch_size", "64"),
        ("encoder_strides", [2, 2, 2]),
        ("encoder_strides", 2),
        ("encoder_strides", [2, 2, 2, 0.5]),
        ("actor_lr", -1e-3),
        ("actor_lr", float("nan")),
        ("discount", 1.1),
        ("critic_tau", 0.0),
        ("replay_ratio", float("inf")),
        ("replay_capacity", 1000),
        ("initial_temperature", 0.0),
        ("target_entropy", float("inf")),
        ("weights_dtype", "bfloat16"),
        ("log_std_low", -5.0),
        ("adam_betas", [0.9, 1.0]),
        ("zero_initialised_head", 0),
        ("zero_initialised_head", "false"),
    ],
)
def test_a_bad_value_is_refused_naming_key_value_and_what_was_expected(name, value):
    with pytest.raises(ConfigError, match=rf"{name}.* = .*: expected"):
        resolve_config("sac", "create", {name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("rollout_length", 0),
        ("epochs", 0),
        ("clip", 0.0),
        ("gae_lambda", 1.1),
        ("entropy_coefficient", -0.1),
        ("max_gradient_norm", 0.0),
        ("replay_capacity", 4000),  # less than two rollouts of 2048
        ("policy_push_interval", 2),
        ("random_crop", True),
        ("discount", -0.1),
    ],
)
def test_a_bad_value_for_ppo_is_refused_too(name, value):
    with pytest.raises(ConfigError, match=rf"{name}.* = .*: expected"):
        resolve_config("ppo", "dot_reacher", {name: value})


def test_what_belongs_to_one_algorithm_is_unknown_to_another():
    with pytest.raises(ConfigError, match=r"ppo: unknown setting 'replay_ratio'; known: .*rollout_length"):
        resolve_config("ppo", "dot_reacher", {"replay_ratio": 1.0})
    with pytest.raises(ConfigError, match=r"sac: unknown setting 'rollout_length'; known: .*replay_ratio"):
        resolve_config("sac", "dot_reacher", {"rollout_length": 100})


def test_unknown_names_are_refused_naming_the_known_ones():
    with pytest.raises(ConfigError, match=r"unknown algorithm 'sax'; known: sac"):
        resolve_config("sax", "create", {})
    with pytest.raises(ConfigError, match=r"unknown algorithm 'sax'; known: sac"):
        load_algorithm("sax")
    with pytest.raises(ConfigError, match=r"unknown preset 'robot' of sac; known: dot_reacher"):
        resolve_config("sac", "robot", {})
    with pytest.raises(ConfigError, match=r"unknown setting 'batch'; known: batch_size"):
        resolve_config("sac", "create", {"batch": 3})


def test_a_config_cannot_be_changed_after_its_checks():
    with pytest.raises(AttributeError):
        SACConfig().batch_size = 3
