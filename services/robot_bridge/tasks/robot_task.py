"""What the tasks of simulated robots with a camera have in common: a world in real time, frames, resets, presets.

A subclass says which robot it is, what is drawn at random and what is rewarded; see
:mod:`services.robot_bridge.tasks.ur5_visual_reacher`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from common.clock import Clock
from common.config import setting
from common.errors import ConfigError, ServiceError
from common.messages import Float32Array, TaskSpec, UInt8Array
from services.robot_bridge.cameras.base import CameraFrame
from services.robot_bridge.cameras.simulated import BUFFERED_FRAMES, CameraDefects, SimulatedCamera
from services.robot_bridge.robots.base import SimulatedRobot
from services.robot_bridge.robots.live_world import LiveWorld
from services.robot_bridge.robots.sensed_world import Rates, SensedWorld
from services.robot_bridge.target_detection import ColourRange
from services.robot_bridge.tasks.base import Outcome, SensorReading, Task

MUJOCO_SAYS = ("XML", "Error")
"""So begins what MuJoCo says of a scene that it cannot build, in a ValueError."""
_LARGEST_SEED = 2**63 - 1
DISTURBED: Mapping[str, float] = {
    "camera_latency": 0.03,
    "camera_noise": 4.0,
    "sensor_noise": 0.001,
    "lighting_change": 0.2,
}
"""Settings of a preset that is closer to a real robot: a webcam's latency, noise and a room with a window."""


@dataclass(frozen=True)
class RobotSettings:
    """Keys of ``[task]`` that every simulated robot has."""

    time_limit: int = setting(150, low=1)
    """Action cycles before the robot is reset."""
    reset_steps: int = setting(70, low=0)
    """Action cycles that a reset takes."""
    action_cycle_time: float = setting(0.04, low=0.001, high=10.0)
    """Seconds."""
    camera_latency: float = setting(0.0, low=0.0, high=1.0)
    """Seconds from the capture of a frame until the bridge can have it."""
    camera_noise: float = setting(0.0, low=0.0, high=128.0)
    """Standard deviation of each pixel's noise, grey levels of 255."""
    sensor_noise: float = setting(0.0, low=0.0, high=0.5)
    """Standard deviation of each other sensor's noise, as a share of its range."""
    lighting_change: float = setting(0.0, low=0.0, high=0.9)
    """By which share the room's light changes, at most, up and down within 10 s."""


@dataclass(frozen=True)
class View:
    """What the robot's camera is."""

    camera: str
    """Its name in the model."""
    height: int
    width: int
    frame_stack: int

    def __post_init__(self) -> None:
        for name in ("height", "width", "frame_stack"):
            if (value := getattr(self, name)) < 1:
                raise ConfigError(f"View: {name} = {value}: expected at least 1")


class RobotTask(Task):
    """A simulated robot; in real time it lives in a thread of its own from :meth:`start` on."""

    SETTINGS: ClassVar[type] = RobotSettings
    RATES: ClassVar[Rates]
    VIEW: ClassVar[View]
    ALGORITHM_PRESET: ClassVar[str]
    HAS_GOAL: ClassVar[bool] = True
    TARGET_RANGE: ClassVar[ColourRange | None] = None
    """The target's colours; None if it is not found by them."""

    def __init__(
        self, settings: RobotSettings, *, name: str, preset: str, pacing: str, rng: np.random.Generator
    ) -> None:
        self._settings, self._rng = settings, rng
        self.robot = self._robot()
        """The robot; in real time the world's thread alone may touch it from :meth:`start` on."""
        self.spec = self._describe(name, preset, pacing)
        self._world: SensedWorld | LiveWorld = self._build_world(self.robot)
        self._collected: deque[CameraFrame] = deque(maxlen=BUFFERED_FRAMES)
        """Frames that nobody has read yet."""
        self._newest_frame: CameraFrame | None = None
        self._next_id = 0
        self._id_offset: int | None = None
        """From the camera's count to a reading's ids; None while an attempt's first frame has not been read."""
        self._goal = np.zeros(0)
        self.begin_episode()
        felt, expected = np.shape(self.robot.sense()), self.spec.proprioception_low.shape
        if felt != expected:
            raise ConfigError(
                f"{type(self.robot).__name__}.sense() gives shape {felt}: expected {expected}, the shape of "
                f"{type(self).__name__}._proprioception_limits()"
            )

    # ------------------------------------------------------------------ what a subclass says

    @abstractmethod
    def _build_robot(self) -> SimulatedRobot:
        """Build the robot and its surroundings, as the settings say."""

    @abstractmethod
    def _draw_goal(self) -> np.ndarray:
        """Draw where the next goal is, as the robot's ``place`` understands it."""

    @abstractmethod
    def _draw_start(self) -> np.ndarray:
        """Draw where the next attempt starts, as the robot's ``place`` understands it."""

    @abstractmethod
    def _judge(self, frame: UInt8Array, proprioception: Float32Array) -> Outcome:
        """Judge what the newest frame (H, W, 3) and the sensors (P,) show."""

    @abstractmethod
    def _action_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and highest action (A,), physical units."""

    @abstractmethod
    def _proprioception_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Return what the sensors (P,) may show, lowest and highest, physical units."""

    # ------------------------------------------------------------------ the task

    def start(self, clock: Clock) -> None:
        assert isinstance(self._world, SensedWorld), f"{self.spec.task} has been started already"
        self._world = live = LiveWorld(self._world, clock)
        live.begin()
        self._forget_frames()

    def begin_episode(self) -> None:
        self._goal = self._draw_goal()
        self.begin_attempt()

    def begin_attempt(self) -> None:
        start, seed = self._draw_start(), int(self._rng.integers(_LARGEST_SEED))
        self._world.place(self._goal, start, seed)
        self._forget_frames()

    def command(self, action: Float32Array) -> None:
        if not np.isfinite(action).all():
            self.stop()
            raise ServiceError(
                f"{self.spec.task}: the robot was given the command {action}: expected finite numbers; it was stopped"
            )
        self._world.command(np.clip(action, self.spec.action_low, self.spec.action_high))

    def stop(self) -> None:
        self._world.stop()

    def advance_to(self, now_ns: int) -> None:
        self._world.advance_to(now_ns)
        self._collect()

    def read(self) -> SensorReading:
        frames = list(self._collected)
        self._collected.clear()
        if frames and self._id_offset is None:
            self._id_offset = self._next_id - frames[0].frame_id
        ids = np.array([frame.frame_id + (self._id_offset or 0) for frame in frames], np.int64)
        if frames:
            self._next_id = int(ids[-1]) + 1
        shape = (self.VIEW.height, self.VIEW.width, 3)
        return SensorReading(
            frames=np.stack([frame.frame for frame in frames]) if frames else np.zeros((0, *shape), np.uint8),
            frame_ids=ids,
            frame_capture_ns=np.array([frame.capture_ns for frame in frames], np.int64),
            proprioception=self._world.newest.values,
        )

    def outcome(self) -> Outcome:
        assert self._newest_frame is not None, "advance_to() has not been called"
        outcome = self._judge(self._newest_frame.frame, self._world.newest.values)
        if not isinstance(outcome, Outcome):
            raise ServiceError(f"{type(self).__name__}._judge() gave {outcome!r}: expected an Outcome")
        return outcome

    def newest_frame_ns(self) -> int:
        return self._world.camera.newest_capture_ns

    def counters(self) -> dict[str, float]:
        """How many packets the sensors have sent, and frames the camera has captured: their rates, over time."""
        rates = {"sensor_packets": self._world.packets, "camera_frames": self._world.camera.frames}
        return {**rates, **self._world.counters()}

    def give_up(self) -> None:
        if isinstance(self._world, LiveWorld):
            self._world.give_up()

    def close(self) -> None:
        super().close()
        self._world.close()

    # ------------------------------------------------------------------ frames

    def _forget_frames(self) -> None:
        """What was captured before the robot was placed shows another attempt."""
        self._collected.clear()
        self._id_offset = None
        self._collect()

    def _collect(self) -> None:
        self._collected.extend(self._world.camera.take())
        if self._collected:
            self._newest_frame = self._collected[-1]

    # ------------------------------------------------------------------ construction

    def _robot(self) -> SimulatedRobot:
        try:
            return self._build_robot()
        except ValueError as error:
            if not str(error).startswith(MUJOCO_SAYS):
                raise
            raise ConfigError(f"the scene of {type(self).__name__}: {error}") from error

    def _build_world(self, robot: SimulatedRobot) -> SensedWorld:
        settings, view = self._settings, self.VIEW
        defects = CameraDefects(round(settings.camera_latency * 1e9), settings.camera_noise, settings.lighting_change)
        camera = SimulatedCamera(robot.model, view.camera, height=view.height, width=view.width, defects=defects)
        noise = settings.sensor_noise * (self.spec.proprioception_high - self.spec.proprioception_low)
        return SensedWorld(robot, camera, self.RATES, noise)

    def _describe(self, name: str, preset: str, pacing: str) -> TaskSpec:
        settings, view = self._settings, self.VIEW
        action_low, action_high = self._action_limits()
        low, high = self._proprioception_limits()
        for what, lowest, highest in (("action", action_low, action_high), ("proprioception", low, high)):
            if not np.all(np.asarray(lowest) < highest):
                raise ConfigError(
                    f"{type(self).__name__}._{what}_limits() gives {lowest}, {highest}: expected low < high"
                )
        size = np.array([view.height, view.width], np.int64)
        return TaskSpec(
            task=name,
            preset=preset,
            pacing=pacing,
            algorithm_presets=dict.fromkeys(("sac", "ppo"), self.ALGORITHM_PRESET),
            action_low=action_low.astype(np.float32),
            action_high=action_high.astype(np.float32),
            proprioception_low=low.astype(np.float32),
            proprioception_high=high.astype(np.float32),
            frame_shape=np.array([view.height, view.width, 3], np.int64),
            frame_stack=view.frame_stack,
            crop_margin=size // 10,  # thesis 3.6
            action_cycle_time_s=settings.action_cycle_time,
            world_seconds_per_cycle=settings.action_cycle_time,
            time_limit_steps=settings.time_limit,
            reset_steps=settings.reset_steps,
            has_goal=self.HAS_GOAL,
        )
