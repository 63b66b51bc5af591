"""Proximal Policy Optimization (thesis section 3.3, algorithm 2)."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from common.algorithms.actor_critic import ActorCritic, observation
from common.algorithms.adam import Adam
from common.algorithms.advantages import advantages
from common.algorithms.base import random_seeds
from common.algorithms.ppo_config import PPOConfig
from common.messages import TaskSpec
from common.minibatch import Minibatch
from common.networks.distribution import LARGEST_ACTION, TanhGaussian
from common.networks.mlp import StateValue
from common.networks.precision import Precision, wide_dtype

ShuffleSource = Callable[[int], Tensor]
"""N -> the numbers from 0 to N - 1 in random order."""
NoiseSource = Callable[[int, int], Tensor]
"""(B, A) -> that many numbers from N(0, 1), in the algorithm's dtype and on its device."""
Values = Generator[None, None, npt.NDArray[np.float64]]
"""Slices whose outcome are values (N,)."""

_MAX_LOG_RATIO = 20.0
"""Only a policy that another one acted for comes near this; beyond, the ratio would overflow."""


@dataclass(frozen=True)
class _Rollout:
    """A rollout on the device, normalised; ``vector`` is an observation without its frames."""

    frames: Tensor | None
    """(N, h, w, S * C) uint8"""
    vector: Tensor
    """(N, P + A): proprioception, previous action"""
    action: Tensor
    """(N, A) in [-1, 1], as the acting policy chose it"""
    log_probability: Tensor
    """(N,) of the action, under the acting policy"""
    counts: Tensor
    """(N,) 1 where the action tells its probability, 0 where it is too near its bounds for that"""
    advantage: Tensor
    """(N,)"""
    value_target: Tensor
    """(N,)"""

    def select(self, chosen: Tensor) -> _Rollout:
        """Return the transitions numbered ``chosen`` (B,)."""
        return _Rollout(
            frames=None if self.frames is None else self.frames[chosen],
            vector=self.vector[chosen],
            action=self.action[chosen],
            log_probability=self.log_probability[chosen],
            counts=self.counts[chosen],
            advantage=self.advantage[chosen],
            value_target=self.value_target[chosen],
        )


class PPO(ActorCritic):
    """Clipped surrogate objective, generalised advantages, one state-value critic.

    An update learns from one rollout, for several epochs of minibatches. What a variant of PPO has to name:

    - It learns from the action that the policy *chose* for an observation, and from its log-probability as the acting
      policy computed it. Delay and clipping on the way to the robot belong to the world.
    - Only ``terminated`` cuts the bootstrap. Where the rollout goes on with something else than the next observation,
      after a time limit or a gap, that observation's value stands for what would have come.
    - The value's target is the advantage plus the value at the rollout's end; both stay the same for all epochs.
    - The encoder is trained by the value loss; the surrogate does not reach it (thesis 4.2).
    - Frames are cropped as for acting: with another crop the ratio would not begin at 1. For the same reason,
      precision ``auto`` is that of acting, float32.
    """

    NAME = "ppo"
    NETWORKS = ("encoder", "actor", "critic")
    _config: PPOConfig

    def __init__(
        self,
        spec: TaskSpec,
        config: PPOConfig,
        *,
        seed: int,
        device: str = "cpu",
        precision: Precision = "auto",
        dtype: torch.dtype = torch.float32,
        shuffle: ShuffleSource | None = None,
        noise: NoiseSource | None = None,
    ) -> None:
        """Create the networks; see :class:`Algorithm`.

        Args:
            shuffle: replaces the random order of an epoch.
            noise: replaces the random numbers that estimate the entropy.
        """
        rng, update_seed = random_seeds(seed)
        wide = wide_dtype("float32" if precision == "auto" else precision, torch.device(device), dtype)
        super().__init__(spec, config, seed=seed, update_seed=update_seed, device=device, wide=wide, dtype=dtype)
        self._shuffle, self._noise = shuffle or self._random_order, noise or self._random_noise
        self.critic = StateValue(self.vector_size, config.hidden_size, rng, dtype=dtype, wide=wide)
        for module in filter(None, (self.encoder, self.actor, self.critic)):
            module.to(self._device)
        norm = config.max_gradient_norm
        self.adams = {
            "critic": Adam(self._named("critic", "encoder"), config.critic_lr, config.adam_betas, norm),
            "actor": Adam(self._named("actor"), config.actor_lr, config.adam_betas, norm),
        }

    def update(self, minibatch: Minibatch) -> None:
        """Learn from a rollout: ``epochs`` times all its transitions, in minibatches of ``batch_size``."""
        for _ in self.update_in_slices(minibatch):
            pass

    def update_in_slices(self, minibatch: Minibatch) -> Iterator[None]:
        """See :class:`Algorithm`; a slice is what is computed for one minibatch of ``batch_size``."""
        rollout, metrics = yield from self._rollout(minibatch)
        size = len(rollout.vector)
        for _ in range(self._config.epochs):
            measured = []
            for chosen in torch.split(self._shuffle(size), self._config.batch_size):
                yield
                measured.append((len(chosen) / size, self._take_gradient_step(rollout.select(chosen))))
        # Of the last epoch: what the update has come to.
        last = {name: sum(share * step[name] for share, step in measured) for name in measured[0][1]}
        self._metrics = metrics | last  # type: ignore[assignment]
        self.updates += 1

    def _take_gradient_step(self, batch: _Rollout) -> dict[str, Tensor]:
        """Descend the value's squared error and minus the surrogate objective (eq. 3.19); return what was measured."""
        config = self._config
        seen = observation(self.encoder, batch.frames, batch.vector)
        value_loss = (self.critic(seen) - batch.value_target).square().mean()
        distribution = self._distribution(seen.detach())
        log_ratio = (distribution.log_probability(batch.action) - batch.log_probability) * batch.counts
        log_ratio = log_ratio.clamp(-_MAX_LOG_RATIO, _MAX_LOG_RATIO)
        ratio = log_ratio.exp()
        clipped = ratio.clamp(1.0 - config.clip, 1.0 + config.clip)
        surrogate = torch.minimum(ratio * batch.advantage, clipped * batch.advantage).mean()
        actor_loss = -surrogate
        if config.entropy_coefficient:
            entropy = -distribution.act(self._noise(*distribution.mean.shape))[1].mean()
            actor_loss = actor_loss - config.entropy_coefficient * entropy
        self.adams["critic"].minimise(value_loss)
        self.adams["actor"].minimise(actor_loss)
        return {
            "value_loss": value_loss.detach(),
            "actor_loss": actor_loss.detach(),
            "kl": (ratio - 1.0 - log_ratio).mean().detach(),
            "clipped": (ratio.detach() != clipped.detach()).to(self._dtype).mean(),
        }

    def _rollout(self, minibatch: Minibatch) -> Generator[None, None, tuple[_Rollout, dict[str, Tensor]]]:
        """Compute values and advantages, under the parameters that the update begins with; in slices.

        Returns the rollout, and what was measured of it.
        """
        frames = None if minibatch.frames is None else self._to_tensor(minibatch.frames)
        vector = self._vector(minibatch.proprioception, minibatch.previous_action)
        value = yield from self._values(frames, vector)
        goes_on = np.append(np.diff(minibatch.rows) == 1, False)
        next_value = yield from self._next_values(minibatch, value, goes_on)
        terminated = minibatch.terminated.astype(np.float64)
        estimates = advantages(
            minibatch.reward.astype(np.float64),
            value,
            next_value,
            terminated,
            goes_on,
            discount=self._config.discount,
            gae_lambda=self._config.gae_lambda,
        )
        target = estimates + value
        metrics = {
            name: torch.tensor(float(number))
            for name, number in {
                "mean_value": value.mean(),
                "entropy": -minibatch.log_probability.mean(),
                "transitions": len(value),
            }.items()
        }
        if self._config.normalise_advantages:
            estimates = (estimates - estimates.mean()) / (estimates.std() + 1e-8)
        unit_action = self._actions.to_unit(minibatch.chosen_action, self._float)
        counts = (np.abs(unit_action) < LARGEST_ACTION).all(axis=1)
        rollout = _Rollout(
            frames=frames,
            vector=vector,
            action=self._to_tensor(unit_action),
            log_probability=self._to_tensor(minibatch.log_probability.astype(self._float)),
            counts=self._to_tensor(counts.astype(self._float)),
            advantage=self._to_tensor(estimates.astype(self._float)),
            value_target=self._to_tensor(target.astype(self._float)),
        )
        return rollout, metrics

    def _next_values(
        self, minibatch: Minibatch, value: npt.NDArray[np.float64], goes_on: npt.NDArray[np.bool_]
    ) -> Values:
        """Return the values (N,) of the next observations: those of the transitions that follow, where some do."""
        next_value = np.append(value[1:], 0.0)
        ends = ~goes_on
        frames = None if minibatch.next_frames is None else self._to_tensor(minibatch.next_frames[ends])
        vector = self._vector(minibatch.next_proprioception[ends], minibatch.action[ends])
        next_value[ends] = yield from self._values(frames, vector)
        return next_value

    def _values(self, frames: Tensor | None, vector: Tensor) -> Values:
        """Return the values (N,) of observations; in slices, also because the encoder's maps take much memory."""
        size, portions = self._config.batch_size, []
        for at, portion in zip(range(0, len(vector), size), torch.split(vector, size), strict=True):
            yield
            with torch.no_grad():
                seen = observation(self.encoder, None if frames is None else frames[at : at + size], portion)
                portions.append(self.critic(seen))
        values: npt.NDArray[np.float64] = torch.cat(portions).double().cpu().numpy()
        return values

    def _distribution(self, seen: Tensor) -> TanhGaussian:
        mean, log_std = self.actor(seen)
        return TanhGaussian.from_head(mean, log_std, self._config.log_std_low, self._config.log_std_high)

    def _random_order(self, count: int) -> Tensor:
        return torch.randperm(count, generator=self._generator, device=self._device)
