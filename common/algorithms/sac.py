"""Soft Actor-Critic (thesis section 3.2, algorithm 1)."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from common.algorithms.adam import Adam
from common.algorithms.base import Algorithm, Arrays, random_seeds
from common.algorithms.presets import SACConfig
from common.algorithms.upload import upload
from common.errors import ConfigError
from common.messages import PolicyWeights, TaskSpec
from common.minibatch import DeviceArray, Minibatch
from common.networks.distribution import TanhGaussian
from common.networks.encoder import Encoder
from common.networks.mlp import Actor, TwinQ
from common.networks.precision import Precision, wide_dtype
from common.networks.sizes import FEATURES, cropped_shape
from common.policies.unit_range import action_range, proprioception_range
from common.policies.weights import initial_parameters, pack_weights

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


class SAC(Algorithm):
    """Twin soft critics with targets, a reparameterised tanh-Gaussian actor, a learned temperature.

    What a variant of SAC has to name:

    - The encoder is trained by the critic loss; the actor loss does not reach it (thesis 4.2).
    - **Features of the observation are computed once per update**, before the critic step; the actor loss sees the
      features from before that step, and the critics from after it.
    - The target critics have a target encoder of their own (``encoder_tau``).
    - Only ``terminated`` cuts the bootstrap. A time limit is not part of the task, so its last observation has a
      value like any other.
    - It learns from the applied action, clipped and delayed as it may be, not from the one the policy chose.
    """

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
        self.updates = 0
        self._config = config
        self._device = torch.device(device)
        self._dtype = dtype
        self._float: type[np.float32] | type[np.float64] = np.float64 if dtype == torch.float64 else np.float32
        self._actions = action_range(spec)
        self._proprioception = proprioception_range(spec)
        self._strides = config.encoder_strides if spec.has_camera else ()
        self._generator = torch.Generator(self._device)
        rng, noise_seed = random_seeds(seed)
        self._generator.manual_seed(noise_seed)
        self._noise = noise or self._random_noise
        self._metrics: dict[str, Tensor] = {}

        sizes = spec.dimensions
        vector_size = sizes.P + sizes.A
        wide = wide_dtype(precision, self._device, dtype)
        self.encoder: Encoder | None = None
        if spec.has_camera:
            vector_size += FEATURES
            self.encoder = Encoder(*cropped_shape(spec), config.encoder_strides, dtype=dtype, wide=wide)
        self.actor = Actor(vector_size, config.hidden_size, sizes.A, dtype=dtype, wide=wide)
        self.critic = TwinQ(vector_size + sizes.A, config.hidden_size, rng, dtype=dtype, wide=wide)
        self.log_temperature = nn.Parameter(
            torch.tensor(math.log(config.initial_temperature), dtype=dtype, device=self._device)
        )
        initial = initial_parameters(
            spec,
            config.hidden_size,
            config.encoder_strides,
            np.random.default_rng(seed),  # as the actor draws its own: both begin with the same policy
            zero_initialised_head=config.zero_initialised_head,
        )
        with torch.no_grad():
            for name, parameter in self._policy_parameters().items():
                parameter.copy_(torch.from_numpy(initial[name]))
        for module in filter(None, (self.encoder, self.actor, self.critic)):
            module.to(self._device)
        self.target_encoder = copy.deepcopy(self.encoder)
        self.target_critic = copy.deepcopy(self.critic)
        self.target_entropy = float(-sizes.A if config.target_entropy is None else config.target_entropy)

        self._critic_adam = Adam(self._named("critic", "encoder"), config.critic_lr, config.adam_betas)
        self._actor_adam = Adam(self._named("actor"), config.actor_lr, config.adam_betas)
        self._temperature_adam = Adam(
            {"log_temperature": self.log_temperature}, config.temperature_lr, config.temperature_betas
        )

    def update(self, minibatch: Minibatch) -> None:
        """One gradient step for critics and encoder, actor, and temperature; then the targets move."""
        batch = self._batch(minibatch)
        observation = _observation(self.encoder, batch.frames, batch.vector)
        self._update_critic(batch, observation)
        self._update_actor_and_temperature(observation.detach())
        self._move_targets()
        self.updates += 1

    def _update_critic(self, batch: _Batch, observation: Tensor) -> None:
        """Descend eq. 3.9; the value of the next observation is that of eq. 3.8, the smaller of two critics'."""
        with torch.no_grad():
            next_observation = _observation(self.encoder, batch.next_frames, batch.next_vector)
            next_action, next_log_probability = self._act(next_observation)
            target_observation = (
                next_observation
                if self.target_encoder is None
                else _observation(self.target_encoder, batch.next_frames, batch.next_vector)
            )
            next_q = self.target_critic(target_observation, next_action).amin(dim=0)
            next_value = next_q - self.log_temperature.exp() * next_log_probability
            target = batch.reward + self._config.discount * (1.0 - batch.terminated) * next_value
        q = self.critic(observation, batch.action)
        loss = (q - target).square().mean(dim=1).sum()
        self._critic_adam.minimise(loss)
        self._metrics |= {"critic_loss": loss.detach(), "mean_q": q.detach().mean()}

    def _update_actor_and_temperature(self, observation: Tensor) -> None:
        """Descend eq. 3.13, then move the temperature so that the entropy approaches its target."""
        action, log_probability = self._act(observation)
        q = self.critic(observation, action, frozen=True).amin(dim=0)
        temperature = self.log_temperature.exp()
        actor_loss = (temperature.detach() * log_probability - q).mean()
        entropy = -log_probability.detach().mean()
        temperature_loss = temperature * (entropy - self.target_entropy)
        self._actor_adam.minimise(actor_loss)
        self._temperature_adam.minimise(temperature_loss)
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

    def _act(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """(B, vector) -> actions (B, A) in [-1, 1] and their log-densities (B,)."""
        mean, log_std = self.actor(observation)
        config = self._config
        distribution = TanhGaussian.from_head(mean, log_std, config.log_std_low, config.log_std_high)
        return distribution.act(self._noise(*mean.shape))

    def _random_noise(self, rows: int, columns: int) -> Tensor:
        return torch.randn(rows, columns, generator=self._generator, dtype=self._dtype, device=self._device)

    def metrics(self) -> dict[str, float]:
        """See :class:`Algorithm`."""
        return {name: float(value) for name, value in self._metrics.items()}

    def policy_weights(self, version: int, dtype: str) -> PolicyWeights:
        """See :class:`Algorithm`."""
        parameters = {name: _array(value) for name, value in self._policy_parameters().items()}
        bounds = [self._config.log_std_low, self._config.log_std_high]
        return pack_weights(
            parameters | {"log_std_bounds": np.array(bounds)},
            version=version,
            updates=self.updates,
            algorithm="sac",
            hidden_size=self._config.hidden_size,
            encoder_strides=self._strides,
            dtype=dtype,
        )

    def state_dict(self) -> Arrays:
        """See :class:`Algorithm`."""
        return {name: _array(value).copy() for name, value in self._state().items()}

    def load_state_dict(self, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        """See :class:`Algorithm`; on another kind of device it goes on with other random numbers."""
        state = self._state()
        if _of_another_device(arrays.get("random_state"), state["random_state"]):
            arrays = {**arrays, "random_state": _array(state["random_state"])}
        for name in sorted(state.keys() | arrays.keys()):
            expected = list(state[name].shape) if name in state else "no such array"
            got = list(arrays[name].shape) if name in arrays else "no such array"
            if expected != got:
                raise ConfigError(f"checkpoint, {name}: expected {expected}, got {got}")
        with torch.no_grad():
            for name, tensor in state.items():
                tensor.copy_(torch.from_numpy(np.array(arrays[name])))
        self._generator.set_state(state["random_state"])
        self.updates = int(state["updates"])

    def _state(self) -> dict[str, Tensor]:
        """Return everything an update reads and writes: tensors by name, not copies, except the last two."""
        modules = ("encoder", "actor", "critic", "target_encoder", "target_critic")
        state: dict[str, Tensor] = dict(self._named(*modules))
        state["log_temperature"] = self.log_temperature
        for owner in ("critic", "actor", "temperature"):
            adam: Adam = getattr(self, f"_{owner}_adam")
            state |= {f"{owner}_adam.{name}": value for name, value in adam.state().items()}
        state["random_state"] = self._generator.get_state()
        state["updates"] = torch.tensor(self.updates, dtype=torch.int64)
        return state

    def _named(self, *modules: str) -> dict[str, nn.Parameter]:
        """Return the parameters of some of this object's networks, by names like ``encoder.0.weight``."""
        return {
            f"{prefix}.{name}": parameter
            for prefix in modules
            if getattr(self, prefix) is not None
            for name, parameter in getattr(self, prefix).named_parameters()
        }

    def _policy_parameters(self) -> dict[str, nn.Parameter]:
        return self._named("encoder", "actor")

    def _batch(self, minibatch: Minibatch) -> _Batch:
        to_tensor = self._to_tensor
        proprioception = self._proprioception.to_unit(minibatch.proprioception, self._float)
        previous_action = self._actions.to_unit(minibatch.previous_action, self._float)
        action = self._actions.to_unit(minibatch.action, self._float)
        next_proprioception = self._proprioception.to_unit(minibatch.next_proprioception, self._float)
        return _Batch(
            frames=None if minibatch.frames is None else to_tensor(minibatch.frames),
            vector=to_tensor(np.concatenate([proprioception, previous_action], axis=1)),
            action=to_tensor(action),
            reward=to_tensor(minibatch.reward.astype(self._float)),
            terminated=to_tensor(minibatch.terminated.astype(self._float)),
            next_frames=None if minibatch.next_frames is None else to_tensor(minibatch.next_frames),
            next_vector=to_tensor(np.concatenate([next_proprioception, action], axis=1)),
        )

    def _to_tensor(self, array: npt.NDArray[Any] | DeviceArray) -> Tensor:
        if isinstance(array, np.ndarray):
            return upload(array, self._device)
        return torch.as_tensor(array, device=self._device)


def _observation(encoder: Encoder | None, frames: Tensor | None, vector: Tensor) -> Tensor:
    """Return what actor and critics see, (B, [64] + P + A): encoder features, then the rest of the observation."""
    if encoder is None or frames is None:
        return vector
    return torch.cat([encoder(frames), vector], dim=1)


def _move(target: nn.Module, source: nn.Module, tau: float) -> None:
    """target <- tau source + (1 - tau) target (algorithm 1)."""
    torch._foreach_lerp_(list(target.parameters()), list(source.parameters()), tau)


def _of_another_device(random_state: npt.NDArray[Any] | None, own: Tensor) -> bool:
    """True if a generator's state is one, but not of this device: a CPU's has 5056 bytes, a GPU's 16."""
    return (
        random_state is not None
        and random_state.dtype == np.uint8
        and random_state.ndim == 1
        and 0 < random_state.size != own.numel()
    )


def _array(tensor: Tensor) -> npt.NDArray[Any]:
    array: npt.NDArray[Any] = tensor.detach().cpu().numpy()
    return array
