"""A Franka Emika Panda in front of a bean bag: what moves, what is felt (thesis 8.1.2)."""

from __future__ import annotations

import numpy as np

from services.robot_bridge.robots.base import SimulatedRobot
from services.robot_bridge.robots.franka_scene import TOOL, FrankaScene
from services.robot_bridge.robots.velocity_arm import ArmLimits, VelocityArm

CONTROL_PERIOD_NS = 8_000_000
"""Of the controller, and between two packets of joint angles and velocities. The arm's own loop is eight times faster;
at the task's small speeds that makes no difference to see."""
MECHANICAL_LOW = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
MECHANICAL_HIGH = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
"""rad ("Limits for Panda", Franka Control Interface documentation)."""
ANGLE_LOW = np.array([-0.5, 0.0, -0.5, -2.8, -0.4, 1.7, -0.9])
ANGLE_HIGH = np.array([0.5, 1.2, 0.5, -0.2, 0.4, 2.96, 0.9])
"""rad: so that the webcam keeps looking at the table."""


def franka_limits(acceleration: float, box_low: np.ndarray, box_high: np.ndarray) -> ArmLimits:
    """Return a Panda's limits with an acceleration (rad/s^2) and a box of one's own (3,) m."""
    return ArmLimits(acceleration, box_low, box_high, ANGLE_LOW, ANGLE_HIGH, MECHANICAL_LOW, MECHANICAL_HIGH)


class Franka(SimulatedRobot):
    """The arm, its webcam and the bean bag."""

    def __init__(self, scene: FrankaScene, limits: ArmLimits, max_speed: float) -> None:
        """Args:
        scene: what there is.
        limits: of places and accelerations.
        max_speed: rad/s: a joint that is told to turn faster turns at this.
        """
        self.model, self.data = scene.model, scene.data
        self._scene, self._max_speed = scene, max_speed
        self.arm = VelocityArm(self.model, self.data, tool=TOOL, limits=limits, period_ns=CONTROL_PERIOD_NS)

    def place(self, goal: np.ndarray, start: np.ndarray) -> None:
        """Let the bag lie at ``goal`` (2,) m, x and y; put the joints at ``start`` (7,) rad."""
        self._scene.put_bag(goal)
        self.arm.place(start)

    def command(self, action: np.ndarray) -> None:
        """Turn the joints at ``action`` (7,) rad/s, each as fast as it may."""
        self.arm.command(np.clip(action, -self._max_speed, self._max_speed))

    def stop(self) -> None:
        self.arm.stop()

    def advance(self, duration_ns: int) -> None:
        self.arm.advance(duration_ns)

    def sense(self) -> np.ndarray:
        """Return the seven angles, rad, and the seven velocities, rad/s."""
        return np.concatenate([self.arm.angles, self.arm.velocities])
