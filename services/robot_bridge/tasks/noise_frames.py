"""Noise frames of a real camera's size: a load for links and buffers, and a check of what arrives.

Noise cannot be compressed, and each frame carries its id, so that whoever receives it can tell which one it is. With a
``[camera]``, its frames take the place of the noise: a check that the camera keeps up. There is nothing to learn.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from common.config import setting
from common.messages import Float32Array, TaskSpec, UInt8Array
from services.robot_bridge.cameras import Camera, PictureSize
from services.robot_bridge.cameras.frame_feed import FrameFeed
from services.robot_bridge.tasks.base import Outcome, SensorReading, Task

_ID_BYTES = 8


@dataclass(frozen=True)
class NoiseFramesSettings:
    """Keys of ``[task]``."""

    height: int = setting(90, low=8, high=4096)
    width: int = setting(160, low=8, high=4096)
    frames_per_cycle: float = setting(1.0, low=0.0, high=8.0)
    """New frames an action cycle brings on average; 1.2 is a 30 Hz camera at 25 cycles a second. A
    ``[camera]`` has a rate of its own."""
    time_limit: int = setting(100, low=1)
    reset_steps: int = setting(5, low=0)
    goal_probability: float = setting(0.0, low=0.0, high=1.0)
    """Chance of each cycle to end the episode, so that terminal rows can be tested; 0: there is no goal."""
    action_cycle_time: float = setting(0.04, low=0.001, high=10.0)


class NoiseFrames(Task):
    """Frames of noise; the proprioception is the last command, so that a test can follow it."""

    SETTINGS = NoiseFramesSettings
    PRESETS: ClassVar = {"demo": {}}

    def __init__(
        self, settings: NoiseFramesSettings, *, name: str, preset: str, pacing: str, rng: np.random.Generator
    ) -> None:
        self._settings, self._rng = settings, rng
        self._shape = (settings.height, settings.width, 3)
        self._command = np.zeros(2, np.float32)
        self._now_ns = 0
        self._next_frame_id = 0
        self._frames_due = 1.0
        self._feed: FrameFeed | None = None
        """Of the camera, if there is one."""
        self.spec = TaskSpec(
            task=name,
            preset=preset,
            pacing=pacing,
            algorithm_presets={"sac": "noise_frames", "ppo": "noise_frames"},
            action_low=np.full(2, -1, np.float32),
            action_high=np.full(2, 1, np.float32),
            proprioception_low=np.full(2, -1, np.float32),
            proprioception_high=np.full(2, 1, np.float32),
            frame_shape=np.array(self._shape, np.int64),
            frame_stack=3,
            crop_margin=np.array([settings.height // 10, settings.width // 10], np.int64),
            action_cycle_time_s=settings.action_cycle_time,
            world_seconds_per_cycle=settings.action_cycle_time,
            time_limit_steps=settings.time_limit,
            reset_steps=settings.reset_steps,
            has_goal=settings.goal_probability > 0,
        )

    def begin_episode(self) -> None:
        self.begin_attempt()

    def begin_attempt(self) -> None:
        self.stop()
        if self._feed:
            self._feed.begin_attempt()
        # An attempt begins with a frame, whatever the camera's rate.
        self._frames_due = max(self._frames_due, 1.0)

    def command(self, action: Float32Array) -> None:
        self._command = np.array(action, np.float32)

    def stop(self) -> None:
        self._command = np.zeros(2, np.float32)

    def advance_to(self, now_ns: int) -> None:
        self._now_ns = max(now_ns, self._now_ns)
        if self._feed:
            self._feed.advance()

    def use_camera(self, open_camera: Callable[[PictureSize], Camera]) -> None:
        self._feed = FrameFeed(open_camera(PictureSize(*self._shape[:2])))

    def newest_frame_ns(self) -> int | None:
        return self._feed.newest_frame_ns if self._feed else None

    def close(self) -> None:
        super().close()
        if self._feed:
            self._feed.close()

    def read(self) -> SensorReading:
        if self._feed:
            return SensorReading(*self._feed.read(), proprioception=self._command)
        count = int(self._frames_due)
        self._frames_due += self._settings.frames_per_cycle - count
        ids = np.arange(self._next_frame_id, self._next_frame_id + count)
        self._next_frame_id += count
        return SensorReading(
            frames=np.stack([self._draw(int(frame_id)) for frame_id in ids])
            if count
            else np.zeros((0, *self._shape), "u1"),
            frame_ids=ids.astype(np.int64),
            frame_capture_ns=np.full(count, self._now_ns, np.int64),
            proprioception=self._command,
        )

    def outcome(self) -> Outcome:
        probability = self._settings.goal_probability
        return Outcome(reward=-1.0, terminated=probability > 0 and bool(self._rng.random() < probability))

    def _draw(self, frame_id: int) -> UInt8Array:
        frame = self._rng.integers(0, 256, self._shape, np.uint8)
        frame.reshape(-1)[:_ID_BYTES] = np.frombuffer(frame_id.to_bytes(_ID_BYTES, "little"), np.uint8)
        return frame


def read_frame_id(frame: UInt8Array) -> int:
    """The id that a noise frame carries."""
    return int.from_bytes(np.ascontiguousarray(frame).reshape(-1)[:_ID_BYTES].tobytes(), "little")
