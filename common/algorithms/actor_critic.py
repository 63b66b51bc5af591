"""What algorithms with an actor and a critic have in common: networks of the policy, inputs, checkpoint."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from common.algorithms.adam import Adam
from common.algorithms.base import Algorithm, Arrays
from common.algorithms.config import AlgorithmConfig
from common.algorithms.upload import upload
from common.errors import ConfigError, MessageError
from common.messages import Float32Array, TaskSpec
from common.minibatch import DeviceArray
from common.networks.encoder import Encoder
from common.networks.mlp import Actor
from common.networks.sizes import FEATURES, cropped_shape
from common.policies.unit_range import action_range, proprioception_range
from common.policies.weights import encode_weights, initial_parameters, prepare_encoding


class ActorCritic(Algorithm):
    """An actor behind an encoder, if there is a camera. The critics are the algorithm's own.

    An algorithm sets :attr:`adams` and says what its checkpoint has besides (:meth:`_state`).
    """

    NAME: ClassVar[str]
    """The algorithm's name in the table."""
    NETWORKS: ClassVar[tuple[str, ...]]
    """Attributes that are networks, or None without camera; ``encoder`` and ``actor`` are among them."""

    def __init__(
        self,
        spec: TaskSpec,
        config: AlgorithmConfig,
        *,
        seed: int,
        update_seed: int,
        device: str,
        wide: torch.dtype,
        dtype: torch.dtype,
    ) -> None:
        """Create the policy's networks on the CPU.

        Args:
            spec: the task.
            config: the algorithm's settings.
            seed: of the initial policy.
            update_seed: of the randomness in updates.
            device: torch device of the updates.
            wide: number format of convolutions and hidden-to-hidden layers.
            dtype: number format of the parameters.
        """
        self.updates = 0
        self._config = config
        self._device = torch.device(device)
        self._dtype, self._wide = dtype, wide
        self._float: type[np.float32] | type[np.float64] = np.float64 if dtype == torch.float64 else np.float32
        self._actions = action_range(spec)
        self._proprioception = proprioception_range(spec)
        self._strides = config.encoder_strides if spec.has_camera else ()
        prepare_encoding(self._strides, config.weights_dtype)
        self._generator = torch.Generator(self._device)
        self._generator.manual_seed(update_seed)
        self._metrics: dict[str, Tensor] = {}
        self.adams: dict[str, Adam] = {}
        self._log_std_bounds = np.array([config.log_std_low, config.log_std_high], np.float32)
        self._shared: dict[str, npt.NDArray[Any]] = {}

        sizes = spec.dimensions
        self.vector_size = sizes.P + sizes.A
        self.encoder: Encoder | None = None
        if spec.has_camera:
            self.vector_size += FEATURES
            self.encoder = Encoder(*cropped_shape(spec), config.encoder_strides, dtype=dtype, wide=wide)
        self.actor = Actor(self.vector_size, config.hidden_size, sizes.A, dtype=dtype, wide=wide)
        self._policy_parameters = self._named("encoder", "actor")
        initial = initial_parameters(
            spec,
            config.hidden_size,
            config.encoder_strides,
            np.random.default_rng(seed),  # as the actor draws its own: both begin with the same policy
            zero_initialised_head=config.zero_initialised_head,
        )
        with torch.no_grad():
            for name, parameter in self._policy_parameters.items():
                parameter.copy_(torch.from_numpy(initial[name]))

    def metrics(self) -> dict[str, float]:
        """See :class:`Algorithm`."""
        return {name: float(value) for name, value in self._metrics.items()}

    def encoded_policy(self, version: int, dtype: str) -> bytes:
        """See :class:`Algorithm`."""
        # A parameter that is not finite shows in the losses of the next update; that is a handful of numbers to look
        # at, not a million. One that has become so in the very last update is left to the receivers.
        for name, value in self.metrics().items():
            if not math.isfinite(value):
                raise MessageError(
                    f"after {self.updates} updates {name} is {value}: learning has diverged, nothing is pushed any more"
                )
        return encode_weights(
            self._policy_arrays() | {"log_std_bounds": self._log_std_bounds},
            version=version,
            updates=self.updates,
            algorithm=self.NAME,
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

    def _policy_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return the policy's parameters by name: on the CPU always the same arrays, whose memory they are."""
        if self._device.type == "cpu" and self._shared:
            return self._shared
        self._shared = {name: _array(value) for name, value in self._policy_parameters.items()}
        return self._shared

    def _state(self) -> dict[str, Tensor]:
        """Return everything an update reads and writes: tensors by name, not copies, except the last two."""
        state: dict[str, Tensor] = dict(self._named(*self.NETWORKS))
        for owner, adam in self.adams.items():
            state |= {f"{owner}_adam.{name}": value for name, value in adam.state().items()}
        state["random_state"] = self._generator.get_state()
        state["updates"] = torch.tensor(self.updates, dtype=torch.int64)
        return state

    def _named(self, *networks: str) -> dict[str, nn.Parameter]:
        """Return the parameters of some of this object's networks, by names like ``encoder.0.weight``."""
        return {
            f"{prefix}.{name}": parameter
            for prefix in networks
            if getattr(self, prefix) is not None
            for name, parameter in getattr(self, prefix).named_parameters()
        }

    def _random_noise(self, rows: int, columns: int) -> Tensor:
        return torch.randn(rows, columns, generator=self._generator, dtype=self._dtype, device=self._device)

    def _vector(self, proprioception: Float32Array, previous_action: Float32Array) -> Tensor:
        """Return (B, P + A): what an observation has besides its frames, in units of the task's ranges."""
        parts = [
            self._proprioception.to_unit(proprioception, self._float),
            self._actions.to_unit(previous_action, self._float),
        ]
        return self._to_tensor(np.concatenate(parts, axis=1))

    def _to_tensor(self, array: npt.NDArray[Any] | DeviceArray) -> Tensor:
        if isinstance(array, np.ndarray):
            return upload(array, self._device)
        return torch.as_tensor(array, device=self._device)


def observation(encoder: Encoder | None, frames: Tensor | None, vector: Tensor) -> Tensor:
    """Return what actor and critics see, (B, [64] + P + A): encoder features, then the rest of the observation."""
    if encoder is None or frames is None:
        return vector
    return torch.cat([encoder(frames), vector], dim=1)


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
