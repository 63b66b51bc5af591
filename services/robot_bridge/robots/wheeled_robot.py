"""What robots on two wheels have in common: a battery, a charger, and a reset that they drive themselves."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from services.robot_bridge.mujoco_without_opengl import mujoco
from services.robot_bridge.robots.base import SimulatedRobot
from services.robot_bridge.robots.differential_drive import DifferentialDrive, Leg

MILLIMETRE = 1e-3
STAYS = np.full(3, math.nan)
"""The first row of a start that begins where the robot is."""


def start(pose: np.ndarray, manoeuvre: Iterable[Leg]) -> np.ndarray:
    """Return what :meth:`WheeledRobot.place` calls a start: (1 + n, 3).

    Args:
        pose: (3,) where someone puts the robot: x and y, m, and heading, rad; or :data:`STAYS`.
        manoeuvre: that it drives from there.
    """
    return np.array([pose, *([leg.left, leg.right, leg.duration] for leg in manoeuvre)])


@dataclass(frozen=True)
class Battery:
    """What it holds and when that is not enough."""

    life: float
    """s, from full to empty."""
    threshold: float
    """A reset recharges it below this share."""


class WheeledRobot(SimulatedRobot):
    """Drives by the speeds of its wheels, left and right, in mm/s, as both robots' interfaces have them."""

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        drive: DifferentialDrive,
        battery: Battery,
        charger: np.ndarray,
    ) -> None:
        """Args:
        model: the scene.
        data: its state.
        drive: the wheels.
        battery: full at first.
        charger: (3,) the pose at the charger: m, m, rad.
        """
        self.model, self.data, self.drive = model, data, drive
        self._battery, self._charger = battery, charger
        self.charge = 1.0
        """Of the battery, 0 to 1; what is empty drives on: a reset comes long before."""
        self.recharges = self.recoveries = 0
        """Resets that began at the charger, and that found the robot on its back."""

    def place(self, goal: np.ndarray, start: np.ndarray) -> None:
        """Drive the reset's manoeuvre.

        A robot on its back is put on its wheels where it lies. One whose battery is low begins at its charger, with a
        full battery; charging takes no time here.

        Args:
            goal: none, (0,): the targets never move.
            start: of :func:`start`.
        """
        pose, manoeuvre = start[0], [Leg(*leg) for leg in start[1:].tolist()]
        if np.isfinite(pose).all():
            self.drive.place(pose)
            self.charge = 1.0
        self.recoveries += self.drive.on_its_back
        if self.charge < self._battery.threshold:
            self.drive.place(self._charger)
            self.charge = 1.0
            self.recharges += 1
        self.drive.drive(manoeuvre)

    def command(self, action: np.ndarray) -> None:
        """Turn the wheels at ``action`` (2,) mm/s, left and right."""
        left, right = (MILLIMETRE * action).tolist()
        self.drive.command(left, right)

    def stop(self) -> None:
        self.drive.stop()

    def advance(self, duration_ns: int) -> None:
        self.charge = max(self.charge - duration_ns * 1e-9 / self._battery.life, 0.0)
        self.drive.advance(duration_ns)

    def counters(self) -> dict[str, float]:
        return {"recharges": self.recharges, "recoveries": self.recoveries}

    @abstractmethod
    def sense(self) -> np.ndarray:
        """Read the sensors (P,)."""
