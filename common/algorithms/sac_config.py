"""Settings of Soft Actor-Critic and their presets. Without torch: replay reads its share of them too."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from common.algorithms.config import OffPolicyConfig


@dataclass(frozen=True)
class SACConfig(OffPolicyConfig):
    """Settings of Soft Actor-Critic, besides those that every such algorithm has."""

    temperature_lr: float = 1e-4
    """Adam's step size for the logarithm of the temperature."""
    initial_temperature: float = 0.1
    """Weight alpha of the entropy (eq. 3.11) before it is learned."""
    target_entropy: float | None = None
    """Entropy the temperature steers to, nats in the normalised action space; None: minus the action size."""
    critic_tau: float = 0.01
    """Share of the critics that moves into their targets with each update."""
    encoder_tau: float = 0.05
    """Share of the encoder that moves into its target with each update."""
    temperature_betas: tuple[float, float] = (0.5, 0.999)
    """Adam's decay rates for the temperature."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._expect_learning_rate("temperature_lr")
        for name in ("critic_tau", "encoder_tau"):
            self._expect(name, 0.0 < getattr(self, name) <= 1.0, "a number in (0, 1]")
        self._expect_betas("temperature_betas")
        self._expect("initial_temperature", 0 < self.initial_temperature < math.inf, "a number > 0")
        self._expect(
            "target_entropy",
            self.target_entropy is None or math.isfinite(self.target_entropy),
            "a finite number or None",
        )


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
