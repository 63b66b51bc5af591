"""What the tasks of robots on two wheels have in common: they drive to their starts (thesis 4.3.2, 8.1.3)."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from common.config import setting
from common.errors import ConfigError
from services.robot_bridge.robots.arena import Arena
from services.robot_bridge.robots.differential_drive import Leg
from services.robot_bridge.robots.wheeled_robot import STAYS, Battery, start
from services.robot_bridge.tasks.robot_task import DISTURBED, RobotSettings, RobotTask

WHEELS = 2


@dataclass(frozen=True)
class WheeledSettings(RobotSettings):
    """Keys of ``[task]`` that every robot on two wheels has."""

    max_speed: float = setting(300.0, low=1.0, high=2000.0)
    """mm/s of each wheel, the bound of the actions."""
    wheel_lag: float = setting(0.1, low=0.0, high=2.0)
    """s, in which a wheel's speed comes 63 % closer to the commanded one."""
    arena_length: float = setting(2.2, low=0.1, high=20.0)
    """m."""
    arena_width: float = setting(1.4, low=0.1, high=20.0)
    """m."""
    wall_height: float = setting(0.6, low=0.01, high=5.0)
    """m."""
    field_of_view: float = setting(55.0, low=10.0, high=120.0)
    """Degrees, from the camera's picture's top to its bottom."""
    battery_life: float = setting(7200.0, low=1.0)
    """s, from full to empty."""
    battery_threshold: float = setting(0.2, low=0.0, high=1.0)
    """A reset recharges a battery that holds less than this share."""

    def arena(self) -> Arena:
        """Return the arena that these settings describe."""
        return Arena(self.arena_length, self.arena_width, self.wall_height)

    def battery(self) -> Battery:
        """Return the battery that these settings describe."""
        return Battery(self.battery_life, self.battery_threshold)

    def expect_room(self, radius: float) -> None:
        """Check that the arena has room for a robot to turn and drive.

        Raises:
            ConfigError: it has not.
        """
        for name, size in (("arena_length", self.arena_length), ("arena_width", self.arena_width)):
            if size < 4 * radius:
                raise ConfigError(f"{name} = {size}: expected at least {4 * radius:g} m, twice the robot's own size")


class WheeledRobotTask(RobotTask):
    """-1 a step until the target is near. The target never moves; the first start of all is anywhere in the arena.

    From then on the robot drives to each start itself, by a manoeuvre drawn at random, from where it has come to.
    """

    RADIUS: ClassVar[float]
    """m, of the robot."""
    PRESETS: ClassVar = {"demo": {}, "disturbed": DISTURBED}
    _settings: WheeledSettings
    _driven = False
    """False until the first start has been drawn."""

    @abstractmethod
    def _draw_manoeuvre(self) -> Sequence[Leg]:
        """Draw what a reset drives."""

    def renew(self) -> None:
        self._driven = False

    def _draw_goal(self) -> np.ndarray:
        """The targets never move."""
        return np.zeros(0)

    def _draw_start(self) -> np.ndarray:
        pose = STAYS if self._driven else self._draw_pose()
        self._driven = True
        return start(pose, self._draw_manoeuvre())

    def _draw_pose(self) -> np.ndarray:
        """Anywhere in the arena where the robot can turn without touching a wall."""
        settings = self._settings
        room = np.array([settings.arena_length, settings.arena_width]) / 2 - self.RADIUS
        return np.array([*self._rng.uniform(-room, room), self._rng.uniform(-math.pi, math.pi)])

    def _action_limits(self) -> tuple[np.ndarray, np.ndarray]:
        fastest = np.full(WHEELS, self._settings.max_speed)
        return -fastest, fastest


def turn(speed: float, duration: float) -> Leg:
    """Turn on the spot: ``speed`` m/s of the wheels, counter-clockwise if positive, for ``duration`` s."""
    return Leg(-speed, speed, duration)


def straight(speed: float, duration: float) -> Leg:
    """Drive straight on at ``speed`` m/s, back if negative, for ``duration`` s."""
    return Leg(speed, speed, duration)
