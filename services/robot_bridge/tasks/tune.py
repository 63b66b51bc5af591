"""``python -m services.robot_bridge.tasks.tune --image F --out DIR``: which pixels a target's colour range takes in.

For each robot, or for a range of your own, it moves each bound of the range by itself, prints the mask's share of the
picture, and draws all masks as one picture, ``DIR/NAME.png``. With a good bound the target is whole, nothing else is in
the mask, and the bounds beside it give nearly the same share.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from common.console import Console
from common.errors import ConfigError, RelodError
from common.messages import UInt8Array
from common.options import output_folder
from common.record import write_atomically
from common.stop_signals import INTERRUPTED
from services.robot_bridge.target_detection import (
    TARGET_COLOURS,
    Colour,
    ColourRange,
    ColourSpace,
    Mask,
    colour_mask,
    largest_blob,
    mask_warning,
    share,
)
from services.robot_bridge.tasks.tune_sheet import draw_sheet

PROGRAM = "services.robot_bridge.tasks.tune"
OWN_RANGE = "own"
"""What a range from the command line is called."""
LONGEST_SIDE = 640
"""Larger pictures are scaled to this, pixels: tasks see 160 in a row, and there are many masks to make."""


@dataclass(frozen=True)
class Variation:
    """One mask of a sheet: the range with one bound moved."""

    bound: str
    """``R >= 120``."""
    is_given: bool
    """True if the bound is where the range has it."""
    mask: Mask

    @property
    def share(self) -> float:
        """The mask's share of the picture."""
        return share(self.mask)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the sheets and print the shares; return the exit code."""
    options = _parser().parse_args(arguments)
    console = Console()
    try:
        ranges = _ranges(options)
        frame = read_picture(options.image, console)
        paths = {name: options.out / f"{name}.png" for name in ranges}
        _refuse_to_overwrite(options.image, paths.values())
        for name, colours in ranges.items():
            rows = variations(frame, colours, options.spread, options.columns)
            mask = colour_mask(frame, colours)
            warning = mask_warning(mask)
            _write(paths[name], draw_sheet(frame, f"{name}: {colours.space.channels}  {colours}", mask, rows, warning))
            console.line(_table(name, colours, mask, rows))
            console.line(f"  {paths[name]}\n")
            if warning:
                console.error(f"{PROGRAM}: warning: {name}: {warning}")
    except KeyboardInterrupt:
        console.line("interrupted")
        return INTERRUPTED
    except RelodError as error:
        console.error(f"{PROGRAM}: error: {error}")
        return 1
    return 0


def variations(frame: UInt8Array, colours: ColourRange, spread: int, columns: int) -> list[list[Variation]]:
    """Return a row of masks for each bound of the range; none for a bound at the end of the scale, which is no bound.

    Args:
        frame: (H, W, 3) red first.
        colours: the range.
        spread: how far a bound is moved down and up at most; values beyond the scale are left out.
        columns: masks in a row, odd: the given bound is one of them.
    """
    offsets = np.unique(np.linspace(-spread, spread, columns).round().astype(int))
    rows = []
    for channel, largest in enumerate(colours.space.largest):
        for end, sign, limit in (("low", ">=", 0), ("high", "<=", largest)):
            given = getattr(colours, end)[channel]
            if given == limit:
                continue
            values = [given + int(offset) for offset in offsets if 0 <= given + offset <= largest]
            rows.append([_variation(frame, colours, end, sign, channel, value) for value in values])
    return [[moved for moved in row if moved is not None] for row in rows]


def _variation(
    frame: UInt8Array, colours: ColourRange, end: str, sign: str, channel: int, value: int
) -> Variation | None:
    """Return the mask with one bound at ``value``; None where the bound would pass the other end of the range."""
    colour = list(getattr(colours, end))
    is_given = colour[channel] == value
    colour[channel] = value
    ends = {"low": colours.low, "high": colours.high, end: tuple(colour)}
    if (ends["low"][channel] > ends["high"][channel]) != (colours.low[channel] > colours.high[channel]):
        return None
    moved = replace(colours, **ends)
    return Variation(f"{colours.space.channels[channel]} {sign} {value}", is_given, colour_mask(frame, moved))


def read_picture(path: Path, console: Console) -> UInt8Array:
    """Return the picture in a file, (H, W, 3) red first, scaled to :data:`LONGEST_SIDE` if larger, which is said.

    Raises:
        ConfigError: there is no such file, or it is no picture.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"--image {path}: cannot be read: {error.strerror}") from error
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) if content else None
    if picture is None:
        raise ConfigError(f"--image {path}: expected a picture that OpenCV can read, such as PNG or JPEG")
    longest = max(picture.shape[:2])
    if longest > LONGEST_SIDE:
        height, width = (max(1, n * LONGEST_SIDE // longest) for n in picture.shape[:2])
        console.line(f"{path}: {picture.shape[1]}x{picture.shape[0]} pixels, scaled to {width}x{height}\n")
        picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    frame: UInt8Array = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
    return frame


def _refuse_to_overwrite(image: Path, paths: Iterable[Path]) -> None:
    for path in paths:
        with contextlib.suppress(OSError):  # it is not there, or cannot be looked at: writing will tell
            if path.samefile(image):
                raise ConfigError(f"--out {path.parent}: {path} is the picture itself, --image; choose another")


def _write(path: Path, sheet: UInt8Array) -> None:
    """Write a sheet, (H, W, 3) red first, as a PNG file."""
    try:
        write_atomically(path, cv2.imencode(".png", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))[1].tobytes())
    except OSError as error:
        raise ConfigError(f"--out {path.parent}: cannot be written to: {error.strerror}; choose another") from error


def _table(name: str, colours: ColourRange, mask: Mask, rows: list[list[Variation]]) -> str:
    lines = [f"{name}: {colours}: {100 * share(mask):.2f} % of the picture"]
    blob = largest_blob(mask)
    if blob:
        x, y = blob.centre
        lines[0] += (
            f"; largest blob {100 * blob.share:.2f} %, its box {100 * blob.box_share:.2f} %, "
            f"centre ({x:+.2f}, {y:+.2f})"
        )
    for row in rows:
        lines += [f"  {v.bound:<10}{100 * v.share:7.2f} %{'  <- as given' if v.is_given else ''}" for v in row]
    return "\n".join(lines)


# ---------------------------------------------------------------------- the command line


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"python -m {PROGRAM}",
        description="Show which pixels of a picture a target's colour range takes in, for each of its bounds moved a "
        "little: shares on the screen, masks in DIR/NAME.png.",
        epilog="ranges of the robots (BGR: blue, green, red, 0-255; HSV: hue 0-179, saturation and value 0-255):\n"
        + "\n".join(f"  {robot:8}{c.space.channels}  {c}" for robot, c in TARGET_COLOURS.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--image", type=Path, required=True, metavar="F", help="a picture from the robot's camera")
    parser.add_argument("--out", type=output_folder, required=True, metavar="DIR", help="folder for the drawings")
    parser.add_argument(
        "--robot", choices=TARGET_COLOURS, nargs="+", default=None, help="whose ranges; without it, all robots'"
    )
    parser.add_argument("--space", choices=[space.value for space in ColourSpace], help="of --low and --high (hsv)")
    parser.add_argument("--low", metavar="A,B,C", help="lower ends of a range of your own, e.g. 30,68,0")
    parser.add_argument("--high", metavar="A,B,C", help="upper ends of a range of your own, e.g. 85,255,255")
    parser.add_argument("--spread", type=_spread, default=30, help="how far each bound is moved (30)")
    parser.add_argument("--columns", type=_columns, default=7, help="masks in a row, an odd number (7)")
    return parser


def _ranges(options: argparse.Namespace) -> dict[str, ColourRange]:
    """Name -> range, as the options say."""
    if (options.low is None) != (options.high is None):
        raise ConfigError("--low and --high: expected both or neither")
    if options.low is not None:
        if options.robot:
            raise ConfigError("--robot and --low: expected robots' ranges or one of your own, not both")
        low, high = _colour(options.low, "--low"), _colour(options.high, "--high")
        return {OWN_RANGE: ColourRange(ColourSpace(options.space or ColourSpace.HSV), low, high)}
    if options.space:
        raise ConfigError(f"--space {options.space}: expected --low and --high with it; robots' ranges have their own")
    return {robot: TARGET_COLOURS[robot] for robot in options.robot or TARGET_COLOURS}


def _colour(text: str, option: str) -> Colour:
    parts = text.split(",")
    if len(parts) != 3 or not all(part.strip().isdecimal() for part in parts):
        raise ConfigError(f"{option} {text}: expected three whole numbers with commas between, e.g. 30,68,0")
    a, b, c = (int(part) for part in parts)
    return a, b, c


def _spread(text: str) -> int:
    return _whole_number(text, 1, 255, "from 1 to 255")


def _columns(text: str) -> int:
    value = _whole_number(text, 3, 15, "an odd number from 3 to 15")
    if value % 2 == 0:
        raise argparse.ArgumentTypeError(f"expected an odd number from 3 to 15, got {text}")
    return value


def _whole_number(text: str, low: int, high: int, expected: str) -> int:
    if not text.isdecimal() or not low <= int(text) <= high:
        raise argparse.ArgumentTypeError(f"expected {expected}, got {text}")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
