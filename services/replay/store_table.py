"""Which store an algorithm learns from."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from common.algorithms.config import AlgorithmConfig, OffPolicyConfig, OnPolicyConfig
from common.errors import ConfigError
from common.frame_ring import RingWriter
from services.replay.rollout import RolloutStore
from services.replay.store import ExperienceStore
from services.replay.transitions import TransitionStore


def open_store(
    config: AlgorithmConfig,
    ring: RingWriter,
    *,
    max_surplus: float,
    rng: np.random.Generator,
    learner_version: Callable[[], int],
) -> ExperienceStore:
    """Return the store that an algorithm learns from.

    Args:
        config: the algorithm's settings; their class decides.
        ring: what the store names rows of.
        max_surplus: see :class:`UpdateBudget`.
        rng: for drawing transitions.
        learner_version: the newest policy version that the learner has told of.
    """
    match config:
        case OffPolicyConfig():
            return TransitionStore(ring, config, max_surplus, rng)
        case OnPolicyConfig():
            return RolloutStore(ring, config.rollout_length, learner_version)
    raise ConfigError(f"no store for {type(config).__name__}: expected an OffPolicyConfig or an OnPolicyConfig")
