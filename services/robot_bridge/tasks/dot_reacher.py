"""Dot-Reacher (thesis 8.1.4): bring a dot to rest, nearly, in a box in the middle. -1 a step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from common.config import setting
from common.messages import Float32Array, TaskSpec
from services.robot_bridge.robots.dot import MAX_ACCELERATION, MAX_SPEED, POSITION_LIMIT, Dot
from services.robot_bridge.tasks.base import Outcome, SensorReading, Task

WORLD_SECONDS_PER_CYCLE = 0.2


@dataclass(frozen=True)
class DotReacherSettings:
    """Keys of ``[task]``."""

    target_half_width: float = setting(0.25, low=0.01, high=0.9)
    """The target is the box |x|, |y| <= this."""
    target_speed: float = setting(0.2, low=0.0)
    """The dot counts as arrived at no more than this speed per axis; 0 means at any speed."""
    time_limit: int = setting(50, low=1)
    """Action cycles before the dot is reset."""
    reset_steps: int = setting(10, low=0)
    """Action cycles that a reset takes."""
    action_cycle_time: float = setting(0.04, low=0.001, high=10.0)
    """Seconds."""


class DotReacher(Task):
    """The state variant: position and velocity are observed."""

    SETTINGS = DotReacherSettings
    PRESETS: ClassVar = {
        "demo": {},
        "thesis": {"target_speed": 0.15, "reset_steps": 20},
    }

    def __init__(
        self, settings: DotReacherSettings, *, name: str, preset: str, pacing: str, rng: np.random.Generator
    ) -> None:
        self._settings = settings
        self._rng = rng
        self._dot = Dot()
        self._now_ns: int | None = None
        self.spec = TaskSpec(
            task=name,
            preset=preset,
            pacing=pacing,
            action_low=np.full(2, -MAX_ACCELERATION, np.float32),
            action_high=np.full(2, MAX_ACCELERATION, np.float32),
            action_cycle_time_s=settings.action_cycle_time,
            world_seconds_per_cycle=WORLD_SECONDS_PER_CYCLE,
            time_limit_steps=settings.time_limit,
            reset_steps=settings.reset_steps,
            has_goal=True,
            **self._observation_spec(),
        )
        self._world_seconds_per_ns = WORLD_SECONDS_PER_CYCLE / round(settings.action_cycle_time * 1e9)

    def begin_episode(self) -> None:
        self.begin_attempt()  # The target never moves.

    def begin_attempt(self) -> None:
        while True:
            position = self._rng.uniform(-POSITION_LIMIT, POSITION_LIMIT, 2)
            if not self._inside(position):
                self._dot.place(position)
                return

    def command(self, action: Float32Array) -> None:
        self._dot.command(action)

    def stop(self) -> None:
        self._dot.stop()

    def advance_to(self, now_ns: int) -> None:
        if self._now_ns is not None and now_ns > self._now_ns:
            self._dot.advance((now_ns - self._now_ns) * self._world_seconds_per_ns)
        self._now_ns = now_ns if self._now_ns is None else max(now_ns, self._now_ns)

    def read(self) -> SensorReading:
        return SensorReading(
            frames=np.zeros((0, 0, 0, 0), np.uint8),
            frame_ids=np.zeros(0, np.int64),
            frame_capture_ns=np.zeros(0, np.int64),
            proprioception=np.concatenate([self._dot.position, self._dot.velocity]).astype(np.float32),
        )

    def outcome(self) -> Outcome:
        speed_limit = self._settings.target_speed or np.inf
        slow = bool((np.abs(self._dot.velocity) <= speed_limit).all())
        return Outcome(reward=-1.0, terminated=slow and self._inside(self._dot.position))

    def _inside(self, position: np.ndarray) -> bool:
        return bool((np.abs(position) <= self._settings.target_half_width).all())

    def _observation_spec(self) -> dict[str, Any]:
        """The part of the TaskSpec that says what is observed."""
        limits = np.array([POSITION_LIMIT, POSITION_LIMIT, MAX_SPEED, MAX_SPEED], np.float32)
        return {
            "algorithm_presets": {"sac": "dot_reacher", "ppo": "dot_reacher"},
            "proprioception_low": -limits,
            "proprioception_high": limits,
            "frame_shape": np.zeros(3, np.int64),
            "frame_stack": 0,
            "crop_margin": np.zeros(2, np.int64),
        }
