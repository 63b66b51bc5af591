"""Acting in NumPy: for a single observation twice as fast as torch, and torch need not be installed.

Wide networks without camera skip the units that are zero (:mod:`common.policies.sparse_layer`); they import LLVM.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import exp, log, log1p, pi, sqrt, tanh

import numpy as np

from common.messages import Float32Array, TaskSpec
from common.policies.base import ChosenAction, Observation
from common.policies.sparse_layer import SparseLayer, is_worthwhile
from common.policies.unit_range import UnitRange, action_range, vector_range

_LOG_2 = log(2.0)
_LOG_DENSITY_OFFSET = log(sqrt(2.0 * pi)) + 2.0 * _LOG_2
"""What is subtracted from the log-density of each dimension whatever the draw."""

Layer = Callable[[Float32Array], Float32Array]


class DenseLayer:
    """Bias + weight * inputs, for one vector of inputs."""

    def __init__(self, weight: Float32Array, bias: Float32Array) -> None:
        """Take over ``weight`` (outputs, inputs) and ``bias`` (outputs,)."""
        self._weight, self._bias = weight, bias

    def __call__(self, inputs: Float32Array) -> Float32Array:
        """(inputs,) -> (outputs,)."""
        result: Float32Array = self._weight.dot(inputs)
        result += self._bias
        return result


class NumpyActor:
    """The actor network for one observation."""

    def __init__(self, spec: TaskSpec, parameters: Mapping[str, Float32Array]) -> None:
        """Take over ``parameters``, named and shaped as in :mod:`common.policies.weights`."""
        first, hidden, head = ((parameters[f"actor.{i}.weight"], parameters[f"actor.{i}.bias"]) for i in range(3))
        self._first: Layer = DenseLayer(*first)
        self._hidden: Layer = DenseLayer(*hidden)
        self._head: Layer = DenseLayer(*head)
        if not spec.has_camera:
            # Few columns: the other way round the product takes half the time. With the encoder's features there are
            # so many that it saves less than turning them round takes. With camera, a sparse layer would save a
            # twentieth of an action's time, and treble a policy's way from the learner's parameters to the actor's.
            self._first = DenseLayer(np.asfortranarray(first[0]), first[1])
            if is_worthwhile(len(hidden[0])):
                self._hidden = SparseLayer(*hidden)
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
        for layer in (self._first, self._hidden):
            hidden = layer(hidden)
            np.maximum(hidden, 0.0, out=hidden)
        return choose(self._head(hidden), self._log_std_range, self._actions, rng, deterministic)


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
