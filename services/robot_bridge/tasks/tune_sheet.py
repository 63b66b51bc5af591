"""Draws the sheet of masks that :mod:`services.robot_bridge.tasks.tune` writes. Colours are red first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import cv2
import numpy as np

from common.messages import UInt8Array
from services.robot_bridge.target_detection import Mask, largest_blob

TILE_WIDTH, TILE_HEIGHT = 168, 252
"""At most, pixels."""
LEAST_COLUMNS = 4
"""Room for the large pictures."""
GAP = 12
LABEL_HEIGHT = 24
_HINT = "Orange: as given. Where a bound is good, the masks beside it look the same."
_PAPER, _INK, _MARK, _WARNING = (250, 250, 248), (30, 30, 30), (208, 96, 0), (190, 20, 20)
_INSIDE, _OUTSIDE, _EDGE = (255, 255, 255), (44, 48, 56), (140, 140, 140)
_FONT, _FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.42


class LabelledMask(Protocol):
    """One tile of the sheet."""

    @property
    def bound(self) -> str: ...
    @property
    def is_given(self) -> bool: ...
    @property
    def mask(self) -> Mask: ...
    @property
    def share(self) -> float: ...


def draw_sheet(
    frame: UInt8Array, title: str, mask: Mask, rows: Sequence[Sequence[LabelledMask]], warning: str | None
) -> UInt8Array:
    """Return the sheet, (h, w, 3): the picture, its mask and the largest blob on top, then a row for each bound.

    Args:
        frame: (H, W, 3).
        title: what range it is.
        mask: of that range.
        rows: masks to draw, the given bound of each marked.
        warning: what is wrong with the mask, if anything is.
    """
    height, width = mask.shape
    scale = min(TILE_WIDTH / width, TILE_HEIGHT / height)
    tile = max(1, round(scale * width)), max(1, round(scale * height))
    large = 2 * tile[0], 2 * tile[1]
    columns = max([LEAST_COLUMNS, *(len(row) for row in rows)])
    row_height = tile[1] + LABEL_HEIGHT + GAP
    top = 3 * LABEL_HEIGHT + GAP
    header = top + large[1] + GAP
    size = header + len(rows) * row_height, GAP + columns * (TILE_WIDTH + GAP), 3
    sheet = np.full(size, _PAPER, np.uint8)
    blob = largest_blob(mask)
    _write(sheet, title, GAP, LABEL_HEIGHT)
    text = f"{_percent(np.count_nonzero(mask) / mask.size)} of the picture"
    text += f", largest blob {_percent(blob.share)} (in its box)" if blob else ""
    _write(sheet, warning or text, GAP, 2 * LABEL_HEIGHT, _WARNING if warning else _INK)
    _write(sheet, _HINT, GAP, 3 * LABEL_HEIGHT)
    _paste(sheet, _scaled(frame, large), GAP, top)
    drawn = _scaled(_drawn(mask), large)
    if blob:
        left, upper, blob_width, blob_height = blob.box
        corners = [(left, upper), (left + blob_width, upper + blob_height)]
        (x0, y0), (x1, y1) = ((round(x * large[0] / width), round(y * large[1] / height)) for x, y in corners)
        cv2.rectangle(drawn, (x0, y0), (min(x1, large[0] - 1), min(y1, large[1] - 1)), _MARK, 2)
    _paste(sheet, drawn, 2 * GAP + large[0], top)
    for number, row in enumerate(rows):
        y = header + number * row_height
        for column, variation in enumerate(row):
            x = GAP + column * (TILE_WIDTH + GAP)
            colour = _MARK if variation.is_given else _INK
            _write(sheet, f"{variation.bound}   {_percent(variation.share)}", x, y + LABEL_HEIGHT - 8, colour)
            _paste(sheet, _scaled(_drawn(variation.mask), tile), x, y + LABEL_HEIGHT)
            if variation.is_given:
                lower_right = x + tile[0] + 1, y + LABEL_HEIGHT + tile[1] + 1
                cv2.rectangle(sheet, (x - 2, y + LABEL_HEIGHT - 2), lower_right, _MARK, 2)
    return sheet


def _drawn(mask: Mask) -> UInt8Array:
    return np.where(mask[..., None], np.uint8(_INSIDE), np.uint8(_OUTSIDE))


def _scaled(picture: UInt8Array, size: tuple[int, int]) -> UInt8Array:
    """Scale to (width, height): enlarged pixels stay squares."""
    smaller = size[0] < picture.shape[1]
    scaled: UInt8Array = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_NEAREST)
    return scaled


def _paste(sheet: UInt8Array, picture: UInt8Array, left: int, top: int) -> None:
    height, width = picture.shape[:2]
    cv2.rectangle(sheet, (left - 1, top - 1), (left + width, top + height), _EDGE, 1)  # A full mask is white on white.
    sheet[top : top + height, left : left + width] = picture


def _write(sheet: UInt8Array, text: str, left: int, bottom: int, colour: tuple[int, int, int] = _INK) -> None:
    cv2.putText(sheet, text, (left, bottom), _FONT, _FONT_SCALE, colour, 1, cv2.LINE_AA)


def _percent(share: float) -> str:
    return f"{100 * share:.2f} %"
