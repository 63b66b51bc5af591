"""Configuration of the learner."""

from __future__ import annotations

from dataclasses import dataclass

from common.config import setting
from common.run_settings import AlgorithmSettings, RunSettings, TransportSettings


@dataclass(frozen=True)
class LearnerSettings:
    """``[learner]``: policy updates."""

    access: str = setting("map", choices=("map", "arrays"))
    """How minibatches come; the same as replay's."""
    device: str = setting("cpu")
    """Where updates run: a torch device."""
    precision: str = setting("auto", choices=("auto", "float32", "bfloat16"))
    """Of the convolutions and the wide layer; ``auto`` takes bfloat16 where the processor has it."""
    threads: int = setting(0, low=0, high=256)
    """Threads of an update; 0 leaves one core to the rest."""
    nice: int = setting(10, low=0, high=19)
    """Added to the process's niceness, so that updates never delay the bridge."""
    prefetch: int = setting(2, low=1, high=16)
    """Minibatches asked for ahead of need."""
    checkpoint_s: float = setting(30.0, low=1.0)
    """Period of the checkpoint that a restarted learner goes on from, seconds."""


@dataclass(frozen=True)
class LearnerConfig:
    """``learner.toml``."""

    run: RunSettings
    transport: TransportSettings
    algorithm: AlgorithmSettings
    learner: LearnerSettings
