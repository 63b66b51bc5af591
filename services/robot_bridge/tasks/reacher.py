"""Minimum-time Reacher (thesis 6.2.1): bring the fingertip of a two-link arm to a target in the plane. -1 a step."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from services.robot_bridge.rendering import Window
from services.robot_bridge.tasks.control_suite import ControlSuiteTask

FINGER_RADIUS = 0.01
"""Metres, as in dm_control."""
TARGET_DISTANCE = 0.05, 0.20
"""Range of the target's distance from the shoulder, metres, as in dm_control."""
CAMERA_WINDOW = Window(top=85, left=110, height=70, width=100)
"""What the thesis's learning system saw (70 x 100): the middle of dm_control's default picture. The centres of 90 % of
the targets are in it."""
LARGEST_JOINT_POSITIONS = 2 * math.pi, math.radians(165)
"""Radians. The shoulder turns freely and its angle is not wrapped, as in dm_control; it starts within +- pi."""
LARGEST_JOINT_VELOCITIES = 7.0, 7.0
"""rad/s; full torques that change direction at random times reach 7.3."""
LARGEST_TO_TARGET = 0.24 + 0.20
"""Metres: arm and target on opposite sides."""


class Reacher(ControlSuiteTask):
    """Joint positions and velocities as dm_control gives them, and, without a camera, the vector to the target."""

    MODEL = "reacher"
    ALGORITHM_PRESET = "dm_reacher"
    # The default limit is that of section 7.3; "thesis" has the 1000 steps of section 6.2.1.
    PRESETS: ClassVar = {"demo": {}, "thesis": {"time_limit": 1000}}
    TARGET_RADIUS: ClassVar[float]
    """Metres."""
    FINGER_RADIUS: ClassVar[float] = FINGER_RADIUS
    """Metres."""

    def _prepare_model(self) -> None:
        model, data = self._world.model, self._world.data
        target, finger = model.geom("target").id, model.geom("finger").id
        model.geom_size[target, 0] = self.TARGET_RADIUS
        model.geom_size[finger, 0] = self.FINGER_RADIUS
        # Views of MuJoCo's own memory: they always show the newest positions.
        self._target_in_model = model.geom_pos[target]
        self._target, self._finger = data.geom_xpos[target], data.geom_xpos[finger]
        self._wrist_range = model.jnt_range[model.joint("wrist").id]

    def _draw_goal(self) -> None:
        angle, distance = self._rng.uniform(0, 2 * math.pi), self._rng.uniform(*TARGET_DISTANCE)
        self._target_in_model[:2] = distance * math.sin(angle), distance * math.cos(angle)

    def _place_agent(self) -> None:
        shoulder, wrist = self._rng.uniform(-math.pi, math.pi), self._rng.uniform(*self._wrist_range)
        self._world.reset(np.array([shoulder, wrist]))

    def _at_goal(self) -> bool:
        x, y, _ = self._target - self._finger
        return math.hypot(x, y) <= self.TARGET_RADIUS + self.FINGER_RADIUS

    def _proprioception(self) -> np.ndarray:
        joints = self._world.data.qpos, self._world.data.qvel
        if self.WINDOW:
            return np.concatenate(joints)
        return np.concatenate([*joints, (self._target - self._finger)[:2]])

    def _proprioception_limits(self) -> np.ndarray:
        joints = LARGEST_JOINT_POSITIONS + LARGEST_JOINT_VELOCITIES
        return np.array(joints if self.WINDOW else (*joints, LARGEST_TO_TARGET, LARGEST_TO_TARGET))


class ReacherEasy(Reacher):
    """dm_control's easy target."""

    TARGET_RADIUS = 0.05


class ReacherHard(Reacher):
    """dm_control's hard target."""

    TARGET_RADIUS = 0.015


class ReacherExtreme(Reacher):
    """Target and fingertip are all but points: the initial policy does not find it (section 6.2.2)."""

    TARGET_RADIUS = 0.001
    FINGER_RADIUS = 0.0001


class ReacherEasyVisual(ReacherEasy):
    """The target is only in the frames."""

    WINDOW = CAMERA_WINDOW


class ReacherHardVisual(ReacherHard):
    """The target is only in the frames."""

    WINDOW = CAMERA_WINDOW


class ReacherExtremeVisual(ReacherExtreme):
    """The target is smaller than a pixel."""

    WINDOW = CAMERA_WINDOW
