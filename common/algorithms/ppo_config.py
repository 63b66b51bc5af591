"""Settings of Proximal Policy Optimization and their presets. Without torch: replay reads its share of them too."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from common.algorithms.config import OnPolicyConfig


@dataclass(frozen=True)
class PPOConfig(OnPolicyConfig):
    """Settings of Proximal Policy Optimization, besides those that every such algorithm has."""

    actor_lr: float = 3e-4
    critic_lr: float = 1e-3
    discount: float = 0.99
    epochs: int = 10
    """Times that an update goes through its rollout, in minibatches of ``batch_size``."""
    clip: float = 0.2
    """epsilon of eq. 3.19: how far the probability ratio is worth moving from 1."""
    gae_lambda: float = 0.97
    """lambda of eq. 3.17."""
    normalise_advantages: bool = True
    """A rollout's advantages are shifted and scaled to mean 0 and standard deviation 1."""
    entropy_coefficient: float = 0.0
    """Weight of the policy's entropy, nats in the normalised action space, in the objective."""
    max_gradient_norm: float | None = None
    """Longer gradients, of the actor and of the critic with the encoder, are scaled down to this; None: none is."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._expect("epochs", self.epochs >= 1, "an integer >= 1")
        self._expect("clip", 0.0 < self.clip < math.inf, "a number > 0")
        self._expect("gae_lambda", 0.0 <= self.gae_lambda <= 1.0, "a number in [0, 1]")
        self._expect("entropy_coefficient", 0.0 <= self.entropy_coefficient < math.inf, "a finite number >= 0")
        self._expect(
            "max_gradient_norm",
            self.max_gradient_norm is None or 0.0 < self.max_gradient_norm < math.inf,
            "a finite number > 0 or None",
        )


_THESIS = PPOConfig()
# Half the rollout, a quarter of the minibatch and of the width suffice: 20 steps per goal after 34 000 to 39 000 steps.
_DOT_REACHER = PPOConfig(batch_size=64, hidden_size=256, rollout_length=2048, replay_capacity=20_000)

PPO_PRESETS: dict[str, PPOConfig] = {
    "dot_reacher": _DOT_REACHER,
    # The value loss moves the encoder, and with it the policy, past the clip: KL .13 rather than .23 (one seed).
    "visual_dot_reacher": replace(_DOT_REACHER, encoder_strides=(2, 2, 1, 1), epochs=5, critic_lr=3e-4),
    # Nothing can be learnt from noise: small, so that the link and the buffers are what is tested.
    "noise_frames": replace(_DOT_REACHER, encoder_strides=(2, 2, 2, 1), rollout_length=512, replay_capacity=4_000),
    "dm_reacher": replace(_THESIS, replay_capacity=10_000),
    "dm_ball_in_cup": replace(_THESIS, replay_capacity=10_000),
    "ur5": replace(_THESIS, replay_capacity=16_000),
    "franka": replace(_THESIS, replay_capacity=16_000),
    "create": replace(_THESIS, replay_capacity=16_000),
    "vector": replace(_THESIS, replay_capacity=16_000),
}
"""Preset name -> settings; a task's TaskSpec names the preset it asks for."""
