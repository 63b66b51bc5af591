"""Named settings of every algorithm. Without torch: replay reads its share of them too."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from common.errors import ConfigError

WEIGHTS_DTYPES = ("float32", "float16")


@dataclass(frozen=True)
class SACConfig:
    """Settings of Soft Actor-Critic. The defaults are what the thesis's tasks have in common (section 4.2)."""

    batch_size: int = 256
    """Transitions in a minibatch."""
    hidden_size: int = 1024
    """Width of the two hidden layers of actor and critics."""
    encoder_strides: tuple[int, ...] = (2, 2, 2, 1)
    """Strides of the encoder's four convolutions; unused by a task without camera."""
    zero_initialised_head: bool = True
    """The actor's last layer starts at zero (thesis 4.2, guideline 1 of 7.3); False: at random, as torch would."""
    actor_lr: float = 1e-3
    """Adam's step size for the actor."""
    critic_lr: float = 1e-3
    """Adam's step size for the critics and the encoder."""
    temperature_lr: float = 1e-4
    """Adam's step size for the logarithm of the temperature."""
    initial_temperature: float = 0.1
    """Weight alpha of the entropy (eq. 3.11) before it is learned."""
    target_entropy: float | None = None
    """Entropy the temperature steers to, nats in the normalised action space; None: minus the action size."""
    discount: float = 1.0
    """gamma of eq. 3.8."""
    critic_tau: float = 0.01
    """Share of the critics that moves into their targets with each update."""
    encoder_tau: float = 0.05
    """Share of the encoder that moves into its target with each update."""
    replay_ratio: float = 1.0
    """Most updates per transition persisted by replay."""
    min_size_to_sample: int = 1000
    """Transitions that replay holds before the first update."""
    replay_capacity: int = 100_000
    """Rows of the experience ring."""
    policy_push_interval: int = 50
    """Updates from one push of the policy to the next."""
    weights_dtype: str = "float32"
    """Precision of a pushed policy: ``float32``, or ``float16`` for half the bytes."""
    log_std_low: float = -10.0
    """Least logarithm of the policy's standard deviation."""
    log_std_high: float = 10.0
    """Largest logarithm of the policy's standard deviation."""
    adam_betas: tuple[float, float] = (0.9, 0.999)
    """Adam's decay rates for actor, critics and encoder."""
    temperature_betas: tuple[float, float] = (0.5, 0.999)
    """Adam's decay rates for the temperature."""

    def __post_init__(self) -> None:
        for name in ("batch_size", "hidden_size", "min_size_to_sample", "policy_push_interval"):
            self._expect(name, getattr(self, name) >= 1, "an integer >= 1")
        for name in ("actor_lr", "critic_lr", "temperature_lr"):
            self._expect(name, 0.0 <= getattr(self, name) <= 1.0, "a number in [0, 1]")
        for name in ("critic_tau", "encoder_tau"):
            self._expect(name, 0.0 < getattr(self, name) <= 1.0, "a number in (0, 1]")
        for name in ("adam_betas", "temperature_betas"):
            betas = getattr(self, name)
            self._expect(name, len(betas) == 2 and all(0 <= b < 1 for b in betas), "two numbers in [0, 1)")
        strides = self.encoder_strides
        self._expect("encoder_strides", len(strides) == 4 and set(strides) <= {1, 2, 3, 4}, "4 integers in 1..4")
        self._expect("initial_temperature", 0 < self.initial_temperature < math.inf, "a number > 0")
        self._expect(
            "target_entropy",
            self.target_entropy is None or math.isfinite(self.target_entropy),
            "a finite number or None",
        )
        self._expect("discount", 0.0 <= self.discount <= 1.0, "a number in [0, 1]")
        self._expect("replay_ratio", 0 < self.replay_ratio < math.inf, "a finite number > 0")
        self._expect(
            "replay_capacity",
            self.replay_capacity > self.min_size_to_sample,
            f"more than min_size_to_sample ({self.min_size_to_sample})",
        )
        self._expect("weights_dtype", self.weights_dtype in WEIGHTS_DTYPES, f"one of {list(WEIGHTS_DTYPES)}")
        # At the middle of the bounds, where a zero-initialised layer starts, the standard deviation is exp(0) = 1.
        self._expect("log_std_high", 0 < self.log_std_high <= 20, "a number in (0, 20]")
        self._expect("log_std_low", self.log_std_low == -self.log_std_high, "minus log_std_high")

    def _expect(self, name: str, holds: bool, expected: str) -> None:
        if not holds:
            raise ConfigError(f"{name} = {getattr(self, name)!r}: expected {expected}")


_MIN_TIME = SACConfig()
_DENSE = SACConfig(
    actor_lr=3e-4,
    critic_lr=3e-4,
    temperature_lr=3e-4,
    critic_tau=0.005,
    encoder_tau=0.005,
    discount=0.99,
    replay_ratio=0.6,
)
# An untrained policy needs some 900 steps for a goal (170 with images). It is the critics' optimism about what was not
# tried that brings more of them, so learning starts early and the targets follow fast.
_DOT_REACHER = SACConfig(
    batch_size=64,
    hidden_size=256,
    critic_tau=0.03,
    min_size_to_sample=200,
    replay_capacity=20_000,
    policy_push_interval=20,
)

SAC_PRESETS: dict[str, SACConfig] = {
    "dot_reacher": _DOT_REACHER,
    "visual_dot_reacher": replace(_DOT_REACHER, encoder_strides=(2, 2, 1, 1)),
    # Nothing can be learnt from noise: small, so that the link and the buffers are what is tested.
    "noise_frames": replace(_DOT_REACHER, encoder_strides=(2, 2, 2, 1), replay_capacity=4_000),
    "dm_reacher": replace(_MIN_TIME, replay_capacity=10_000),
    "dm_ball_in_cup": replace(_MIN_TIME, replay_capacity=10_000),
    "create": _MIN_TIME,
    "ur5": replace(_DENSE, min_size_to_sample=2000),
    "vector": _MIN_TIME,
    "franka": replace(_DENSE, min_size_to_sample=5000),
    # The two computers of thesis section 5.1 on UR5-VisualReacher: what differs is what each can hold and compute.
    "workstation": replace(_DENSE, min_size_to_sample=2000, batch_size=256, replay_capacity=100_000),
    "laptop": replace(_DENSE, min_size_to_sample=2000, batch_size=64, replay_capacity=16_000),
}
"""Preset name -> settings; a task's TaskSpec names the preset it asks for."""

PRESETS: dict[str, dict[str, SACConfig]] = {"sac": SAC_PRESETS}
"""Algorithm name -> its presets."""


def resolve_config(algorithm: str, preset: str, overrides: Mapping[str, object]) -> SACConfig:
    """Return a preset with some of its settings replaced.

    Args:
        algorithm: a key of :data:`PRESETS`.
        preset: a key of the algorithm's presets.
        overrides: setting -> value; a list stands for a tuple, an integer for a float.

    Raises:
        ConfigError: a name is unknown or a value is not what the setting accepts.
    """
    if algorithm not in PRESETS:
        raise ConfigError(f"unknown algorithm {algorithm!r}; known: {', '.join(PRESETS)}")
    if preset not in PRESETS[algorithm]:
        raise ConfigError(f"unknown preset {preset!r} of {algorithm}; known: {', '.join(PRESETS[algorithm])}")
    base = PRESETS[algorithm][preset]
    known = {field.name: str(field.type) for field in fields(base)}
    values: dict[str, Any] = {}
    for name, value in overrides.items():
        if name not in known:
            raise ConfigError(f"{algorithm}: unknown setting {name!r}; known: {', '.join(known)}")
        values[name] = _converted(name, known[name], value)
    return replace(base, **values)


def setting_names(algorithm: str) -> frozenset[str]:
    """Return what can be set of an algorithm, one that :data:`PRESETS` knows."""
    return frozenset(field.name for preset in PRESETS[algorithm].values() for field in fields(preset))


def _converted(name: str, annotation: str, value: object) -> object:
    """Return ``value`` as the type a field is annotated with; bool never counts as a number."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    integer = isinstance(value, int) and number
    match annotation:
        case "int" if integer:
            return value
        case "bool" if isinstance(value, bool):
            return value
        case "float" | "float | None" if number:
            return float(value)  # type: ignore[arg-type]  # number says so
        case "float | None" if value is None:
            return None
        case "str" if isinstance(value, str):
            return value
        case _ if annotation.startswith("tuple") and isinstance(value, list | tuple):
            element = "int" if "int" in annotation else "float"
            return tuple(_converted(f"{name}[{i}]", element, item) for i, item in enumerate(value))
    raise ConfigError(f"{name} = {value!r}: expected {annotation}")
