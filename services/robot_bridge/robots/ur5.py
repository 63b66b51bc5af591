"""A UR5 in front of a monitor: what moves, what is felt (thesis 4.3.1)."""

from __future__ import annotations

import math

import numpy as np

from services.robot_bridge.robots.base import SimulatedRobot
from services.robot_bridge.robots.ur5_scene import JOINTS, TOOL, Ur5Scene
from services.robot_bridge.robots.velocity_arm import ArmLimits, VelocityArm

CONTROL_PERIOD_NS = 8_000_000
"""Of the controller, and between two packets of joint angles and velocities (thesis 4.3.1)."""
COMMANDED_JOINTS = JOINTS - 1
"""Nothing is mounted that the last joint could turn."""
MECHANICAL_ANGLE = np.full(JOINTS, 2 * math.pi)
"""rad, data sheet: every joint turns by plus or minus 360 degrees."""
ANGLE_LOW = np.radians([50.0, -120.0, 0.0, -220.0, -120.0])
"""rad, of the commanded joints: so that neither elbow nor cable gets caught."""
ANGLE_HIGH = np.radians([140.0, -20.0, 135.0, -150.0, -70.0])


def ur5_limits(acceleration: float, box_low: np.ndarray, box_high: np.ndarray) -> ArmLimits:
    """Return a UR5's limits with an acceleration (rad/s^2) and a box of one's own (3,) m."""
    return ArmLimits(acceleration, box_low, box_high, ANGLE_LOW, ANGLE_HIGH, -MECHANICAL_ANGLE, MECHANICAL_ANGLE)


class Ur5(SimulatedRobot):
    """The arm, its monitor and its webcam."""

    def __init__(self, scene: Ur5Scene, limits: ArmLimits) -> None:
        self.model, self.data = scene.model, scene.data
        self._scene = scene
        self.arm = VelocityArm(self.model, self.data, tool=TOOL, limits=limits, period_ns=CONTROL_PERIOD_NS)

    def place(self, goal: np.ndarray, start: np.ndarray) -> None:
        """Show the target at ``goal`` (2,) m from the picture's middle; put the joints at ``start`` (6,) rad."""
        self._scene.show_target(goal)
        self.arm.place(start)

    def command(self, action: np.ndarray) -> None:
        """Turn the first five joints at ``action`` (5,) rad/s."""
        self.arm.command(action)

    def stop(self) -> None:
        self.arm.stop()

    def advance(self, duration_ns: int) -> None:
        self.arm.advance(duration_ns)

    def sense(self) -> np.ndarray:
        """Return the five angles, rad, and the five velocities, rad/s."""
        return np.concatenate([self.arm.angles, self.arm.velocities])
