"""Configuration of the robot bridge."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from common.config import setting
from common.errors import ConfigError
from common.frame_encoding import FrameEncoding
from common.run_settings import ClockSettings, JournalSettings, RunSettings, TransportSettings


@dataclass(frozen=True)
class TaskSettings:
    """``[task]``: what is to be learnt. Other keys of the section override the task's own settings."""

    name: str = setting()
    """Task id, a key of the task table."""
    preset: str = setting("")
    """Task preset; empty takes the task's default."""
    overrides: dict[str, Any] = setting(rest=True)


@dataclass(frozen=True)
class TaskTable:
    """``[tasks]``: more rows for the task table, ``id = "module:Class"``."""

    rows: dict[str, Any] = setting(rest=True)


@dataclass(frozen=True)
class CameraSettings:
    """``[camera]``: what a task sees through that has no camera of its own. Other keys are the camera's settings."""

    name: str = setting("")
    """Kind of camera, a key of the camera table; empty: none."""
    overrides: dict[str, Any] = setting(rest=True)

    def __post_init__(self) -> None:
        if self.overrides and not self.name:
            keys = ", ".join(sorted(self.overrides))
            raise ConfigError(f"{keys}: expected camera.name as well, the kind of camera that is set so")


@dataclass(frozen=True)
class CameraTable:
    """``[cameras]``: more rows for the camera table, ``name = "module:Class"``."""

    rows: dict[str, Any] = setting(rest=True)


@dataclass(frozen=True)
class RobotBridgeSettings(JournalSettings):
    """``[robot_bridge]``: the action cycle."""

    steps: int = setting(7000, low=1)
    """Action cycles of the run, resets included; then the bridge says that the run is finished."""
    pacing: str = setting("realtime", choices=("realtime", "lockstep"))
    """``realtime``: cycles follow the clock. ``lockstep``: each cycle waits for its action, the world with it."""
    on_missing_action: str = setting("hold", choices=("hold", "zero", "wait"))
    """At the end of a cycle without an action: ``hold`` the last command, command ``zero``, or ``wait`` for it."""
    encoding: str = setting("raw", choices=tuple(FrameEncoding))
    """How camera frames travel: ``raw``, ``zstd`` (lossless; for drawn or rendered images) or ``jpeg444`` (a camera's,
    about a tenth of the bytes; actor and learner see what it leaves)."""
    stop_after: float = setting(0.5, low=0.01, high=60.0)
    """The watchdog stops the robot after this long without a fresh action, seconds."""
    camera_stall_after: float = setting(0.5, low=0.01, high=60.0)
    """An attempt is truncated when the newest camera frame is older than this, seconds, and none begins before the
    camera is back; for tasks with a camera that can stall."""
    real_time_priority: bool = setting(True)
    """Run before ordinary processes, where the system allows it; not in lockstep."""
    peer_grace: float = setting(5.0, low=0.1, high=3600.0)
    """No attempt starts when actor or replay has not been heard of for this long, seconds."""


@dataclass(frozen=True)
class RobotBridgeConfig:
    """``robot_bridge.toml``."""

    run: RunSettings
    transport: TransportSettings
    clock: ClockSettings
    task: TaskSettings
    tasks: TaskTable
    camera: CameraSettings
    cameras: CameraTable
    robot_bridge: RobotBridgeSettings
