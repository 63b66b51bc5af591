"""What a receiving thread leaves for a service: payloads in, checked messages out."""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from typing import Generic, NamedTuple, TypeVar

from common.clock import Clock
from common.codec import decode
from common.errors import MessageError
from common.messages import Dimensions
from common.topics import Topic
from common.transport import Transport

Message = TypeVar("Message")
logger = logging.getLogger(__name__)


class Refusals:
    """Counts messages that were dropped, and logs the first of each kind."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()

    def refuse(self, topic: str, reason: object) -> None:
        """Count one dropped message."""
        self.counts[topic] += 1
        if self.counts[topic] == 1:
            logger.error("dropped a message on %s (more are only counted): %s", topic, reason)

    @property
    def total(self) -> int:
        """All dropped messages."""
        return self.counts.total()


class Arrived(NamedTuple, Generic[Message]):
    """A message and when it came."""

    message: Message
    at_ns: int
    """Receiver's monotonic clock."""


class Inbox(Generic[Message]):
    """Payloads of one topic, waiting for the service's loop.

    The callback only enqueues and notifies ``wake``; decoding happens where the message is taken. Full inboxes drop
    their oldest payload: numbered streams get it again, and of the others only the newest counts.
    """

    def __init__(
        self,
        transport: Transport,
        topic: Topic,
        expected: type[Message],
        wake: threading.Condition,
        clock: Clock,
        refusals: Refusals,
        *,
        dimensions: Dimensions | None = None,
        capacity: int = 1,
        any_run: bool = False,
    ) -> None:
        self._topic, self._expected, self._dimensions = topic, expected, dimensions
        self._wake, self._clock, self._refusals = wake, clock, refusals
        self._payloads: deque[tuple[bytes, int]] = deque(maxlen=capacity)
        transport.subscribe(topic, self._receive, any_run=any_run)

    def __bool__(self) -> bool:
        return bool(self._payloads)

    def take(self) -> list[Arrived[Message]]:
        """Decode and remove all that is waiting, oldest first; what cannot be used is dropped and counted."""
        messages: list[Arrived[Message]] = []
        while self._payloads:
            payload, at_ns = self._payloads.popleft()
            try:
                messages.append(Arrived(decode(payload, self._expected, self._dimensions), at_ns))
            except MessageError as error:
                self._refusals.refuse(self._topic.name, error)
        return messages

    def take_newest(self) -> Arrived[Message] | None:
        """The newest usable message, if one is waiting."""
        messages = self.take()
        return messages[-1] if messages else None

    def _receive(self, payload: bytes) -> None:
        self._payloads.append((payload, self._clock.now_ns()))
        with self._wake:
            self._wake.notify_all()
