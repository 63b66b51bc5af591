"""The offset to the bridge's clock, by questions and answers over the transport, in a thread of their own.

The bridge's clock is the run's: its cycle, its record and an emulated network go by it. So every other service asks
the bridge, and two of those know the offset between each other by the difference.
"""

from __future__ import annotations

import logging
import math
from typing import Any

from common import topics
from common.clock import Clock
from common.clock_offset import Exchange, OffsetEstimate, OffsetEstimator
from common.codec import decode, encode
from common.errors import MessageError, TransportError
from common.inbox import Refusals
from common.messages import ClockReading
from common.transport import Transport

EXCHANGE_S = {topics.ACTOR: 0.1, topics.REPLAY: 1.0, topics.LEARNER: 1.0}
"""Pause between two questions for the bridge's time; the actor's offset splits the age of each action."""
EXCHANGE_TIMEOUT_S = 0.5
"""An answer that takes longer tells nothing worth waiting for."""
UNKNOWN = 0, -1
"""Offset and bound, nanoseconds, before the first answer."""

logger = logging.getLogger(__name__)


def serve_clock(transport: Transport, clock: Clock, incarnation: int) -> None:
    """Answer everybody who asks for this clock's time."""

    def answer(_: bytes) -> bytes:
        received_ns = clock.now_ns()
        return encode(ClockReading(incarnation, received_ns, clock.now_ns()))

    transport.serve(topics.CLOCK, answer)


class OffsetTracker:
    """Knows what the bridge's clock shows, and how wrong that can be."""

    def __init__(self, service: str, transport: Transport, clock: Clock, refusals: Refusals) -> None:
        self._pause_s = EXCHANGE_S[service]
        self._transport, self._clock, self._refusals = transport, clock, refusals
        self._estimator = OffsetEstimator()
        self._estimate: OffsetEstimate | None = None
        self._bridge = 0
        self._unanswered = 0
        self._wake = clock.condition()
        self._stopping = False
        self._thread = clock.thread(self._run, "clock")

    def start(self) -> None:
        """Begin to ask."""
        self._thread.start()

    def stop(self) -> None:
        """Stop asking; a question that is out is waited for."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        if self._thread.is_alive():
            self._thread.join(2 * EXCHANGE_TIMEOUT_S)

    def at(self, now_ns: int) -> tuple[int, int]:
        """Bridge's clock minus this one at ``now_ns`` and the largest error of that, nanoseconds."""
        estimate = self._estimate
        if estimate is None:
            return UNKNOWN
        offset_ns, bound_ns = estimate.at(now_ns)
        return round(offset_ns), math.ceil(bound_ns)

    def details(self) -> dict[str, Any]:
        """For the record."""
        estimate = self._estimate
        known = estimate and {
            "offset_s": round(estimate.offset_ns / 1e9, 7),
            "bound_ms": round(estimate.bound_ns / 1e6, 4),
            "drift_ppm": round(estimate.drift * 1e6, 3),
            "drift_bound_ppm": round(estimate.drift_bound * 1e6, 3),
            "best_round_trip_ms": round(estimate.best_round_trip_ns / 1e6, 4),
        }
        counts = {"exchanges": self._estimator.exchanges, "unanswered": self._unanswered}
        return {**(known or {}), **counts, "jumps": self._estimator.jumps}

    def _run(self) -> None:
        while not self._stopping:
            try:
                self._exchange()
            except TransportError:
                self._unanswered += 1
            with self._wake:
                if not self._stopping:
                    self._clock.wait(self._wake, self._pause_s)

    def _exchange(self) -> None:
        asked_ns = self._clock.now_ns()
        payload = self._transport.query(topics.CLOCK, timeout_s=EXCHANGE_TIMEOUT_S)
        returned_ns = self._clock.now_ns()
        # What took no time, or far more than it may, was cut in two by a jump of this clock, and tells nothing.
        if payload is None or not 0 <= returned_ns - asked_ns <= 2e9 * EXCHANGE_TIMEOUT_S:
            self._unanswered += 1
            return
        try:
            reading = decode(payload, ClockReading)
            self._take(reading, Exchange(asked_ns, reading.received_ns, reading.answered_ns, returned_ns))
        except (MessageError, ValueError) as error:
            self._refusals.refuse(topics.CLOCK.name, error)

    def _take(self, reading: ClockReading, exchange: Exchange) -> None:
        if reading.incarnation != self._bridge:
            self._bridge = reading.incarnation
            self._estimator.forget()
        before = self._estimator.jumps
        self._estimate = self._estimator.add(exchange)
        jumps = self._estimator.jumps
        # The first, the second, the fourth ...: a clock that is being set right by force seems to jump all the time.
        if jumps > before and jumps & before == 0:
            logger.warning(
                "this computer's clock or the bridge's has jumped: they are %+.3f s further apart; begun anew (%d x)",
                self._estimator.last_jump_ns / 1e9,
                jumps,
            )
