"""Configuration of replay."""

from __future__ import annotations

from dataclasses import dataclass

from common.config import setting
from common.run_settings import AlgorithmSettings, ClockSettings, RunSettings, TransportSettings


@dataclass(frozen=True)
class ReplaySettings:
    """``[replay]``: the experience ring and its sampling."""

    access: str = setting("map", choices=("map", "arrays"))
    """``map``: the learner maps the ring's file (same computer). ``arrays``: minibatches travel as arrays."""
    max_surplus: float = setting(100.0, low=1.0)
    """Unspent updates that are kept at most; a learner that comes late does not catch up beyond this."""
    frames_per_row: float = setting(1.25, low=0.1, high=16.0)
    """Camera frames the ring has room for, per row."""
    message_mib: float = setting(16.0, low=0.1, high=32.0)
    """Largest minibatch message of ``arrays``, MiB."""


@dataclass(frozen=True)
class ReplayConfig:
    """``replay.toml``."""

    run: RunSettings
    transport: TransportSettings
    clock: ClockSettings
    algorithm: AlgorithmSettings
    replay: ReplaySettings
