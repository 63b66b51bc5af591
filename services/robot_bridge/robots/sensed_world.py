"""A simulated robot as it is seen: sensors and camera show it at their own rates.

One code path for both pacings: :meth:`SensedWorld.advance_to` goes through what is due, in order. In lockstep the task
calls it, in real time a thread of its own (:mod:`services.robot_bridge.robots.live_world`).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.errors import ConfigError, ServiceError
from common.messages import Float32Array
from services.robot_bridge.cameras.simulated import BUFFERED_FRAMES, SimulatedCamera
from services.robot_bridge.robots.base import SimulatedRobot

LONGEST_GAP_NS = 2_000_000_000
"""A longer gap between two looks at the clock, as after a suspended computer, counts as this long: catching up must
not take long."""
_SECOND_NS = 1_000_000_000


@dataclass(frozen=True)
class Rates:
    """How often a robot is sensed."""

    sensors_ns: int
    """Between two packets of the sensors."""
    camera_hz: int
    """Frames a second."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value < 1:
                raise ConfigError(f"Rates: {name} = {value}: expected at least 1")


@dataclass(frozen=True)
class SensorPacket:
    """What the sensors showed at a time."""

    values: Float32Array
    """(P,), physical units."""
    capture_ns: int


class SensedWorld:
    """Time goes on in it from the first :meth:`advance_to`; the robot goes on with its last command.

    With each placement the sensors' and the camera's rates begin anew, with a packet and a frame of the start, so an
    attempt is the same whenever it begins.
    """

    def __init__(
        self, robot: SimulatedRobot, camera: SimulatedCamera, rates: Rates, sensor_noise: np.ndarray | float = 0.0
    ) -> None:
        """Args:
        robot: the world; placed.
        camera: what looks at it.
        rates: of sensors and camera.
        sensor_noise: standard deviations (P,) of the sensors' noise, physical units.
        """
        self.robot, self.camera, self._rates = robot, camera, rates
        self._sensor_noise = np.asarray(sensor_noise, np.float64)
        self._rng = np.random.default_rng(0)
        self._now_ns: int | None = None
        self._begun_ns = 0
        self._packets = self._frames = 0
        """Packets and frames since then that were due, the first ones included."""
        self.packets = 0
        """Packets of the sensors, ever."""
        self._newest: SensorPacket | None = None

    @property
    def newest(self) -> SensorPacket:
        """The newest packet of the sensors; there is one once time has begun."""
        assert self._newest is not None, "advance_to() has not been called"
        return self._newest

    @property
    def now_ns(self) -> int | None:
        """What time it is in it; None before its time has begun."""
        return self._now_ns

    @property
    def longest_rest_ns(self) -> int:
        """At most this long nothing is due."""
        return min(self._rates.sensors_ns, _SECOND_NS // self._rates.camera_hz)

    @property
    def next_due_ns(self) -> int:
        """When something happens next: a packet, a frame, or a frame's end of latency."""
        release_ns = self.camera.release_ns
        return min(self._packet_due_ns, self._frame_due_ns, sys.maxsize if release_ns is None else release_ns)

    def counters(self) -> dict[str, float]:
        """What the robot counts; for any thread."""
        return self.robot.counters()

    def place(self, goal: np.ndarray, start: np.ndarray, seed: int, clock: Callable[[], int] | None = None) -> None:
        """Place goal and robot now; all noise follows from ``seed`` from here on.

        By a ``clock``, what placing takes has passed when the first packet and frame are taken.
        """
        of_sensors, of_camera = np.random.default_rng(seed).spawn(2)
        self._rng = of_sensors
        self.camera.begin(of_camera)
        self.robot.place(goal, start)
        if self._now_ns is not None:
            self._begin(clock() if clock else self._now_ns)

    def command(self, action: np.ndarray) -> None:
        """Let the robot obey ``action`` (A,) from now on."""
        self.robot.command(action)

    def stop(self) -> None:
        """Let the robot brake and rest."""
        self.robot.stop()

    def advance_to(self, now_ns: int, clock_ns: int | None = None) -> None:
        """Let the world go on until ``now_ns``, through all that is due; the first call begins its time.

        Args:
            now_ns: until when.
            clock_ns: what time it is already, where the world goes on in portions to catch up.

        Raises:
            ServiceError: a sensor shows what is not finite, or nothing can be drawn here.
        """
        if self._now_ns is None:
            self._begin(now_ns)
            return
        self.forget_before(now_ns - LONGEST_GAP_NS)
        while (due_ns := self.next_due_ns) <= now_ns:
            self._move_to(due_ns)
            self.camera.release(due_ns)
            if due_ns == self._packet_due_ns:
                self._sense(due_ns)
            if due_ns == self._frame_due_ns:
                self._capture(due_ns, now_ns if clock_ns is None else clock_ns)
        self._move_to(now_ns)

    def forget_before(self, then_ns: int) -> None:
        """Let what time there is left until ``then_ns`` pass unnoticed: the world stands still in it."""
        if self._now_ns is not None and self._now_ns < then_ns:
            self._begun_ns += then_ns - self._now_ns
            self._now_ns = then_ns

    def close(self) -> None:
        """Let go of what draws."""
        self.camera.close()

    # ------------------------------------------------------------------ what is due

    @property
    def _packet_due_ns(self) -> int:
        return self._begun_ns + self._packets * self._rates.sensors_ns

    @property
    def _frame_due_ns(self) -> int:
        # In whole numbers from the beginning: a period of 33.3 ms must not add up its rounding.
        return self._begun_ns + self._frames * _SECOND_NS // self._rates.camera_hz

    def _begin(self, now_ns: int) -> None:
        self._now_ns = self._begun_ns = now_ns
        self._packets = self._frames = 0
        self._sense(now_ns)
        self._frames = 1
        self.camera.capture(self.robot.data, now_ns, at_once=True)

    def _move_to(self, now_ns: int) -> None:
        assert self._now_ns is not None
        if now_ns > self._now_ns:  # a clock never runs back
            self.robot.advance(now_ns - self._now_ns)
            self._now_ns = now_ns

    def _sense(self, now_ns: int) -> None:
        values = np.asarray(self.robot.sense())
        if not np.isfinite(values).all():
            raise ServiceError(f"a sensor of {type(self.robot).__name__} gave {values}: expected finite numbers")
        if self._sensor_noise.any():
            values = values + self._sensor_noise * self._rng.standard_normal(values.shape)
        self._newest = SensorPacket(values.astype(np.float32), now_ns)
        self._packets += 1
        self.packets += 1

    def _capture(self, due_ns: int, clock_ns: int) -> None:
        self._frames += 1
        # What would be pushed out of the buffer before anyone can take it is not worth drawing.
        if clock_ns - due_ns >= BUFFERED_FRAMES * _SECOND_NS // self._rates.camera_hz:
            self.camera.miss(1)
        else:
            self.camera.capture(self.robot.data, due_ns)
