"""Create-Reacher: drive a Create 2 as soon as possible to one of two green papers on the walls of its arena.

Thesis 4.3.2. The arena, the papers, the webcam and the wheels' lag are chosen such that the untrained policy reaches a
paper about as often as the thesis counts (table 8.1; ``python -m experiments.robot_hits``).
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
from services.robot_bridge.robots.create import (
    PACKET_PERIOD_NS,
    RADIUS,
    STRONGEST_SIGNAL,
    WALL_SENSORS,
    Create,
    Papers,
)
from services.robot_bridge.robots.differential_drive import Leg
from services.robot_bridge.robots.sensed_world import Rates
from services.robot_bridge.target_detection import TARGET_COLOURS, colour_mask, share
from services.robot_bridge.tasks.base import Outcome
from services.robot_bridge.tasks.robot_task import View
from services.robot_bridge.tasks.wheeled_robot_task import WheeledRobotTask, WheeledSettings, straight, turn

TARGET = TARGET_COLOURS["create"]
RESET_SPEED = 0.3
"""m/s, of the wheels in the reset's manoeuvre."""
REST = straight(0.0, 0.1)
"""Between the parts of the reset's manoeuvre."""


@dataclass(frozen=True)
class CreateSettings(WheeledSettings):
    """Keys of ``[task]``. World frame: metres, x along the arena, the papers on the walls at its ends."""

    time_limit: int = setting(333, low=1)
    """Action cycles: 15 s."""
    reset_steps: int = setting(65, low=0)
    """Action cycles that a reset takes."""
    action_cycle_time: float = setting(0.045, low=0.001, high=10.0)
    """Seconds."""
    paper_size: float = setting(0.3, low=0.01, high=2.0)
    """m, of a paper's sides."""
    paper_height: float = setting(0.28, low=0.0, high=5.0)
    """m, of a paper's middle above the floor."""
    camera_height: float = setting(0.28, low=0.1, high=2.0)
    """m, of the webcam above the floor."""
    threshold: float = setting(0.12, low=0.0, high=0.99)
    """The goal is reached where more than this share of the image is of the papers' colour."""

    def __post_init__(self) -> None:
        self.expect_room(RADIUS)
        half = self.paper_size / 2
        upright = half <= self.paper_height <= self.wall_height - half
        if not upright or self.paper_size > self.arena_width:
            raise ConfigError(
                f"paper_size = {self.paper_size}, paper_height = {self.paper_height}: expected papers that fit on "
                f"walls {self.arena_width} m wide and wall_height = {self.wall_height} m high"
            )


class CreateReacher(WheeledRobotTask):
    """-1 a step until a paper is large enough in the image."""

    SETTINGS = CreateSettings
    RATES = Rates(sensors_ns=PACKET_PERIOD_NS, camera_hz=30)
    VIEW = View(FRONT_CAMERA, height=120, width=160, frame_stack=3)
    ALGORITHM_PRESET = "create"
    TARGET_RANGE = TARGET
    RADIUS = RADIUS
    _settings: CreateSettings

    def _build_robot(self) -> SimulatedRobot:
        settings = self._settings
        return Create(
            settings.arena(),
            Papers(settings.paper_size, settings.paper_height),
            lag=settings.wheel_lag,
            battery=settings.battery(),
            camera_height=settings.camera_height,
            field_of_view=settings.field_of_view,
        )

    def _draw_manoeuvre(self) -> Sequence[Leg]:
        """Turn a little, back away, turn on, and come forward."""
        draw, speed = self._rng.uniform, RESET_SPEED
        side = speed if self._rng.integers(2) else -speed
        return (
            turn(side, draw(0.25, 0.75)),
            REST,
            straight(-speed, draw(1.0, 1.5)),
            REST,
            turn(side, draw(0.5, 1.0)),
            REST,
            straight(speed, draw(0.3, 0.6)),
            REST,
        )

    def _judge(self, frame: UInt8Array, proprioception: Float32Array) -> Outcome:
        return Outcome(reward=-1.0, terminated=share(colour_mask(frame, TARGET)) > self._settings.threshold)

    def _proprioception_limits(self) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(len(WALL_SENSORS)), np.full(len(WALL_SENSORS), STRONGEST_SIGNAL)
