"""A robot on two wheels side by side: wheels that follow their commanded speeds with a lag, walls that stop it.

It is kinematic: the wheels do not slip but where a wall holds the robot. The controller computes the end of each
period; in between everything changes evenly, so that what is seen at any time is the same in whatever portions time
comes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from services.robot_bridge.mujoco_without_opengl import mujoco
from services.robot_bridge.robots.arena import Arena

PERIOD_NS = 5_000_000
"""Of the wheels' controller."""
BRAKING = 7.5
"""m/s^2, of a wheel when the robot is stopped: about what rubber on wood holds."""
_PERIOD_S = PERIOD_NS * 1e-9
_X, _Y, _YAW, _LEFT, _RIGHT = range(5)


@dataclass(frozen=True)
class Chassis:
    """What drives."""

    track: float
    """m, between the wheels."""
    radius: float
    """m, of the circle that no wall gets into."""
    lag: float
    """s, in which a wheel's speed comes 63 % closer to the commanded one."""
    tips_after: float = math.inf
    """s of driving forward against a wall, without a break, that turn it on its back."""
    tips_from: float = 0.0
    """m/s: slower than this it does not climb."""


@dataclass(frozen=True)
class Leg:
    """A part of a manoeuvre."""

    left: float
    """m/s, of the left wheel."""
    right: float
    """m/s, of the right wheel."""
    duration: float
    """s."""


class DifferentialDrive:
    """The first three joints of a model, x, y and yaw; a fourth one, if there is one, turns it on its back."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, chassis: Chassis, arena: Arena) -> None:
        """Args:
        model: the scene; its only joints are the robot's.
        data: its state; positions in it are kept up to date.
        chassis: what drives.
        arena: where it drives.
        """
        self._model, self._data, self._chassis, self.arena = model, data, chassis, arena
        self._room = arena.length / 2 - chassis.radius, arena.width / 2 - chassis.radius
        self._gain = 1.0 - math.exp(-_PERIOD_S / chassis.lag) if chassis.lag else 1.0
        self.place(np.zeros(3))

    @property
    def pose(self) -> np.ndarray:
        """(3,): x and y, m, and heading, rad."""
        return self._now()[: _YAW + 1]

    @property
    def wheel_speeds(self) -> np.ndarray:
        """(2,) m/s, left and right."""
        return self._now()[_LEFT:]

    @property
    def on_its_back(self) -> bool:
        """True if it has turned over: the wheels turn in the air."""
        return self._on_its_back

    def place(self, pose: np.ndarray) -> None:
        """Put it at ``pose`` (3,), on its wheels and at rest; it is moved away from walls that it would stand in."""
        x, y = np.clip(pose[:_YAW], -np.array(self._room), self._room)
        self._begin = self._end = np.array([x, y, pose[_YAW], 0.0, 0.0])
        """At the beginning and the end of the controller's period."""
        self._into_period_ns = 0
        self._on_its_back = False
        self._against_wall_s = 0.0
        self.stop()
        self._show()

    def command(self, left: float, right: float) -> None:
        """Turn the wheels at these speeds, m/s: the controller's aim from its next period on."""
        self._aim = left, right
        self._stopped = False

    def stop(self) -> None:
        """Brake, and rest until the next command."""
        self._aim = 0.0, 0.0
        self._stopped = True

    def advance(self, duration_ns: int) -> None:
        """Let ``duration_ns`` pass."""
        while duration_ns > 0:
            if not self._into_period_ns:
                self._end = self._after_period(self._begin)
            portion_ns = min(duration_ns, PERIOD_NS - self._into_period_ns)
            duration_ns -= portion_ns
            self._into_period_ns += portion_ns
            if self._into_period_ns == PERIOD_NS:
                self._begin = self._end
                self._into_period_ns = 0
        self._show()

    def drive(self, legs: Iterable[Leg]) -> None:
        """Drive a manoeuvre from where it stands, in no time at all; it ends at rest."""
        self.place(self.pose)
        for leg in legs:
            self.command(leg.left, leg.right)
            for _ in range(round(leg.duration / _PERIOD_S)):
                self._begin = self._after_period(self._begin)
        self.place(self._begin)

    # ------------------------------------------------------------------ the controller

    def _after_period(self, before: np.ndarray) -> np.ndarray:
        """Return x, y, yaw and the wheels' speeds a period later."""
        x, y, yaw, left, right = before.tolist()
        left, right = self._changed(left, self._aim[0]), self._changed(right, self._aim[1])
        if self._on_its_back:
            return np.array([x, y, yaw, left, right])
        forward, turn = (left + right) / 2 * _PERIOD_S, (right - left) / self._chassis.track * _PERIOD_S
        # By the heading in the middle of the period.
        wanted_x, wanted_y = x + forward * math.cos(yaw + turn / 2), y + forward * math.sin(yaw + turn / 2)
        x = min(max(wanted_x, -self._room[0]), self._room[0])
        y = min(max(wanted_y, -self._room[1]), self._room[1])
        self._climb((x, y) != (wanted_x, wanted_y), (left + right) / 2)
        return np.array([x, y, yaw + turn, left, right])

    def _changed(self, speed: float, aim: float) -> float:
        if self._stopped:
            return math.copysign(max(abs(speed) - BRAKING * _PERIOD_S, 0.0), speed)
        return speed + self._gain * (aim - speed)

    def _climb(self, held: bool, forward: float) -> None:
        """Count how long it has been driving against a wall; too long, and it turns over."""
        climbs = held and forward > self._chassis.tips_from
        self._against_wall_s = self._against_wall_s + _PERIOD_S if climbs else 0.0
        self._on_its_back = self._against_wall_s > self._chassis.tips_after

    # ------------------------------------------------------------------ what is seen

    def _now(self) -> np.ndarray:
        return self._begin + (self._end - self._begin) * (self._into_period_ns / PERIOD_NS)

    def _show(self) -> None:
        self._data.qpos[: _YAW + 1] = self.pose
        self._data.qpos[_YAW + 1 :] = math.pi if self._on_its_back else 0.0
        mujoco.mj_kinematics(self._model, self._data)
