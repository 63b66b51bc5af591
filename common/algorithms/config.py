"""The settings that every algorithm has. Without torch: actor and replay read their share of them too."""

from __future__ import annotations

import math
from dataclasses import dataclass

from common.errors import ConfigError

WEIGHTS_DTYPES = ("float32", "float16")
MOST_PENDING_ACTIONS = 100
"""Four seconds at 40 ms a cycle; what comes later should be stopped by the watchdog. Inputs and rows grow with it."""


@dataclass(frozen=True)
class AlgorithmConfig:
    """Settings of an algorithm. The defaults are what the thesis's tasks have in common (section 4.2)."""

    batch_size: int = 256
    """Transitions in a gradient step."""
    hidden_size: int = 1024
    """Width of the two hidden layers of actor and critics."""
    encoder_strides: tuple[int, ...] = (2, 2, 2, 1)
    """Strides of the encoder's four convolutions; unused by a task without camera."""
    zero_initialised_head: bool = True
    """The actor's last layer starts at zero (thesis 4.2, guideline 1 of 7.3); False: at random, as torch would."""
    random_crop: bool = True
    """The frames of a minibatch are cropped at random (thesis 3.6); False: in the middle, as for acting."""
    pending_actions: int = 0
    """Actions in an observation that the policy chose before it and that may not have been applied yet
    (:mod:`common.pending_actions`)."""
    actor_lr: float = 1e-3
    """Adam's step size for the actor."""
    critic_lr: float = 1e-3
    """Adam's step size for the critics and the encoder."""
    discount: float = 1.0
    """gamma of eq. 3.8 and 3.16."""
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

    def __post_init__(self) -> None:
        for name in ("batch_size", "hidden_size", "policy_push_interval"):
            self._expect(name, getattr(self, name) >= 1, "an integer >= 1")
        for name in ("actor_lr", "critic_lr"):
            self._expect_learning_rate(name)
        self._expect_betas("adam_betas")
        strides = self.encoder_strides
        self._expect("encoder_strides", len(strides) == 4 and set(strides) <= {1, 2, 3, 4}, "4 integers in 1..4")
        self._expect(
            "pending_actions",
            0 <= self.pending_actions <= MOST_PENDING_ACTIONS,
            f"an integer in 0..{MOST_PENDING_ACTIONS}",
        )
        self._expect("discount", 0.0 <= self.discount <= 1.0, "a number in [0, 1]")
        self._expect("weights_dtype", self.weights_dtype in WEIGHTS_DTYPES, f"one of {list(WEIGHTS_DTYPES)}")
        # At the middle of the bounds, where a zero-initialised layer starts, the standard deviation is exp(0) = 1.
        self._expect("log_std_high", 0 < self.log_std_high <= 20, "a number in (0, 20]")
        self._expect("log_std_low", self.log_std_low == -self.log_std_high, "minus log_std_high")

    def _expect(self, name: str, holds: bool, expected: str) -> None:
        if not holds:
            raise ConfigError(f"{name} = {getattr(self, name)!r}: expected {expected}")

    def _expect_learning_rate(self, name: str) -> None:
        self._expect(name, 0.0 <= getattr(self, name) <= 1.0, "a number in [0, 1]")

    def _expect_betas(self, name: str) -> None:
        betas = getattr(self, name)
        self._expect(name, len(betas) == 2 and all(0 <= b < 1 for b in betas), "two numbers in [0, 1)")


@dataclass(frozen=True)
class OffPolicyConfig(AlgorithmConfig):
    """Settings of an algorithm that learns from random transitions of all experience that replay holds."""

    replay_ratio: float = 1.0
    """Most updates per transition persisted by replay."""
    min_size_to_sample: int = 1000
    """Transitions that replay holds before the first update."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._expect("min_size_to_sample", self.min_size_to_sample >= 1, "an integer >= 1")
        self._expect("replay_ratio", 0 < self.replay_ratio < math.inf, "a finite number > 0")
        self._expect(
            "replay_capacity",
            self.replay_capacity > self.min_size_to_sample,
            f"more than min_size_to_sample ({self.min_size_to_sample})",
        )


@dataclass(frozen=True)
class OnPolicyConfig(AlgorithmConfig):
    """Settings of an algorithm that learns from rollouts: what the newest policy has done, in order, once."""

    rollout_length: int = 4096
    """Transitions of one acting policy that an update learns from."""
    policy_push_interval: int = 1
    """Always 1: once a policy has been learnt from, only its successor's experience is of use."""
    random_crop: bool = False
    """Always False: the probabilities are compared with those of acting, which sees the middle."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._expect("rollout_length", self.rollout_length >= 1, "an integer >= 1")
        self._expect("policy_push_interval", self.policy_push_interval == 1, "1")
        self._expect("random_crop", not self.random_crop, "False")
        # A transition takes two rows where each is an attempt of its own.
        self._expect(
            "replay_capacity",
            self.replay_capacity >= 2 * self.rollout_length,
            f"at least twice rollout_length ({self.rollout_length})",
        )
