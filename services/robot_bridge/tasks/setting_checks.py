"""Checks of settings that are lists of numbers: postures, places, boxes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from common.errors import ConfigError


def expect_numbers(name: str, values: Sequence[float], count: int) -> None:
    """Check that setting ``name`` is ``count`` numbers.

    Raises:
        ConfigError: it is not.
    """
    if len(values) != count or not np.isfinite(values).all():
        raise ConfigError(f"{name} = {list(values)}: expected {count} finite numbers")


def expect_place(name: str, place: Sequence[float], low: Sequence[float], high: Sequence[float], where: str) -> None:
    """Check that setting ``name``, a place (x, y or x, y, z) m, lies between two others; ``where`` says what they are.

    Raises:
        ConfigError: it does not; the message names the axis.
    """
    for axis, value, least, most in zip("xyz"[: len(place)], place, low, high, strict=True):
        if not least <= value <= most:
            raise ConfigError(
                f"{name} = {list(place)}: expected {axis} from {least:.4g} to {most:.4g} m, {where}, got {value}"
            )


def expect_angles(name: str, angles: Sequence[float], low: Sequence[float], high: Sequence[float]) -> None:
    """Check that each joint's angle, rad, of setting ``name`` is in its range.

    Raises:
        ConfigError: a joint's is not; the message names it.
    """
    for number, (angle, least, most) in enumerate(zip(angles, low, high, strict=True), start=1):
        if not least <= angle <= most:
            raise ConfigError(
                f"{name} = {list(angles)}: expected joint {number} from {least:.4g} to {most:.4g} rad, got {angle}"
            )
