"""What a policy is to whoever acts with it; without torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from common.messages import Float32Array, UInt8Array


@dataclass(frozen=True)
class Observation:
    """What one action is computed from, physical units."""

    frames: UInt8Array | None
    """(S, H, W, C): the stacked camera frames, uncropped, oldest first; None without camera."""
    proprioception: Float32Array
    """(P,)"""
    previous_action: Float32Array
    """(A,): command in force before the observation; zeros at the start of an attempt."""


@dataclass(frozen=True)
class ChosenAction:
    """A policy's answer."""

    action: Float32Array
    """(A,), physical units."""
    log_probability: float
    """Log-density of the action in the normalised action space [-1, 1]^A."""


class Policy(Protocol):
    """Weights frozen at one version; a newer version is a new policy, swapped in between two actions."""

    version: int
    """Count of pushes; 0 is the initial policy."""

    def act(self, observation: Observation, rng: np.random.Generator, deterministic: bool = False) -> ChosenAction:
        """Return an action drawn with ``rng``, or the distribution's centre, tanh of its mean."""
        ...
