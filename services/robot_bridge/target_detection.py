"""Where a picture shows the target's colour, and how much of it: OpenCV masks, as pure functions.

A task's goal is a share of the newest frame (thesis 4.3.2, 8.1): whatever has the colour counts as the target, so the
range has to leave out everything else. ``python -m services.robot_bridge.tasks.tune`` shows what a range takes in.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
import numpy.typing as npt

from common.errors import ConfigError
from common.messages import Float32Array, UInt8Array

Mask = npt.NDArray[np.bool_]
"""(H, W): True where the picture has the target's colour."""
HUES = 180
"""OpenCV's hues: half degrees, 0 to 179; 0 is red, and so is 179."""
_EIGHT_NEIGHBOURS = 8


class ColourSpace(StrEnum):
    """What the three numbers of a colour are, as OpenCV has them."""

    BGR = "bgr"
    """Blue, green, red, each 0 to 255."""
    HSV = "hsv"
    """Hue 0 to 179, saturation and value 0 to 255: brightness is value alone, so light changes little else."""

    @property
    def channels(self) -> str:
        """A letter for each number."""
        return self.value.upper()

    @property
    def largest(self) -> tuple[int, int, int]:
        """The largest value of each number."""
        return (HUES - 1, 255, 255) if self is ColourSpace.HSV else (255, 255, 255)


Colour = tuple[int, int, int]


@dataclass(frozen=True)
class ColourRange:
    """The colours that count as the target's: a box, both ends included."""

    space: ColourSpace
    low: Colour
    high: Colour
    """A highest hue below the lowest one means the range over the end of the scale, e.g. reds from 170 to 10."""

    def __post_init__(self) -> None:
        for name, colour in (("low", self.low), ("high", self.high)):
            bounds = zip(colour, self.space.largest, strict=True)
            if len(colour) != 3 or not all(0 <= value <= largest for value, largest in bounds):
                limits = ", ".join(f"{c} 0-{n}" for c, n in zip(self.space.channels, self.space.largest, strict=True))
                raise ConfigError(f"colour range: {name} = {colour}: expected {limits}")
        for channel, low, high in zip(self.space.channels, self.low, self.high, strict=True):
            if low > high and channel != "H":
                raise ConfigError(f"colour range: {channel} from {low} to {high}: expected low <= high")

    def __str__(self) -> str:
        ends = zip(self.space.channels, self.low, self.high, strict=True)
        return "  ".join(f"{channel} {low}-{high}" for channel, low, high in ends)


TARGET_COLOURS = {
    "ur5": ColourRange(ColourSpace.BGR, (0, 0, 120), (50, 50, 255)),
    "create": ColourRange(ColourSpace.HSV, (30, 68, 0), (85, 255, 255)),
    "franka": ColourRange(ColourSpace.HSV, (151, 155, 84), (179, 255, 255)),
    "vector": ColourRange(ColourSpace.HSV, (0, 0, 0), (179, 255, 45)),
}
"""Robot -> its target's colour: a red blob on a monitor, green papers, a red bean bag, the charger's black marker."""


@dataclass(frozen=True)
class Blob:
    """A connected part of a mask."""

    share: float
    """Its pixels' share of the picture."""
    box: tuple[int, int, int, int]
    """Bounding box: left, top, width, height, pixels."""
    box_share: float
    """The bounding box's share of the picture."""
    centre: tuple[float, float]
    """Mean position of its pixels: x to the right, y down, -1 and 1 at the picture's edges."""


def colour_mask(frame: UInt8Array, colours: ColourRange) -> Mask:
    """Return where ``frame``, (H, W, 3) red first, shows one of ``colours``."""
    if colours.space is ColourSpace.BGR:
        return _in_range(frame, colours.low[::-1], colours.high[::-1])
    hsv = cv2.cvtColor(frame, cv2.COLOR_RGB2HSV)
    (hue_low, *low), (hue_high, *high) = colours.low, colours.high
    if hue_low <= hue_high:
        return _in_range(hsv, colours.low, colours.high)
    return _in_range(hsv, (hue_low, *low), (HUES - 1, *high)) | _in_range(hsv, (0, *low), (hue_high, *high))


def _in_range(picture: UInt8Array, low: tuple[int, ...], high: tuple[int, ...]) -> Mask:
    inside: UInt8Array = cv2.inRange(picture, np.array(low), np.array(high))
    return inside != 0


def share(mask: Mask) -> float:
    """Return the mask's share of the picture, 0 to 1."""
    return int(np.count_nonzero(mask)) / mask.size


def largest_blob(mask: Mask) -> Blob | None:
    """Return the connected part of the mask with the most pixels, diagonal neighbours included; None if it is empty."""
    count, _, stats, centres = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=_EIGHT_NEIGHBOURS)
    if count < 2:  # number 0 is what lies around all parts
        return None
    number = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    left, top, width, height, area = (int(value) for value in stats[number])
    rows, columns = mask.shape
    x, y = centres[number]
    return Blob(
        share=area / mask.size,
        box=(left, top, width, height),
        box_share=width * height / mask.size,
        centre=((2 * float(x) + 1) / columns - 1, (2 * float(y) + 1) / rows - 1),
    )


def centre_weights(height: int, width: int) -> Float32Array:
    """Return W, (H, W) in [0, 1], of the UR5's dense reward (thesis 4.3.1): largest in the middle, least at the edges.

    The thesis does not say more of it. Here a pixel counts by its distance to the nearer edge, in each direction as a
    share of the distance from middle to edge, and the product of both.
    """
    y, x = (1 - np.abs((2 * np.arange(n) + 1) / n - 1) for n in (height, width))
    weights: Float32Array = np.outer(y, x).astype(np.float32)
    return weights


def weighted_share(mask: Mask, weights: Float32Array) -> float:
    """Return the mean over all pixels of M o W (thesis 4.3.1), for weights W, (H, W) in [0, 1]."""
    return float(np.sum(weights, where=mask, dtype=np.float64)) / mask.size


def mask_warning(mask: Mask) -> str | None:
    """Return what is wrong with a mask that is all or nothing, as a sentence for the user; None if it is neither."""
    found = np.count_nonzero(mask)
    if found == 0:
        return "no pixel has one of these colours: widen the range, or is the target not in the picture?"
    if found == mask.size:
        return "every pixel has one of these colours: narrow the range, the target cannot be told from the rest"
    return None
