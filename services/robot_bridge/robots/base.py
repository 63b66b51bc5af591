"""What is asked of a simulated robot: a body in a scene that moves on, in whatever portions of time."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from services.robot_bridge.mujoco_without_opengl import mujoco

ROOM_CAMERA = "room"
"""A model's camera of this name shows the robot from outside, for people to look at."""


class SimulatedRobot(ABC):
    """A robot and its surroundings; :class:`~services.robot_bridge.robots.sensed_world.SensedWorld` gives it senses.

    How it moves must not depend on the portions in which the time comes.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    """Positions of bodies, geometries and sites in it are those of now."""

    @abstractmethod
    def place(self, goal: np.ndarray, start: np.ndarray) -> None:
        """Put the goal and the robot, at rest, where these say; what they mean is the robot's own."""

    @abstractmethod
    def command(self, action: np.ndarray) -> None:
        """Obey ``action`` (A,), physical units inside the bounds, from now on."""

    @abstractmethod
    def stop(self) -> None:
        """Brake, and rest until the next command."""

    @abstractmethod
    def advance(self, duration_ns: int) -> None:
        """Let ``duration_ns`` pass."""

    def counters(self) -> dict[str, float]:
        """Counts of the robot's own; they may be asked for by any thread."""
        return {}

    @abstractmethod
    def sense(self) -> np.ndarray:
        """Read the sensors (P,), physical units, as they would show the present state without any noise."""
