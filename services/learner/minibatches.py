"""Where minibatches come from: rows of the mapped ring, or arrays over the network.

A thread of its own asks ahead by credit, gathers and crops, so that the next minibatch is there when an update ends.
"""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from common import topics
from common.codec import encode
from common.errors import MessageError, RingError
from common.frame_ring import (
    RingReader,
    central_crop_offset,
    crop_shape,
    draw_crop_offset,
    drop_overtaken,
    minibatch_from_arrays,
)
from common.inbox import Inbox
from common.messages import ArrayMinibatch, Credit, RowMinibatch, TaskSpec
from common.minibatch import Minibatch
from common.service import Service

logger = logging.getLogger(__name__)

CREDIT_S = 0.2
"""Period in which the credit is re-sent, so that a lost one does no harm."""


class MinibatchSource(ABC):
    """Keeps ``prefetch`` minibatches asked for and hands them out in order."""

    def __init__(self, service: Service, spec: TaskSpec, prefetch: int, *, random_crop: bool = True) -> None:
        self._service, self._spec, self._prefetch, self._random_crop = service, spec, prefetch, random_crop
        self._crop_shape = crop_shape(spec) if spec.has_camera else None
        self._rng = np.random.default_rng([service.run.seed, service.incarnation])
        self._credit_publisher = service.transport.publisher(topics.CREDIT)
        self._wake = service.clock.condition()
        self._ready: deque[Minibatch] = deque()
        self._expected = 0
        self._stopping = False
        self.dropped = 0
        """Minibatches that were overtaken by the ring's writer, or unusable."""
        self._thread = service.clock.thread(self._run, "minibatches")

    def start(self) -> None:
        """Begin to ask."""
        self._thread.start()

    def stop(self) -> None:
        """Stop asking."""
        with self._wake:
            self._stopping = True
            self._wake.notify_all()
        self._thread.join()

    def get(self, timeout_s: float) -> Minibatch | None:
        """The next minibatch, or None if none came in time."""
        with self._wake:
            if not (self._ready or self._stopping):
                self._service.clock.wait(self._wake, timeout_s)
            minibatch = self._ready.popleft() if self._ready else None
            self._wake.notify_all()
        return minibatch

    @abstractmethod
    def _has_arrived(self) -> bool:
        """True if there is something to collect."""

    @abstractmethod
    def _collect(self) -> Iterable[Minibatch | None]:
        """Minibatches of what has arrived, in order; None for one that cannot be used."""

    def _take_ordinal(self, learner_incarnation: int, ordinal: int) -> bool:
        """True if the minibatch is this learner's and new."""
        if learner_incarnation != self._service.incarnation or ordinal < self._expected:
            return False
        self._expected = ordinal + 1
        return True

    def _draw_crop(self) -> tuple[int, int]:
        if not self._spec.has_camera:
            return 0, 0
        return draw_crop_offset(self._spec, self._rng) if self._random_crop else central_crop_offset(self._spec)

    def _run(self) -> None:
        clock, sent, next_credit_ns = self._service.clock, (-1, -1), 0
        while True:
            with self._wake:
                credit = (self._expected + self._prefetch - len(self._ready), self._expected)
                if credit == sent and not self._has_arrived() and not self._stopping:
                    clock.wait(self._wake, CREDIT_S)
                if self._stopping:
                    return
                credit = (self._expected + self._prefetch - len(self._ready), self._expected)
            if credit != sent or clock.now_ns() >= next_credit_ns:
                sent, next_credit_ns = credit, clock.now_ns() + round(CREDIT_S * 1e9)
                self._credit_publisher.put(encode(Credit(self._service.incarnation, *credit)))
            for minibatch in self._collect():
                with self._wake:
                    if minibatch is None:
                        self.dropped += 1  # nothing that whoever waits for a minibatch need hear of
                    else:
                        self._ready.append(minibatch)
                        self._wake.notify_all()


class MappedMinibatches(MinibatchSource):
    """Row numbers come over the network, the data from the ring's file, read-only."""

    def __init__(
        self,
        service: Service,
        spec: TaskSpec,
        prefetch: int,
        ring: Path,
        open_ring: Callable[[Path], RingReader] = RingReader,
        *,
        random_crop: bool = True,
    ) -> None:
        super().__init__(service, spec, prefetch, random_crop=random_crop)
        self._path, self._open_ring = ring, open_ring
        self._ring: RingReader | None = None
        self._inbox = _inbox(service, topics.ROW_MINIBATCH, RowMinibatch, self._wake, spec)

    def _has_arrived(self) -> bool:
        return bool(self._inbox)

    def _collect(self) -> Iterable[Minibatch | None]:
        for message, _ in self._inbox.take():
            if self._take_ordinal(message.learner_incarnation, message.ordinal):
                yield self._gather(message)

    def _gather(self, message: RowMinibatch) -> Minibatch | None:
        try:
            ring = self._ring = self._ring or self._open()
        except RingError as error:
            self._service.refusals.refuse(topics.ROW_MINIBATCH.name, error)
            return None
        return drop_overtaken(ring.gather(message.rows, self._crop_shape, self._draw_crop()))

    def _open(self) -> RingReader:
        try:
            ring = self._open_ring(self._path)
        except RingError as error:
            raise RingError(f"{error}; is replay on this computer?") from error
        got, expected = ring.layout.proprioception_size, self._spec.dimensions.P
        if got != expected:
            ring.close()
            raise RingError(
                f"{self._path}: observations of {got} numbers, expected {expected}; "
                "is algorithm.pending_actions the same for replay and learner?"
            )
        return ring


class ReceivedMinibatches(MinibatchSource):
    """Everything comes over the network, each camera frame once per minibatch."""

    def __init__(self, service: Service, spec: TaskSpec, prefetch: int, *, random_crop: bool = True) -> None:
        super().__init__(service, spec, prefetch, random_crop=random_crop)
        self._parts: list[ArrayMinibatch] = []
        self._inbox = _inbox(service, topics.ARRAY_MINIBATCH, ArrayMinibatch, self._wake, spec)

    def _has_arrived(self) -> bool:
        return bool(self._inbox)

    def _collect(self) -> Iterable[Minibatch | None]:
        for message, _ in self._inbox.take():
            if message.part != len(self._parts) or (self._parts and message.ordinal != self._parts[0].ordinal):
                self._parts = []  # A part was lost: replay is asked again by the credit that stays open.
            if message.part == len(self._parts):
                self._parts.append(message)
            if len(self._parts) == message.parts:
                parts, self._parts = self._parts, []
                if self._take_ordinal(message.learner_incarnation, message.ordinal):
                    yield self._assemble(parts)

    def _assemble(self, parts: list[ArrayMinibatch]) -> Minibatch | None:
        try:
            return minibatch_from_arrays(parts, self._crop_shape, self._draw_crop())
        except MessageError as error:
            self._service.refusals.refuse(topics.ARRAY_MINIBATCH.name, error)
            return None


def _inbox(
    service: Service, topic: topics.Topic, expected: Any, wake: threading.Condition, spec: TaskSpec
) -> Inbox[Any]:
    return Inbox(
        service.transport,
        topic,
        expected,
        wake,
        service.clock,
        service.refusals,
        dimensions=spec.dimensions,
        capacity=64,
    )
