"""A dot with velocity in a walled square, driven by its acceleration (thesis 8.1.4)."""

from __future__ import annotations

import numpy as np

from common.messages import Float32Array

POSITION_LIMIT = 1.0
"""The walls are at +- this, in both axes."""
WALL_RESTITUTION = -0.1
"""A wall turns the velocity across it into this share of it."""
MAX_ACCELERATION = 1.0
MAX_SPEED = 2.0
"""Highest speed per axis: accelerating by 1 over the whole width of 2 gives sqrt(2 * 1 * 2)."""


class Dot:
    """Position and velocity per axis; the acceleration stays until the next command."""

    def __init__(self) -> None:
        self.position = np.zeros(2)
        self.velocity = np.zeros(2)
        self._acceleration = np.zeros(2)

    def place(self, position: np.ndarray) -> None:
        """Put the dot at rest at ``position``."""
        self.position = np.array(position, dtype=np.float64)
        self.stop()

    def command(self, acceleration: Float32Array) -> None:
        """Accelerate by ``acceleration`` (2,) from now on."""
        self._acceleration = np.asarray(acceleration, dtype=np.float64)

    def stop(self) -> None:
        """Brake: no velocity, no acceleration."""
        self.velocity = np.zeros(2)
        self._acceleration = np.zeros(2)

    def advance(self, duration_s: float) -> None:
        """Let ``duration_s`` world seconds pass: exact for a constant acceleration, then the walls."""
        self.position += self.velocity * duration_s + 0.5 * self._acceleration * duration_s**2
        self.velocity += self._acceleration * duration_s
        outside = np.abs(self.position) > POSITION_LIMIT
        self.position[outside] = np.sign(self.position[outside]) * POSITION_LIMIT
        self.velocity[outside] *= WALL_RESTITUTION
