"""Minimum-time Ball-in-Cup (thesis 7.1): swing a ball on a string into the cup. -1 a step."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from services.robot_bridge.rendering import Window
from services.robot_bridge.tasks.control_suite import ControlSuiteTask

BALL_START_X, BALL_START_Z = (-0.2, 0.2), (0.2, 0.5)
"""Metres, joint positions, as in dm_control."""
CAMERA_WINDOW = Window(top=20, left=100, height=100, width=120)
"""What the thesis's learning system saw (100 x 120) of dm_control's default picture: the cup wherever it goes, and the
ball's centre in a fifth of the initial policy's steps. Where the ball hangs at rest, it is below the window."""
LARGEST_POSITIONS = 0.3, 0.3, 0.5, 0.6
"""Metres: cup x, z and ball x, z as joint positions. Full forces that change direction at random times exceed these and
the velocities in one step of a hundred."""
LARGEST_VELOCITIES = 2.5, 2.5, 4.0, 4.0
"""m/s, in the same order."""


class BallInCup(ControlSuiteTask):
    """Cup and ball positions and velocities as dm_control gives them. The goal never moves."""

    MODEL = "ball_in_cup"
    ALGORITHM_PRESET = "dm_ball_in_cup"
    # "thesis" has the limit that section 7.3 takes as its example.
    PRESETS: ClassVar = {"demo": {}, "thesis": {"time_limit": 100}}

    def _prepare_model(self) -> None:
        model, data = self._world.model, self._world.data
        target = model.site("target").id
        # Views of MuJoCo's own memory: they always show the newest positions.
        self._target, self._ball = data.site_xpos[target], data.xpos[model.body("ball").id]
        ball_radius = model.geom_size[model.geom("ball").id, 0]
        self._room = model.site_size[target] - ball_radius
        """Largest distance per axis of the ball's centre from the target's, metres."""

    def _draw_goal(self) -> None:
        """The goal is the cup."""

    def _place_agent(self) -> None:
        while True:
            x, z = self._rng.uniform(*BALL_START_X), self._rng.uniform(*BALL_START_Z)
            self._world.reset(np.array([0.0, 0.0, x, z]))
            if not self._world.in_contact:  # with the cup
                return

    def _at_goal(self) -> bool:
        x, _, z = abs(self._target - self._ball) < self._room
        return bool(x and z)

    def _proprioception(self) -> np.ndarray:
        if self.WINDOW:
            return self._world.data.qvel
        return np.concatenate([self._world.data.qpos, self._world.data.qvel])

    def _proprioception_limits(self) -> np.ndarray:
        return np.array(LARGEST_VELOCITIES if self.WINDOW else LARGEST_POSITIONS + LARGEST_VELOCITIES)


class BallInCupVisual(BallInCup):
    """The positions are only in the frames."""

    WINDOW = CAMERA_WINDOW
