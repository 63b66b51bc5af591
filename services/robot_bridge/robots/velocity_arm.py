"""An arm under velocity control, as its controller makes it move: limited acceleration, kept inside a box.

The controller decides once a period; in between the joints turn at a constant speed, so any time in between is exact.
Like the real ones it is kinematic: the joints do what it says, whatever the arm weighs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from services.robot_bridge.mujoco_without_opengl import mujoco

RETURN_SPEED = 0.1
"""rad/s, of all joints together, when the tool is driven back into its box."""
RETURN_ACCELERATION = (2.0, 5.0)
"""rad/s^2, least and most, outside the box."""
RETURN_BRAKING_ANGLE = 0.05
"""rad, in which an arm that has left its box should have stopped."""
STOP_ACCELERATION = 10.0
"""rad/s^2, when the arm is stopped."""


@dataclass(frozen=True)
class ArmLimits:
    """What an arm may do."""

    acceleration: float
    """rad/s^2 of the joint whose speed has to change most; the others change in proportion."""
    box_low: np.ndarray
    """(3,) m: the tool stays above this ..."""
    box_high: np.ndarray
    """(3,) m: ... and below this, or is driven back."""
    angle_low: np.ndarray
    """(n,) rad: a commanded joint beyond this ..."""
    angle_high: np.ndarray
    """(n,) rad: ... or this turns back, at the largest speed that was commanded of any joint."""
    mechanical_low: np.ndarray
    """(nq,) rad, of all joints: none turns below this ..."""
    mechanical_high: np.ndarray
    """(nq,) rad: ... or above this."""


class VelocityArm:
    """The joints of a model, all of them hinges, and their controller.

    The first n joints, those of the limits' angles, are commanded; the others stand still.
    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, *, tool: str, limits: ArmLimits, period_ns: int
    ) -> None:
        """Args:
        model: the scene; its only joints are the arm's.
        data: its state; positions in it are kept up to date.
        tool: the site that stays in the box.
        limits: of speeds and places.
        period_ns: between two decisions of the controller.
        """
        self._model, self._data, self._limits = model, data, limits
        self._tool = data.site(tool).xpos
        self._period_ns, self._period_s = period_ns, period_ns * 1e-9
        self._count = len(limits.angle_low)
        self.place(np.zeros(model.nq))

    @property
    def angles(self) -> np.ndarray:
        """(n,) rad, of the commanded joints."""
        return self._data.qpos[: self._count].copy()

    @property
    def velocities(self) -> np.ndarray:
        """(n,) rad/s, of the commanded joints."""
        return self._velocities[: self._count].copy()

    @property
    def tool_position(self) -> np.ndarray:
        """(3,) m."""
        return self._tool.copy()

    @property
    def tool_in_box(self) -> bool:
        """True if the tool is where it may be."""
        return bool(((self._limits.box_low <= self._tool) & (self._tool <= self._limits.box_high)).all())

    def place(self, angles: np.ndarray) -> None:
        """Put all joints at ``angles`` (nq,) rad, at rest."""
        self._angles = np.array(angles, np.float64)
        """At the controller's last decision."""
        self._velocities = np.zeros(len(self._angles))
        self._commanded = np.zeros(len(self._angles))
        self._stopped = True
        self._into_period_ns = 0
        self._last_inside = self._angles.copy()
        self._speed_inside = 0.0
        self._show()

    def command(self, velocities: np.ndarray) -> None:
        """Turn the joints at ``velocities`` (n,) rad/s: the controller's aim from its next decision on."""
        self._commanded[: self._count] = velocities
        self._stopped = False

    def stop(self) -> None:
        """Brake, and rest until the next command."""
        self._commanded[:] = 0.0
        self._stopped = True

    def advance(self, duration_ns: int) -> None:
        """Let ``duration_ns`` pass."""
        while duration_ns > 0:
            if not self._into_period_ns:
                self._decide()
            portion_ns = min(duration_ns, self._period_ns - self._into_period_ns)
            duration_ns -= portion_ns
            self._into_period_ns += portion_ns
            if self._into_period_ns == self._period_ns:
                self._end_period()
        if self._into_period_ns:
            self._show()

    # ------------------------------------------------------------------ the controller

    def _decide(self) -> None:
        """Choose the speeds of the next period."""
        aim, acceleration = self._commanded, self._limits.acceleration
        if self._stopped:
            acceleration = STOP_ACCELERATION
        elif self.tool_in_box:
            self._last_inside, self._speed_inside = self._angles.copy(), float(np.abs(self._velocities).max())
            aim = self._turned_back(aim)
        else:
            aim, acceleration = self._back_to_box()
        change = aim - self._velocities
        largest = float(np.abs(change).max())
        if largest > acceleration * self._period_s:
            change = change * (acceleration * self._period_s / largest)
        self._velocities = self._velocities + change

    def _turned_back(self, aim: np.ndarray) -> np.ndarray:
        """Let joints that are at their limits turn back."""
        angles = self._angles[: self._count]
        below, above = angles < self._limits.angle_low, angles > self._limits.angle_high
        if not (below.any() or above.any()):
            return aim
        speed = float(np.abs(aim).max())
        aim = aim.copy()
        aim[: self._count] = np.where(below, speed, np.where(above, -speed, aim[: self._count]))
        return aim

    def _back_to_box(self) -> tuple[np.ndarray, float]:
        """Return the way back to where the tool was last inside, and the acceleration, which first of all brakes."""
        way = self._last_inside - self._angles
        length = float(np.linalg.norm(way))
        aim = way * (RETURN_SPEED / length) if length > 1e-9 else np.zeros_like(way)
        speed = float(np.abs(self._velocities).max())
        return aim, float(np.clip(speed * self._speed_inside / RETURN_BRAKING_ANGLE, *RETURN_ACCELERATION))

    # ------------------------------------------------------------------ the joints

    def _end_period(self) -> None:
        angles = self._angles + self._velocities * self._period_s
        low, high = self._limits.mechanical_low, self._limits.mechanical_high
        self._velocities[(angles < low) | (angles > high)] = 0.0
        self._angles = np.clip(angles, low, high)
        self._into_period_ns = 0
        self._show()

    def _show(self) -> None:
        self._data.qpos[:] = self._angles + self._velocities * (self._into_period_ns * 1e-9)
        mujoco.mj_kinematics(self._model, self._data)
