"""Configuration of the learner."""

from __future__ import annotations

import re
from dataclasses import dataclass

from common.config import setting
from common.errors import ConfigError
from common.run_settings import AlgorithmSettings, ClockSettings, RunSettings, TransportSettings


def check_device_name(device: str) -> None:
    """Raise :class:`~common.errors.ConfigError` if ``device`` cannot be one; whether it is there, nobody knows yet."""
    if not re.fullmatch(r"cpu|cuda(:\d{1,2})?", device):
        raise ConfigError(f"device = {device!r}: expected cpu, cuda or cuda:N, N a GPU's number")


@dataclass(frozen=True)
class LearnerSettings:
    """``[learner]``: policy updates."""

    access: str = setting("map", choices=("map", "arrays"))
    """How minibatches come; the same as replay's."""
    device: str = setting("cpu")
    """Where updates run: ``cpu``, ``cuda``, or ``cuda:N`` for the GPU number N."""
    precision: str = setting("auto", choices=("auto", "float32", "bfloat16"))
    """Of the convolutions and the wide layer; ``auto`` takes bfloat16 where the processor or the GPU has it."""
    frames: str = setting("auto", choices=("auto", "host", "device"))
    """Where the ring's frames are gathered from, with access ``map``: the mapped file, or a copy on the device, which
    needs as much of its memory; ``auto`` is ``device`` on a GPU."""
    threads: int = setting(0, low=0, high=256)
    """Threads of an update; 0 leaves one core to the rest."""
    nice: int = setting(10, low=0, high=19)
    """Added to the process's niceness, so that updates never delay the bridge."""
    min_update_s: float = setting(0.0, low=0.0, high=60.0)
    """Least time that an update takes, seconds: stands for a slower computer."""
    prefetch: int = setting(2, low=1, high=16)
    """Minibatches asked for ahead of need."""
    push_share: float = setting(1.0, low=0.001, high=1.0)
    """Share of the network's rate towards the actor that policies may take, by what the last push took; the newest
    policy is sent. 1: each as soon as the one before has arrived."""
    checkpoint_s: float = setting(30.0, low=1.0)
    """Period of the checkpoint that a restarted learner goes on from, seconds."""

    def __post_init__(self) -> None:
        check_device_name(self.device)

    @property
    def frames_on_device(self) -> bool:
        """True if minibatches are to be gathered from frames on the device."""
        return self.frames == "device" or (self.frames == "auto" and self.device != "cpu")


@dataclass(frozen=True)
class LearnerConfig:
    """``learner.toml``."""

    run: RunSettings
    transport: TransportSettings
    clock: ClockSettings
    algorithm: AlgorithmSettings
    learner: LearnerSettings
