"""Configuration of the actor."""

from __future__ import annotations

from dataclasses import dataclass

from common.config import setting
from common.run_settings import AlgorithmSettings, JournalSettings, RunSettings, TransportSettings


@dataclass(frozen=True)
class ActorSettings(JournalSettings):
    """``[actor]``: action computation."""

    threads: int = setting(1, low=1, high=64)
    """Threads of one policy evaluation."""
    real_time_priority: bool = setting(True)
    """Run before ordinary processes, where the system allows it; not in lockstep."""
    min_inference_s: float = setting(0.0, low=0.0, high=10.0)
    """Least time that computing an action takes, seconds: stands for a slower computer. Nothing else waits for it."""
    lockstep_surplus: float = setting(2.0, low=0.0)
    """In lockstep, the actor waits while replay has more unspent updates than this."""


@dataclass(frozen=True)
class ActorConfig:
    """``actor.toml``."""

    run: RunSettings
    transport: TransportSettings
    algorithm: AlgorithmSettings
    actor: ActorSettings
