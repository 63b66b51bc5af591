"""Acting in NumPy: for a single observation twice as fast as torch, and torch need not be installed."""

from __future__ import annotations

from collections.abc import Mapping
from math import exp, log, log1p, pi, sqrt, tanh

import numpy as np

from common.messages import Float32Array, TaskSpec
from common.policies.base import ChosenAction, Observation
from common.policies.unit_range import UnitRange, action_range, vector_range

_LOG_2 = log(2.0)
_LOG_DENSITY_OFFSET = log(sqrt(2.0 * pi)) + 2.0 * _LOG_2
"""What is subtracted from the log-density of each dimension whatever the draw."""


class NumpyActor:
    """The actor network for one observation."""

    def __init__(self, spec: TaskSpec, parameters: Mapping[str, Float32Array]) -> None:
        """Take over ``parameters``, named and shaped as in :mod:`common.policies.weights`."""
        layers = [(parameters[f"actor.{i}.weight"], parameters[f"actor.{i}.bias"]) for i in range(3)]
        self._first, self._hidden, self._head = layers
        if not spec.has_camera:
            # Few columns: the other way round the product takes half the time. With the encoder's features there are
            # so many that it saves less than turning them round takes.
            self._first = (np.asfortranarray(layers[0][0]), layers[0][1])
        low, high = parameters["log_std_bounds"].tolist()
        self._log_std_range = (low + high) / 2.0, (high - low) / 2.0
        self._actions = action_range(spec)
        self._vector = vector_range(spec)

    def act(
        self,
        features: Float32Array | None,
        observation: Observation,
        rng: np.random.Generator,
        deterministic: bool,
    ) -> ChosenAction:
        """Return an action for encoder features (64,), or None without camera, and the rest of the observation."""
        vector = self._vector.to_unit(np.concatenate([observation.proprioception, observation.previous_action]))
        hidden = vector if features is None else np.concatenate([features, vector])
        for weight, bias in (self._first, self._hidden):
            hidden = weight.dot(hidden)
            hidden += bias
            np.maximum(hidden, 0.0, out=hidden)
        weight, bias = self._head
        head = weight.dot(hidden)
        head += bias
        return choose(head, self._log_std_range, self._actions, rng, deterministic)


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
    log_std_range: tuple[float, float],
    actions: UnitRange,
    rng: np.random.Generator,
    deterministic: bool,
) -> ChosenAction:
    """Return an action of the tanh-Gaussian; its batched twin is :mod:`common.networks.distribution`.

    Args:
        head: (2 A,), mean and unbounded log standard deviation.
        log_std_range: centre and half width of what tanh of the second half is mapped to.
        actions: the task's action bounds.
        rng: source of the noise; untouched if ``deterministic``.
        deterministic: take the mean.
    """
    # In Python's own numbers: for the few dimensions of an action, array operations take twice as long.
    size = len(head) // 2
    values: list[float] = head.tolist()
    noise = [0.0] * size if deterministic else rng.standard_normal(size, np.float32).tolist()
    centre, half = log_std_range
    unit, log_probability = [], 0.0
    for mean, unbounded_log_std, draw in zip(values[:size], values[size:], noise, strict=True):
        log_std = centre + half * tanh(unbounded_log_std)
        before_tanh = mean + exp(log_std) * draw
        # log(1 - tanh(u)^2) = 2 (log 2 - |u| - log(1 + e^(-2 |u|))): the left side is -inf from |u| = 19 on.
        magnitude = abs(before_tanh)
        slope = 2.0 * (magnitude + log1p(exp(-2.0 * magnitude)))
        log_probability += slope - 0.5 * draw * draw - log_std - _LOG_DENSITY_OFFSET
        unit.append(tanh(before_tanh))
    return ChosenAction(actions.to_physical(np.array(unit, np.float32)), log_probability)
