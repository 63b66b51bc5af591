"""Between physical units and the [-1, 1] that networks see."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from common.errors import ConfigError
from common.messages import Float32Array, TaskSpec


class UnitRange:
    """The affine map that takes ``low`` to -1 and ``high`` to +1, element by element; nothing is clipped."""

    def __init__(self, low: Float32Array, high: Float32Array, name: str) -> None:
        if low.shape != high.shape or not np.all(low < high):
            raise ConfigError(f"{name}: expected low < high in each element, got {low} and {high}")
        # In float64, so that whatever precision the learner works in gets the same map.
        wide_low, wide_high = low.astype(np.float64), high.astype(np.float64)
        self._centre = (wide_high + wide_low) / 2
        self._half = (wide_high - wide_low) / 2
        self._centre_32 = self._centre.astype(np.float32)
        self._half_32 = self._half.astype(np.float32)

    def to_unit(self, physical: Float32Array, dtype: npt.DTypeLike = np.float32) -> npt.NDArray[Any]:
        """(..., N) in physical units -> (..., N) of ``dtype``, float32 or float64."""
        if dtype == np.float32:
            return (physical - self._centre_32) / self._half_32
        return (physical - self._centre) / self._half

    def to_physical(self, unit: Float32Array) -> Float32Array:
        """(..., N) in units of the range -> (..., N) in physical units."""
        return unit * self._half_32 + self._centre_32


def action_range(spec: TaskSpec) -> UnitRange:
    """Return the map of the task's actions."""
    return _range(_bytes(spec.action_low), _bytes(spec.action_high), "action bounds")


def proprioception_range(spec: TaskSpec) -> UnitRange:
    """Return the map of the task's proprioception."""
    return _range(_bytes(spec.proprioception_low), _bytes(spec.proprioception_high), "proprioception bounds")


def vector_range(spec: TaskSpec) -> UnitRange:
    """Return the map of the task's proprioception and, behind it, its actions."""
    return _range(
        _bytes(spec.proprioception_low) + _bytes(spec.action_low),
        _bytes(spec.proprioception_high) + _bytes(spec.action_high),
        "proprioception and action bounds",
    )


@cache
def _range(low: bytes, high: bytes, name: str) -> UnitRange:
    """Return the map between float32 bounds: made once, not for each policy of a task."""
    return UnitRange(np.frombuffer(low, np.float32), np.frombuffer(high, np.float32), name)


def _bytes(values: Float32Array) -> bytes:
    return np.asarray(values, np.float32).tobytes()
