"""Draws and writes what :mod:`services.robot_bridge.preview` shows. Colours are red first."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from common.errors import ConfigError
from common.messages import UInt8Array
from common.record import write_atomically
from services.robot_bridge.target_detection import Mask

VIEW_WIDTH = 480
"""Of the agent's view and of the mask, pixels; less where that is no multiple of the frame's width."""
TILES, COLUMNS, TILE_WIDTH = 12, 3, 540
"""Of a contact sheet."""
GAP, LABEL_HEIGHT = 12, 24
_PAPER, _INK = (250, 250, 248), (30, 30, 30)
_INSIDE, _OUTSIDE = 255, 0


def panels(frame: UInt8Array, mask: Mask | None, room: UInt8Array) -> UInt8Array:
    """Return one picture: on the left the agent's view above the mask, on the right the robot from outside.

    Args:
        frame: (H, W, 3).
        mask: (H, W); None leaves its place dark.
        room: (h, w, 3), scaled to the height of the other two.
    """
    height, width = frame.shape[:2]
    scale = max(1, VIEW_WIDTH // width)
    drawn = np.where(np.zeros((height, width), bool) if mask is None else mask, np.uint8(_INSIDE), np.uint8(_OUTSIDE))
    views = np.concatenate([frame, np.repeat(drawn[..., None], 3, axis=2)])
    views = views.repeat(scale, axis=0).repeat(scale, axis=1)  # enlarged pixels stay squares
    total = views.shape[0]
    room = cv2.resize(room, (2 * round(room.shape[1] * total / room.shape[0] / 2), total), interpolation=cv2.INTER_AREA)
    return np.concatenate([views, room], axis=1)


def contact_sheet(shown: Sequence[tuple[str, UInt8Array]]) -> UInt8Array:
    """Return a sheet, (h, w, 3), of :data:`TILES` pictures or fewer, evenly spread from the first to the last.

    Args:
        shown: pictures in order, all of one size, each with its label.
    """
    chosen = [shown[number] for number in np.unique(np.linspace(0, len(shown) - 1, TILES).round().astype(int))]
    height = round(chosen[0][1].shape[0] * TILE_WIDTH / chosen[0][1].shape[1])
    rows = -(-len(chosen) // COLUMNS)
    size = GAP + rows * (height + LABEL_HEIGHT + GAP), GAP + COLUMNS * (TILE_WIDTH + GAP), 3
    sheet: UInt8Array = np.full(size, _PAPER, np.uint8)
    for number, (label, picture) in enumerate(chosen):
        row, column = divmod(number, COLUMNS)
        left, top = GAP + column * (TILE_WIDTH + GAP), GAP + row * (height + LABEL_HEIGHT + GAP) + LABEL_HEIGHT
        cv2.putText(sheet, label, (left, top - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.45, _INK, 1, cv2.LINE_AA)
        tile = cv2.resize(picture, (TILE_WIDTH, height), interpolation=cv2.INTER_AREA)
        sheet[top : top + height, left : left + TILE_WIDTH] = tile
    return sheet


def write_picture(path: Path, picture: UInt8Array) -> None:
    """Write a picture, (h, w, 3), as a PNG file.

    Raises:
        ConfigError: the folder cannot be written to.
    """
    try:
        write_atomically(path, cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes())
    except OSError as error:
        raise ConfigError(f"--preview {path.parent}: cannot be written to: {error.strerror}; choose another") from error


def write_video(path: Path, pictures: Sequence[UInt8Array], pictures_per_s: float) -> None:
    """Write pictures, (h, w, 3), all of one size, as an MP4 file.

    Raises:
        ConfigError: OpenCV cannot write it there.
    """
    height, width = pictures[0].shape[:2]
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), pictures_per_s, (width, height))
    if not video.isOpened():
        raise ConfigError(f"--preview {path.parent}: OpenCV cannot write the video {path.name} there; choose another")
    try:
        for picture in pictures:
            video.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    finally:
        video.release()
