"""Tells when a camera stalls: the picture that the robot acts by no longer shows where it is."""

from __future__ import annotations

import logging

logger = logging.getLogger(__name__)


class CameraWatch:
    """Decides whether the newest camera frame is too old to act by. Pure but for the log: the caller tells the time.

    A stall is an event: it is counted and logged once when it begins, and logged once when it is over.
    """

    def __init__(self, stall_after_ns: int) -> None:
        self._stall_after_ns = stall_after_ns
        self.stalled = False
        """What the last :meth:`look` returned."""
        self.stalls = 0
        """How often the camera has stalled."""

    def look(self, newest_frame_ns: int | None, now_ns: int) -> bool:
        """True while the newest frame is too old.

        Args:
            newest_frame_ns: when it was taken; None where there is no camera that could stall.
            now_ns: on the same clock.
        """
        stalled = newest_frame_ns is not None and now_ns - newest_frame_ns > self._stall_after_ns
        if newest_frame_ns is not None and stalled and not self.stalled:
            self.stalls += 1
            logger.warning("the camera has stalled: its newest frame is %.2f s old", (now_ns - newest_frame_ns) / 1e9)
        elif newest_frame_ns is not None and self.stalled and not stalled:
            logger.warning("the camera is back: its newest frame is %.2f s old", (now_ns - newest_frame_ns) / 1e9)
        self.stalled = stalled
        return stalled
