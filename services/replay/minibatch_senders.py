"""The two ways of a minibatch to the learner: as row numbers, or as the arrays themselves."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque

from common import topics
from common.codec import encode
from common.errors import TransportError
from common.frame_ring import RingWriter, array_minibatch
from common.messages import Int64Array, RowMinibatch
from common.service import Service

LOST_AFTER_S = {"map": 1.0, "arrays": 5.0}
"""A minibatch that the learner misses this long after replay has put it is sent again; arrays may be in buffers."""


class MinibatchSender(ABC):
    """Sends minibatches to one learner, in order."""

    lost_after_s: float
    """A minibatch that the learner still misses so long after everything was put is lost."""

    @abstractmethod
    def send(self, rows: Int64Array, learner_incarnation: int, ordinal: int) -> bool:
        """Send the transitions at ``rows`` (B,); False if the ring's writer has overtaken all of them."""

    @abstractmethod
    def quiet_s(self) -> float:
        """Seconds since the last minibatch was on its way; 0 while one still waits."""

    def forget(self) -> None:
        """Drop what waits: its learner is gone."""
        return

    def stop(self) -> None:
        """Stop; what waits is not sent."""
        return


class RowSender(MinibatchSender):
    """For a learner that maps the ring: the numbers are all it needs."""

    lost_after_s = LOST_AFTER_S["map"]

    def __init__(self, service: Service) -> None:
        self._clock = service.clock
        self._publisher = service.transport.publisher(topics.ROW_MINIBATCH)
        self._sent_ns = self._clock.now_ns()

    def send(self, rows: Int64Array, learner_incarnation: int, ordinal: int) -> bool:
        self._publisher.put(encode(RowMinibatch(learner_incarnation, ordinal, rows)))
        self._sent_ns = self._clock.now_ns()
        return True

    def quiet_s(self) -> float:
        return (self._clock.now_ns() - self._sent_ns) / 1e9


class ArraySender(MinibatchSender):
    """For a learner on another computer: megabytes, put from a thread of their own.

    A slow or dead link delays the next minibatch, never replay's other work. The learner's credit bounds how many wait.
    """

    lost_after_s = LOST_AFTER_S["arrays"]

    def __init__(self, service: Service, ring: RingWriter, max_bytes: int) -> None:
        self._ring, self._max_bytes = ring, max_bytes
        self._clock = service.clock
        self._publisher = service.transport.publisher(topics.ARRAY_MINIBATCH)
        self._wake = self._clock.condition()
        self._waiting: deque[bytes] = deque()
        self._putting = False
        self._sent_ns = self._clock.now_ns()
        self._stopping = False
        self._thread = self._clock.thread(self._run, "minibatch sender")
        self._thread.start()

    def send(self, rows: Int64Array, learner_incarnation: int, ordinal: int) -> bool:
        parts = array_minibatch(self._ring, rows, learner_incarnation, ordinal, self._max_bytes)
        with self._wake:
            self._waiting.extend(encode(part) for part in parts)
            self._wake.notify()
        return bool(parts)

    def quiet_s(self) -> float:
        with self._wake:
            waits = self._putting or self._waiting
            return 0.0 if waits else (self._clock.now_ns() - self._sent_ns) / 1e9

    def forget(self) -> None:
        with self._wake:
            self._waiting.clear()

    def stop(self) -> None:
        with self._wake:
            self._stopping = True
            self._wake.notify()
        self._thread.join(0.2)  # A put that is stuck in a dead link ends with the session.

    def _run(self) -> None:
        while True:
            with self._wake:
                self._putting = False
                self._sent_ns = self._clock.now_ns()
                while not (self._waiting or self._stopping):
                    self._clock.wait(self._wake)
                if self._stopping:
                    return
                payload = self._waiting.popleft()
                self._putting = True
            try:
                self._publisher.put(payload)
            except TransportError:
                return  # The session was closed around a put that was stuck in a dead link.
