"""Whether an attempt may start: who must be there, and a first observation whose answer shows that the ring is closed.

First observations that nobody answers in time are asked again, ever more seldom: over a link that is too slow for them
they would only stand in each other's way.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from common import topics
from common.service import Service
from services.robot_bridge.config import RobotBridgeSettings
from services.robot_bridge.watchdog import Watchdog

logger = logging.getLogger(__name__)

PEERS = (topics.ACTOR, topics.REPLAY)
"""Without these no attempt starts: nobody would act, or nothing would be kept."""
ASKED_AT_ONCE = 4
"""So many unanswered first observations in a row are followed by the next one at once, each later one after twice the
time of the one before it."""
LONGEST_PERIOD_NS = 8_000_000_000
UNANSWERED_UNTIL_TOLD = 6
"""First observations in a row that nobody answers in time, until it is said: an actor may need a moment to begin."""
NO_ANSWER = "an answer to a first observation: if actor and link are well, frames take too long (robot_bridge.encoding)"
WAITING_TOLD_NS = 10_000_000_000
"""How often the log says what the robot waits for."""


class Engagement:
    """What the bridge knows of it; the bridge moves the robot, and publishes."""

    def __init__(
        self,
        service: Service,
        settings: RobotBridgeSettings,
        watchdog: Watchdog,
        waits_for_camera: Callable[[], bool],
    ) -> None:
        """Args:
        service: knows its peers.
        settings: for how long an answer is fresh, and a peer may be silent.
        watchdog: may be latched.
        waits_for_camera: True while there is no camera frame that is new enough.
        """
        self._service, self._watchdog = service, watchdog
        self._waits_for_camera = waits_for_camera
        self._stop_after_ns = round(settings.stop_after * 1e9)
        self._peer_grace_s = settings.peer_grace
        self.answered = False
        """True from an answer on until a peer is gone, the camera stalls, or the robot is latched."""
        self.asking = False
        """True while an observation is out only to see whether it is answered."""
        self.waits_for: str | None = None
        """What the robot stands still for, for people."""
        self.unanswered = 0
        """First observations of this bridge that nobody has answered in time."""
        self._unanswered_in_a_row = 0
        self._ask_again_ns = 0
        self._told_ns = service.clock.now_ns()

    def holds(self) -> bool:
        """True while an attempt may start."""
        gone = any(self._service.peer_age_s(peer) > self._peer_grace_s for peer in PEERS)
        if self._watchdog.latched or gone or self._waits_for_camera():
            self.answered = False
        return self.answered

    def may_ask(self) -> bool:
        """True if a first observation is worth while now; says what is missing if it is not."""
        return not self._lacks() and self._service.clock.now_ns() >= self._ask_again_ns

    def _lacks(self) -> bool:
        missing = [peer for peer in PEERS if self._service.peer_state(peer) not in ("running", "draining")]
        missing += ["camera"] if self._waits_for_camera() else []
        if not (missing or self._watchdog.latched):
            return False
        self._unanswered_in_a_row = self._ask_again_ns = 0  # Who comes is asked at once.
        self.waits_for = "resume" if self._watchdog.latched else " and ".join(missing)
        self._tell()
        return True

    def ask(self) -> None:
        """A first observation is published now."""
        if not self._unanswered_in_a_row:
            logger.info("actor and replay are there: asking for a first answer")
        self.waits_for = NO_ANSWER if self._unanswered_in_a_row >= UNANSWERED_UNTIL_TOLD else None
        if self.waits_for:
            self._tell(at_once=self._unanswered_in_a_row == UNANSWERED_UNTIL_TOLD)
        self.asking = True

    def asked(self) -> None:
        """It has been answered by now, or an answer would come too late."""
        self.asking = False
        if self.answered:
            self._unanswered_in_a_row = 0
            self.waits_for = None
        elif not self._watchdog.latched:  # which had cut the wait short
            self.unanswered += 1
            self._unanswered_in_a_row += 1
            doublings = max(0, self._unanswered_in_a_row - ASKED_AT_ONCE)
            period_ns = min(self._stop_after_ns << doublings, LONGEST_PERIOD_NS)
            self._ask_again_ns = self._service.clock.now_ns() + max(0, period_ns - self._stop_after_ns)

    def _tell(self, at_once: bool = False) -> None:
        now_ns = self._service.clock.now_ns()
        if at_once or now_ns - self._told_ns > WAITING_TOLD_NS:
            self._told_ns = now_ns
            logger.warning("the robot waits for: %s", self.waits_for)
