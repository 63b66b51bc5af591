"""Acting in NumPy: for a single observation twice as fast as torch, and torch need not be installed."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from common.messages import Float32Array, TaskSpec
from common.policies.base import ChosenAction, Observation
from common.policies.unit_range import UnitRange, action_range, proprioception_range

_LOG_SQRT_2_PI = 0.5 * math.log(2.0 * math.pi)
_LOG_2 = math.log(2.0)


class NumpyActor:
    """The actor network for one observation."""

    def __init__(self, spec: TaskSpec, parameters: Mapping[str, Float32Array]) -> None:
        """Take over ``parameters``, named and shaped as in :mod:`common.policies.weights`."""
        self._layers = [(parameters[f"actor.{i}.weight"], parameters[f"actor.{i}.bias"]) for i in range(3)]
        low, high = parameters["log_std_bounds"].tolist()
        self._log_std_bounds = (float(low), float(high))
        self._actions = action_range(spec)
        self._proprioception = proprioception_range(spec)

    def act(
        self,
        features: Float32Array | None,
        observation: Observation,
        rng: np.random.Generator,
        deterministic: bool,
    ) -> ChosenAction:
        """Return an action for encoder features (64,), or None without camera, and the rest of the observation."""
        parts = [] if features is None else [features]
        parts.append(self._proprioception.to_unit(observation.proprioception))
        parts.append(self._actions.to_unit(observation.previous_action))
        hidden = np.concatenate(parts)
        for weight, bias in self._layers[:2]:
            hidden = weight @ hidden
            hidden += bias
            np.maximum(hidden, 0.0, out=hidden)
        weight, bias = self._layers[2]
        head = weight @ hidden + bias
        return choose(head, self._log_std_bounds, self._actions, rng, deterministic)


class NumpyPolicy:
    """Policy of a task without camera."""

    def __init__(self, spec: TaskSpec, parameters: Mapping[str, Float32Array], version: int) -> None:
        """Take over ``parameters``, named and shaped as in :mod:`common.policies.weights`."""
        self.version = version
        self._actor = NumpyActor(spec, parameters)

    def act(self, observation: Observation, rng: np.random.Generator, deterministic: bool = False) -> ChosenAction:
        """See :class:`common.policies.base.Policy`."""
        return self._actor.act(None, observation, rng, deterministic)


def choose(
    head: Float32Array,
    log_std_bounds: tuple[float, float],
    actions: UnitRange,
    rng: np.random.Generator,
    deterministic: bool,
) -> ChosenAction:
    """Return an action of the tanh-Gaussian; its batched twin is :mod:`common.networks.distribution`.

    Args:
        head: (2 A,), mean and unbounded log standard deviation.
        log_std_bounds: what tanh of the second half is mapped to.
        actions: the task's action bounds.
        rng: source of the noise; untouched if ``deterministic``.
        deterministic: take the mean.
    """
    size = len(head) // 2
    mean = head[:size]
    low, high = log_std_bounds
    log_std = low + 0.5 * (high - low) * (np.tanh(head[size:]) + 1.0)
    noise = np.zeros(size, np.float32) if deterministic else rng.standard_normal(size, np.float32)
    before_tanh = mean + np.exp(log_std) * noise
    log_gaussian = -0.5 * noise * noise - log_std - _LOG_SQRT_2_PI
    # log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2 u)): the left side is -inf in float32 from |u| = 9 on.
    log_slope = 2.0 * (_LOG_2 - before_tanh - np.logaddexp(0.0, -2.0 * before_tanh))
    log_probability = float((log_gaussian - log_slope).sum())
    return ChosenAction(actions.to_physical(np.tanh(before_tanh)), log_probability)
