"""Soft Actor-Critic (thesis section 3.2, algorithm 1)."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from common.algorithms.actor_critic import ActorCritic, observation
from common.algorithms.adam import Adam
from common.algorithms.base import random_seeds
from common.algorithms.sac_config import SACConfig
from common.messages import Float32Array, TaskSpec
from common.minibatch import Minibatch
from common.networks.distribution import TanhGaussian
from common.networks.mlp import TwinQ
from common.networks.precision import Precision, wide_dtype

NoiseSource = Callable[[int, int], Tensor]
"""(B, A) -> that many numbers from N(0, 1), in the algorithm's dtype and on its device."""


@dataclass(frozen=True)
class _Batch:
    """A minibatch on the device, normalised; ``vector`` is an observation without its frames."""

    frames: Tensor | None
    """(B, h, w, S * C) uint8"""
    vector: Tensor
    """(B, P + A): proprioception, previous action"""
    action: Tensor
    """(B, A) in [-1, 1]"""
    reward: Tensor
    """(B,)"""
    terminated: Tensor
    """(B,)"""
    next_frames: Tensor | None
    """(B, h, w, S * C) uint8"""
    next_vector: Tensor
    """(B, P + A)"""


class SAC(ActorCritic):
    """Twin soft critics with targets, a reparameterised tanh-Gaussian actor, a learned temperature.

    What a variant of SAC has to name:

    - The encoder is trained by the critic loss; the actor loss does not reach it (thesis 4.2).
    - **Features of the observation are computed once per update**, before the critic step; the actor loss sees the
      features from before that step, and the critics from after it.
    - The target critics have a target encoder of their own (``encoder_tau``).
    - Only ``terminated`` cuts the bootstrap. A time limit is not part of the task, so its last observation has a
      value like any other.
    - It learns from the applied action, clipped and delayed as it may be, not from the one the policy chose. With
      pending actions it is the other way round: the applied one is among them, so the observation says already what
      it does, and the chosen one is the first of the next observation's.
    """

    NAME = "sac"
    NETWORKS = ("encoder", "actor", "critic", "target_encoder", "target_critic")
    _config: SACConfig

    def __init__(
        self,
        spec: TaskSpec,
        config: SACConfig,
        *,
        seed: int,
        device: str = "cpu",
        precision: Precision = "auto",
        dtype: torch.dtype = torch.float32,
        noise: NoiseSource | None = None,
    ) -> None:
        """Create the networks; see :class:`Algorithm`.

        Args:
            noise: replaces the random numbers of the updates: first for the next actions, then for the actor loss.
        """
        rng, noise_seed = random_seeds(seed)
        wide = wide_dtype(precision, torch.device(device), dtype)
        super().__init__(spec, config, seed=seed, update_seed=noise_seed, device=device, wide=wide, dtype=dtype)
        self._noise = noise or self._random_noise
        actions = spec.dimensions.A
        self.critic = TwinQ(self.vector_size + actions, config.hidden_size, rng, dtype=dtype, wide=wide)
        self.log_temperature = nn.Parameter(
            torch.tensor(math.log(config.initial_temperature), dtype=dtype, device=self._device)
        )
        for module in filter(None, (self.encoder, self.actor, self.critic)):
            module.to(self._device)
        self.target_encoder = copy.deepcopy(self.encoder)
        self.target_critic = copy.deepcopy(self.critic)
        self.target_entropy = float(-actions if config.target_entropy is None else config.target_entropy)

        temperature = {"log_temperature": self.log_temperature}
        self.adams = {
            "critic": Adam(self._named("critic", "encoder"), config.critic_lr, config.adam_betas),
            "actor": Adam(self._named("actor"), config.actor_lr, config.adam_betas),
            "temperature": Adam(temperature, config.temperature_lr, config.temperature_betas),
        }

    def update(self, minibatch: Minibatch) -> None:
        """One gradient step for critics and encoder, actor, and temperature; then the targets move."""
        batch = self._batch(minibatch)
        seen = observation(self.encoder, batch.frames, batch.vector)
        self._update_critic(batch, seen)
        self._update_actor_and_temperature(seen.detach())
        self._move_targets()
        self.updates += 1

    def _update_critic(self, batch: _Batch, seen: Tensor) -> None:
        """Descend eq. 3.9; the value of the next observation is that of eq. 3.8, the smaller of two critics'."""
        with torch.no_grad():
            next_seen = observation(self.encoder, batch.next_frames, batch.next_vector)
            next_action, next_log_probability = self._act(next_seen)
            target_seen = (
                next_seen
                if self.target_encoder is None
                else observation(self.target_encoder, batch.next_frames, batch.next_vector)
            )
            next_q = self.target_critic(target_seen, next_action).amin(dim=0)
            next_value = next_q - self.log_temperature.exp() * next_log_probability
            target = batch.reward + self._config.discount * (1.0 - batch.terminated) * next_value
        q = self.critic(seen, batch.action)
        loss = (q - target).square().mean(dim=1).sum()
        self.adams["critic"].minimise(loss)
        self._metrics |= {"critic_loss": loss.detach(), "mean_q": q.detach().mean()}

    def _update_actor_and_temperature(self, seen: Tensor) -> None:
        """Descend eq. 3.13, then move the temperature so that the entropy approaches its target."""
        action, log_probability = self._act(seen)
        q = self.critic(seen, action, frozen=True).amin(dim=0)
        temperature = self.log_temperature.exp()
        actor_loss = (temperature.detach() * log_probability - q).mean()
        entropy = -log_probability.detach().mean()
        temperature_loss = temperature * (entropy - self.target_entropy)
        self.adams["actor"].minimise(actor_loss)
        self.adams["temperature"].minimise(temperature_loss)
        self._metrics |= {
            "actor_loss": actor_loss.detach(),
            "temperature_loss": temperature_loss.detach(),
            "temperature": temperature.detach(),
            "entropy": entropy,
        }

    @torch.no_grad()
    def _move_targets(self) -> None:
        _move(self.target_critic, self.critic, self._config.critic_tau)
        if self.encoder is not None and self.target_encoder is not None:
            _move(self.target_encoder, self.encoder, self._config.encoder_tau)

    def _act(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """(B, vector) -> actions (B, A) in [-1, 1] and their log-densities (B,)."""
        mean, log_std = self.actor(seen)
        config = self._config
        distribution = TanhGaussian.from_head(mean, log_std, config.log_std_low, config.log_std_high)
        return distribution.act(self._noise(*mean.shape))

    def _learnt_action(self, minibatch: Minibatch) -> Float32Array:
        return minibatch.chosen_action if self._config.pending_actions else minibatch.action

    def _state(self) -> dict[str, Tensor]:
        return {**super()._state(), "log_temperature": self.log_temperature}

    def _batch(self, minibatch: Minibatch) -> _Batch:
        to_tensor = self._to_tensor
        return _Batch(
            frames=None if minibatch.frames is None else to_tensor(minibatch.frames),
            vector=self._vector(minibatch.proprioception, minibatch.previous_action),
            action=to_tensor(self._actions.to_unit(self._learnt_action(minibatch), self._float)),
            reward=to_tensor(minibatch.reward.astype(self._float)),
            terminated=to_tensor(minibatch.terminated.astype(self._float)),
            next_frames=None if minibatch.next_frames is None else to_tensor(minibatch.next_frames),
            next_vector=self._vector(minibatch.next_proprioception, minibatch.action),
        )


def _move(target: nn.Module, source: nn.Module, tau: float) -> None:
    """target <- tau source + (1 - tau) target (algorithm 1)."""
    torch._foreach_lerp_(list(target.parameters()), list(source.parameters()), tau)
