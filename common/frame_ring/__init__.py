"""The experience ring: one memory-mapped file that replay writes and the learner reads.

Rows (one per experience) and camera frames (each once) wrap separately; a row lives as long as its oldest frame.
"""

from common.frame_ring.arrays import array_minibatch, minibatch_from_arrays
from common.frame_ring.crop import (
    central_crop,
    central_crop_offset,
    crop_shape,
    draw_crop_offset,
)
from common.frame_ring.layout import RingLayout
from common.frame_ring.reader import Gathered, RingReader, drop_overtaken
from common.frame_ring.view import RingView
from common.frame_ring.writer import RingWriter

RING_FILE = "ring"
"""Name of the ring's file in a run's folder."""

__all__ = [
    "RING_FILE",
    "Gathered",
    "RingLayout",
    "RingReader",
    "RingView",
    "RingWriter",
    "array_minibatch",
    "central_crop",
    "central_crop_offset",
    "crop_shape",
    "draw_crop_offset",
    "drop_overtaken",
    "minibatch_from_arrays",
]
