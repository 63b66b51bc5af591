"""UR5-VisualReacher and UR5-VisualReacher-MinTime: bring the webcam at an arm's tool close to a red disc on a monitor.

Thesis 4.3.1 and 8.1.1. What the arm sees is its only hint of where the target is. The monitor, the camera and the box
that the tool stays in are chosen such that the untrained policy reaches the target about as often as the thesis counts
(table 8.1; ``python -m experiments.robot_hits``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from common.config import setting
from common.errors import ConfigError
from common.messages import Float32Array, UInt8Array
from services.robot_bridge.robots.base import SimulatedRobot
from services.robot_bridge.robots.sensed_world import Rates
from services.robot_bridge.robots.ur5 import (
    ANGLE_HIGH,
    ANGLE_LOW,
    COMMANDED_JOINTS,
    CONTROL_PERIOD_NS,
    MECHANICAL_ANGLE,
    Ur5,
    ur5_limits,
)
from services.robot_bridge.robots.ur5_scene import CAMERA_OFFSET, JOINTS, WRIST_CAMERA, Monitor, Ur5Scene
from services.robot_bridge.target_detection import (
    TARGET_COLOURS,
    Mask,
    centre_weights,
    colour_mask,
    share,
    weighted_share,
)
from services.robot_bridge.tasks.base import Outcome
from services.robot_bridge.tasks.robot_task import DISTURBED, RobotSettings, RobotTask, View
from services.robot_bridge.tasks.setting_checks import expect_angles, expect_numbers, expect_place

TARGET = TARGET_COLOURS["ur5"]
ANGLE_MARGIN = 0.35
"""rad, by which a joint is expected to overshoot its limits while it brakes."""
BRAKING_DISTANCE = 0.06
"""m: about so far does the tool come out of its box towards the monitor before it is driven back."""
FARTHEST = 2.0
"""m, of the box's sides: twice as far as the arm reaches."""
POSTURE_LOW = np.append(ANGLE_LOW, -MECHANICAL_ANGLE[COMMANDED_JOINTS:])
POSTURE_HIGH = np.append(ANGLE_HIGH, MECHANICAL_ANGLE[COMMANDED_JOINTS:])
"""rad, of the six joints: beyond its range a commanded one turns back instead of obeying."""


@dataclass(frozen=True)
class Ur5Settings(RobotSettings):
    """Keys of ``[task]``. World frame: metres, y towards the monitor, z up, the origin in the arm's foot."""

    max_speed: float = setting(2.0, low=0.01, high=3.14)
    """rad/s, the bound of the actions."""
    acceleration: float = setting(1.4, low=0.1, high=40.0)
    """rad/s^2, of the joint whose speed has to change most."""
    posture: list[float] = setting([1.5707, -2.0, 2.1, -3.0415, -1.5707, 3.1415])
    """rad, of the six joints at the start of each attempt."""
    box_low: list[float] = setting([-0.25, 0.17, 0.37])
    """m: where the tool may be, from here ..."""
    box_high: list[float] = setting([0.15, 0.5, 0.63])
    """m: ... to here; outside it is driven back."""
    monitor_distance: float = setting(0.78, low=0.6, high=1.5)
    """m, from the arm's foot along y."""
    monitor_x: float = setting(-0.05, low=-0.6, high=0.6)
    """m, of the picture's middle."""
    monitor_z: float = setting(0.5, low=0.2, high=1.2)
    """m, of the picture's middle."""
    monitor_width: float = setting(0.53, low=0.1, high=1.2)
    """m; 16:9."""
    target_radius: float = setting(7 / 160, low=0.005, high=0.25)
    """As a share of the monitor's width."""
    target_margin: float = setting(20 / 160, low=0.0, high=0.25)
    """Least distance of the target from the picture's edges, as a share of its width."""
    field_of_view: float = setting(43.3, low=10.0, high=120.0)
    """Degrees, from the camera's picture's top to its bottom."""

    def __post_init__(self) -> None:
        expect_numbers("posture", self.posture, JOINTS)
        expect_angles("posture", self.posture, POSTURE_LOW, POSTURE_HIGH)
        nearest = self.monitor_distance - CAMERA_OFFSET - BRAKING_DISTANCE
        where = f"above the table and well before the monitor at monitor_distance = {self.monitor_distance}"
        for name in ("box_low", "box_high"):
            expect_numbers(name, getattr(self, name), 3)
            expect_place(name, getattr(self, name), (-FARTHEST, -FARTHEST, 0), (FARTHEST, nearest, FARTHEST), where)
        if not (np.array(self.box_low) < self.box_high).all():
            raise ConfigError(f"box_low = {self.box_low}: expected less than box_high = {self.box_high} in each axis")
        if not (self.monitor().target_range() >= 0).all():
            raise ConfigError(
                f"target_radius = {self.target_radius}, target_margin = {self.target_margin}: expected at most "
                f"{9 / 32} together, so that the target has a place on the monitor"
            )

    def monitor(self) -> Monitor:
        """Return the monitor that these settings describe."""
        return Monitor(
            distance=self.monitor_distance,
            x=self.monitor_x,
            z=self.monitor_z,
            width=self.monitor_width,
            height=self.monitor_width * 9 / 16,
            target_radius=self.target_radius,
            target_margin=self.target_margin,
        )


@dataclass(frozen=True)
class MinTimeSettings(Ur5Settings):
    """Keys of ``[task]`` of the minimum-time task."""

    threshold: float = setting(0.015, low=0.0, high=0.99)
    """The goal is reached where more than this share of the image is of the target's colour."""


@dataclass(frozen=True)
class DenseSettings(Ur5Settings):
    """Keys of ``[task]`` of the task with dense reward."""

    time_limit: int = setting(100, low=1)
    """Action cycles: 4 s."""
    reset_steps: int = setting(0, low=0)
    """Action cycles that a reset takes: the thesis counts them in minimum-time tasks only."""
    max_speed: float = setting(0.7, low=0.01, high=3.14)
    """rad/s, the bound of the actions."""
    target_weight: float = setting(800.0, low=0.0, high=1e6)
    """alpha of the reward."""
    posture_weight: float = setting(1.0, low=0.0, high=1e6)
    """beta of the reward."""


class _Ur5Task(RobotTask):
    """What both tasks have in common: the robot, what it senses, the target, the start."""

    RATES = Rates(sensors_ns=CONTROL_PERIOD_NS, camera_hz=30)
    VIEW = View(WRIST_CAMERA, height=90, width=160, frame_stack=3)
    ALGORITHM_PRESET = "ur5"
    TARGET_RANGE = TARGET
    PRESETS: ClassVar = {"demo": {}, "disturbed": DISTURBED}
    _settings: Ur5Settings

    def _build_robot(self) -> SimulatedRobot:
        settings = self._settings
        self._target_range = settings.monitor().target_range()
        scene = Ur5Scene(settings.monitor(), settings.field_of_view)
        limits = ur5_limits(settings.acceleration, np.array(settings.box_low), np.array(settings.box_high))
        robot = Ur5(scene, limits)
        robot.arm.place(self._draw_start())
        if not robot.arm.tool_in_box:
            raise ConfigError(
                f"posture = {settings.posture}: it holds the tool at {robot.arm.tool_position.round(3).tolist()}, "
                f"expected a place between box_low = {settings.box_low} and box_high = {settings.box_high}"
            )
        return robot

    def _draw_goal(self) -> np.ndarray:
        """Draw where on the monitor the target is shown."""
        return self._rng.uniform(-self._target_range, self._target_range)

    def _draw_start(self) -> np.ndarray:
        """The arm always starts from the same posture."""
        return np.array(self._settings.posture)

    def _action_limits(self) -> tuple[np.ndarray, np.ndarray]:
        fastest = np.full(COMMANDED_JOINTS, self._settings.max_speed)
        return -fastest, fastest

    def _proprioception_limits(self) -> tuple[np.ndarray, np.ndarray]:
        slowest, fastest = self._action_limits()
        low, high = ANGLE_LOW - ANGLE_MARGIN, ANGLE_HIGH + ANGLE_MARGIN
        return np.concatenate([low, slowest]), np.concatenate([high, fastest])


class Ur5VisualReacherMinTime(_Ur5Task):
    """-1 a step until the target is large enough in the image."""

    SETTINGS = MinTimeSettings
    _settings: MinTimeSettings

    def _judge(self, frame: UInt8Array, proprioception: Float32Array) -> Outcome:
        seen = share(colour_mask(frame, TARGET))
        return Outcome(reward=-1.0, terminated=bool(seen > self._settings.threshold))


class Ur5VisualReacher(_Ur5Task):
    """Rewarded for a large target in the image's middle and for a posture that is not twisted; never at a goal."""

    SETTINGS = DenseSettings
    HAS_GOAL = False
    _settings: DenseSettings
    _weights = centre_weights(_Ur5Task.VIEW.height, _Ur5Task.VIEW.width)

    def _judge(self, frame: UInt8Array, proprioception: Float32Array) -> Outcome:
        angles = proprioception[:COMMANDED_JOINTS].astype(np.float64)
        settings, mask = self._settings, colour_mask(frame, TARGET)
        reward = dense_reward(mask, self._weights, angles, settings.target_weight, settings.posture_weight)
        return Outcome(reward=reward, terminated=False)


def dense_reward(
    mask: Mask, weights: Float32Array, angles: np.ndarray, target_weight: float, posture_weight: float
) -> float:
    """Return alpha mean(M o W) - beta (abs(pi - w_1 - w_2 - w_3) + abs(w_4 + w_5)), thesis 4.3.1.

    Args:
        mask: M (H, W), True where the target is seen.
        weights: W (H, W), in [0, 1].
        angles: w (5,), rad.
        target_weight: alpha.
        posture_weight: beta.
    """
    twisted = abs(math.pi - float(angles[:3].sum())) + abs(float(angles[3:].sum()))
    return target_weight * weighted_share(mask, weights) - posture_weight * twisted
