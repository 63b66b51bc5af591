"""Vector-ChargerDetector: drive a Vector as soon as possible to where it sees its charger's marker before it.

Thesis 8.1.3. The arena, the marker and the wheels are chosen such that the untrained policy reaches the charger about
as often as the thesis counts (table 8.1; ``python -m experiments.robot_hits``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from common.config import setting
from common.errors import ConfigError
from common.messages import Float32Array, UInt8Array
from services.robot_bridge.robots.arena import FRONT_CAMERA
from services.robot_bridge.robots.base import SimulatedRobot
from services.robot_bridge.robots.differential_drive import Leg
from services.robot_bridge.robots.sensed_world import Rates
from services.robot_bridge.robots.vector import IMAGES_HZ, LONGEST_PROXIMITY, RADIUS, STATE_PERIOD_NS, Marker, Vector
from services.robot_bridge.target_detection import TARGET_COLOURS, colour_mask, largest_blob
from services.robot_bridge.tasks.base import Outcome
from services.robot_bridge.tasks.robot_task import View
from services.robot_bridge.tasks.wheeled_robot_task import WheeledRobotTask, WheeledSettings, straight, turn

TARGET = TARGET_COLOURS["vector"]
RESET_SPEED = 0.1
"""m/s, of the wheels in the reset's manoeuvre."""


@dataclass(frozen=True)
class VectorSettings(WheeledSettings):
    """Keys of ``[task]``. World frame: metres, x along the arena, the charger at the wall at its end."""

    time_limit: int = setting(300, low=1)
    """Action cycles: 30 s."""
    reset_steps: int = setting(20, low=0)
    """Action cycles that a reset takes."""
    action_cycle_time: float = setting(0.1, low=0.001, high=10.0)
    """Seconds."""
    max_speed: float = setting(160.0, low=1.0, high=220.0)
    """mm/s of each wheel, the bound of the actions."""
    wheel_lag: float = setting(0.08, low=0.0, high=2.0)
    """s, in which a wheel's speed comes 63 % closer to the commanded one."""
    arena_length: float = setting(0.6, low=0.1, high=20.0)
    """m."""
    arena_width: float = setting(0.45, low=0.1, high=20.0)
    """m."""
    wall_height: float = setting(0.16, low=0.01, high=5.0)
    """m."""
    field_of_view: float = setting(50.0, low=10.0, high=120.0)
    """Degrees, from the camera's picture's top to its bottom."""
    battery_life: float = setting(2700.0, low=1.0)
    """s, from full to empty."""
    marker_width: float = setting(0.12, low=0.01, high=1.0)
    """m."""
    marker_height: float = setting(0.08, low=0.01, high=1.0)
    """m."""
    threshold: float = setting(0.22, low=0.0, high=1.0)
    """The charger is near enough where its marker takes at least this share of the image ..."""
    centred_within: float = setting(0.2, low=0.0, high=0.5)
    """... its middle is at most this far from the image's, across, as a share of the image's width ..."""
    nearest_proximity: float = setting(130.0, low=0.0, high=LONGEST_PROXIMITY)
    """... and the proximity sensor shows at most this, mm."""
    tips_after: float = setting(3.0, low=0.1)
    """s of driving against a wall, without a break, after which the robot lies on its back until it is reset."""

    def __post_init__(self) -> None:
        self.expect_room(RADIUS)
        marker = self.marker()
        if marker.width > self.arena_width or marker.above_floor + marker.height > self.wall_height:
            raise ConfigError(
                f"marker_width = {self.marker_width}, marker_height = {self.marker_height}: expected a marker that "
                f"fits on a wall {self.arena_width} m wide and wall_height = {self.wall_height} m high"
            )

    def marker(self) -> Marker:
        """Return the marker that these settings describe."""
        return Marker(self.marker_width, self.marker_height)


class VectorChargerDetector(WheeledRobotTask):
    """-1 a step until the charger's marker is large and in the middle of the image, and the charger near."""

    SETTINGS = VectorSettings
    RATES = Rates(sensors_ns=STATE_PERIOD_NS, camera_hz=IMAGES_HZ)
    VIEW = View(FRONT_CAMERA, height=120, width=160, frame_stack=4)
    ALGORITHM_PRESET = "vector"
    TARGET_RANGE = TARGET
    RADIUS = RADIUS
    _settings: VectorSettings

    def _build_robot(self) -> SimulatedRobot:
        settings = self._settings
        return Vector(
            settings.arena(),
            settings.marker(),
            lag=settings.wheel_lag,
            battery=settings.battery(),
            tips_after=settings.tips_after,
            field_of_view=settings.field_of_view,
        )

    def _draw_manoeuvre(self) -> Sequence[Leg]:
        """Back away, then turn to a random heading."""
        draw, speed = self._rng.uniform, RESET_SPEED
        side = speed if self._rng.integers(2) else -speed
        return straight(-speed, draw(1.0, 2.0)), turn(side, draw(0.0, 1.6)), straight(0.0, 0.2)

    def _judge(self, frame: UInt8Array, proprioception: Float32Array) -> Outcome:
        settings, marker = self._settings, largest_blob(colour_mask(frame, TARGET))
        reached = (
            marker is not None
            and marker.share >= settings.threshold
            and abs(marker.centre[0]) / 2 <= settings.centred_within  # centre: -1 to 1 over the image's width
            and float(proprioception[0]) <= settings.nearest_proximity
        )
        return Outcome(reward=-1.0, terminated=reached)

    def _proprioception_limits(self) -> tuple[np.ndarray, np.ndarray]:
        slowest, fastest = self._action_limits()
        return np.array([0.0, *slowest]), np.array([LONGEST_PROXIMITY, *fastest])
