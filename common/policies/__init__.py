"""Acting: policies from their weights. Importing this package needs no torch, nor does a policy without camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from common.errors import ConfigError, MessageError
from common.messages import Float32Array, PolicyWeights, TaskSpec
from common.policies.base import ChosenAction, Observation, Policy
from common.policies.numpy_policy import NumpyPolicy
from common.policies.weights import (
    initial_parameters,
    pack_weights,
    parameter_layout,
    pending_actions_of,
    unpack_weights,
)
from common.policies.xxh3 import compile_take_in

__all__ = [
    "ChosenAction",
    "Observation",
    "Policy",
    "initial_policy",
    "pack_weights",
    "pending_actions_of",
    "policy_from_weights",
]


def initial_policy(
    spec: TaskSpec,
    hidden_size: int,
    encoder_strides: Sequence[int],
    seed: int,
    *,
    zero_initialised_head: bool = True,
) -> Policy:
    """Return version 0, the policy before any learning: N(0, 1) before the tanh, whatever the observation.

    Args:
        spec: the task.
        hidden_size: width of the hidden layers.
        encoder_strides: strides of the encoder's convolutions; unused without camera.
        seed: of the random layers; a learner with this seed starts with the same policy.
        zero_initialised_head: False: another distribution, which depends on seed and observation.
    """
    parameters = initial_parameters(
        spec,
        hidden_size,
        encoder_strides,
        np.random.default_rng(seed),
        zero_initialised_head=zero_initialised_head,
    )
    if spec.has_camera:
        compile_take_in()  # compiled now, not when the first policy comes
    return _policy(spec, parameters, 0, encoder_strides)


def policy_from_weights(spec: TaskSpec, weights: PolicyWeights) -> Policy:
    """Return the policy a learner pushed.

    Raises:
        MessageError: the weights are damaged or belong to another network than the task's.
    """
    strides = weights.encoder_strides.tolist()
    if spec.has_camera != bool(strides) or not all(1 <= stride <= 4 for stride in strides):
        raise MessageError(f"policy weights {weights.version}: encoder strides {strides} do not fit {spec.task}")
    parameters = unpack_weights(weights, parameter_layout(spec, weights.hidden_size, strides))
    try:
        return _policy(spec, parameters, weights.version, strides)
    except ConfigError as error:
        raise MessageError(f"policy weights {weights.version}: {error}") from error


def _policy(
    spec: TaskSpec, parameters: Mapping[str, Float32Array], version: int, encoder_strides: Sequence[int]
) -> Policy:
    if not spec.has_camera:
        return NumpyPolicy(spec, parameters, version)
    from common.policies.torch_policy import TorchPolicy

    return TorchPolicy(spec, parameters, version, encoder_strides)
