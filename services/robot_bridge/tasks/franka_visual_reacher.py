"""Franka-VisualReacher: bring the webcam at a Panda's flange close to a red bean bag on a table.

Thesis 8.1.2. What the arm sees is its only hint of where the bag is. The scene and the speeds are chosen such that the
untrained policy reaches the bag about as often as the thesis counts under a limit of 3 s (table 8.1; ``python -m
experiments.robot_hits``).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from common.config import setting
from common.errors import ConfigError
from common.messages import Float32Array, UInt8Array
from services.robot_bridge.robots.base import SimulatedRobot
from services.robot_bridge.robots.franka import ANGLE_HIGH, ANGLE_LOW, CONTROL_PERIOD_NS, Franka, franka_limits
from services.robot_bridge.robots.franka_scene import JOINTS, WRIST_CAMERA, BeanBag, FrankaScene
from services.robot_bridge.robots.sensed_world import Rates
from services.robot_bridge.target_detection import TARGET_COLOURS, colour_mask, share
from services.robot_bridge.tasks.base import Outcome
from services.robot_bridge.tasks.robot_task import DISTURBED, RobotSettings, RobotTask, View
from services.robot_bridge.tasks.setting_checks import expect_angles, expect_numbers, expect_place

TARGET = TARGET_COLOURS["franka"]
ANGLE_MARGIN = 0.05
"""rad, by which a joint is expected to overshoot its limits while it brakes."""

BOX_LOWEST, BOX_HIGHEST = (-2.0, -2.0, 0.04), (2.0, 2.0, 2.0)
"""m, of the box's sides: twice as far as the arm reaches; the webcam, .02 m below the flange, has room to brake."""


@dataclass(frozen=True)
class FrankaSettings(RobotSettings):
    """Keys of ``[task]``. World frame: metres, x away from the arm, z up, the origin in the arm's foot."""

    reset_steps: int = setting(100, low=0)
    """Action cycles that a reset takes: 4 s, in which arm and bag are put elsewhere."""
    action_limit: float = setting(1.0, low=0.01, high=2.175)
    """rad/s, the bound of the actions."""
    max_speed: float = setting(0.2, low=0.01, high=2.175)
    """rad/s: a joint that is told to turn faster turns at this."""
    acceleration: float = setting(5.0, low=0.1, high=15.0)
    """rad/s^2, of the joint whose speed has to change most."""
    posture_low: list[float] = setting([-0.2, 0.13, 0.02, -2.25, 0.03, 2.05, 0.8])
    """rad: each joint starts from here ..."""
    posture_high: list[float] = setting([0.2, 0.13, 0.02, -2.0, 0.03, 2.15, 0.8])
    """rad: ... to here."""
    box_low: list[float] = setting([0.3, -0.3, 0.08])
    """m: where the flange may be, from here ..."""
    box_high: list[float] = setting([0.7, 0.3, 0.4])
    """m: ... to here; outside it is driven back."""
    bag_low: list[float] = setting([0.45, -0.1])
    """m: the bag lies, x and y, from here ..."""
    bag_high: list[float] = setting([0.65, 0.1])
    """m: ... to here."""
    bag_radius: float = setting(0.05, low=0.01, high=0.15)
    """m."""
    bag_height: float = setting(0.04, low=0.005, high=0.06)
    """m, of its top above the table."""
    field_of_view: float = setting(43.3, low=10.0, high=120.0)
    """Degrees, from the camera's picture's top to its bottom."""
    threshold: float = setting(0.12, low=0.0, high=0.99)
    """The goal is reached where more than this share of the image is of the bag's colour."""

    def __post_init__(self) -> None:
        _expect_range("posture", self.posture_low, self.posture_high, JOINTS)
        expect_angles("posture_low", self.posture_low, ANGLE_LOW, ANGLE_HIGH)
        expect_angles("posture_high", self.posture_high, ANGLE_LOW, ANGLE_HIGH)
        _expect_range("box", self.box_low, self.box_high, 3)
        _expect_range("bag", self.bag_low, self.bag_high, 2)
        if not (np.array(self.box_low) < self.box_high).all():
            raise ConfigError(f"box_low = {self.box_low}: expected less than box_high = {self.box_high} in each axis")
        for end in ("low", "high"):
            expect_place(f"box_{end}", getattr(self, f"box_{end}"), BOX_LOWEST, BOX_HIGHEST, "above the table")
            lowest, highest = self.bag().places()
            expect_place(f"bag_{end}", getattr(self, f"bag_{end}"), lowest, highest, "on the table before the arm")

    def bag(self) -> BeanBag:
        """Return the bag that these settings describe."""
        return BeanBag(self.bag_radius, self.bag_height)


class FrankaVisualReacher(RobotTask):
    """-1 a step until the bag is large enough in the image."""

    SETTINGS = FrankaSettings
    RATES = Rates(sensors_ns=CONTROL_PERIOD_NS, camera_hz=30)
    VIEW = View(WRIST_CAMERA, height=90, width=160, frame_stack=3)
    ALGORITHM_PRESET = "franka"
    TARGET_RANGE = TARGET
    PRESETS: ClassVar = {"demo": {}, "disturbed": DISTURBED}
    _settings: FrankaSettings

    def begin_attempt(self) -> None:
        """The bag is moved in every reset, not only after a goal (thesis 8.1.2)."""
        self._goal = self._draw_goal()
        super().begin_attempt()

    def _build_robot(self) -> SimulatedRobot:
        settings = self._settings
        scene = FrankaScene(settings.bag(), settings.field_of_view)
        limits = franka_limits(settings.acceleration, np.array(settings.box_low), np.array(settings.box_high))
        robot = Franka(scene, limits, settings.max_speed)
        for posture in itertools.product(*zip(settings.posture_low, settings.posture_high, strict=True)):
            robot.arm.place(np.array(posture))
            if not robot.arm.tool_in_box:
                raise ConfigError(
                    f"posture_low = {settings.posture_low}, posture_high = {settings.posture_high}: {list(posture)} "
                    f"holds the flange at {robot.arm.tool_position.round(3).tolist()}, expected a place between "
                    f"box_low = {settings.box_low} and box_high = {settings.box_high}"
                )
        return robot

    def _draw_goal(self) -> np.ndarray:
        """Draw where the bag lies."""
        return self._rng.uniform(self._settings.bag_low, self._settings.bag_high)

    def _draw_start(self) -> np.ndarray:
        """Draw the arm's posture."""
        return self._rng.uniform(self._settings.posture_low, self._settings.posture_high)

    def _judge(self, frame: UInt8Array, proprioception: Float32Array) -> Outcome:
        return Outcome(reward=-1.0, terminated=share(colour_mask(frame, TARGET)) > self._settings.threshold)

    def _action_limits(self) -> tuple[np.ndarray, np.ndarray]:
        largest = np.full(JOINTS, self._settings.action_limit)
        return -largest, largest

    def _proprioception_limits(self) -> tuple[np.ndarray, np.ndarray]:
        fastest = np.full(JOINTS, self._settings.max_speed)
        low, high = ANGLE_LOW - ANGLE_MARGIN, ANGLE_HIGH + ANGLE_MARGIN
        return np.concatenate([low, -fastest]), np.concatenate([high, fastest])


def _expect_range(name: str, low: Sequence[float], high: Sequence[float], count: int) -> None:
    for end, values in (("low", low), ("high", high)):
        expect_numbers(f"{name}_{end}", values, count)
    if not (np.array(low) <= high).all():
        raise ConfigError(f"{name}_low = {list(low)}: expected at most {name}_high = {list(high)} in each axis")
