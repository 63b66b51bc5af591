"""What a relay does with the bytes of its connections, one way at a time."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from deploy.network.conditions import SEGMENT_BYTES, Direction, NetworkConditions
from deploy.network.part import DirectionCounts
from deploy.network.schedule import StreamSchedule, direction_random

_READ_BYTES = 32 * 1024
_MAX_WAITING_BYTES = 4 * 1024 * 1024
"""Bound on what one way of a connection holds, for links whose rate does not bound it."""
_MIN_PAUSE_S = 0.005
"""In an outage a full queue does not get shorter: look again this much later, s."""


class RelayedDirection:
    """One direction of the link, shared by all connections."""

    def __init__(self, conditions: NetworkConditions, direction: Direction, seed: int) -> None:
        one_way = conditions.direction(direction)
        self.schedule = StreamSchedule(conditions, direction, direction_random(seed, direction))
        self.limited = one_way.bytes_per_s is not None
        self.split = self.limited or one_way.loss > 0 or one_way.trace is not None
        """Whether segments matter: without rate and loss, bytes that came together stay together."""
        self._counts = DirectionCounts()

    def counts(self) -> DirectionCounts:
        """The counts so far."""
        self._counts.max_queue_delay_ms = self.schedule.max_queue_delay_s * 1e3
        return self._counts

    def send(self, now_s: float, size_bytes: int) -> float:
        """When a segment sent now may be delivered, s."""
        segment = self.schedule.offer(now_s, size_bytes)
        self._counts.packets_in += 1
        self._counts.bytes_in += size_bytes
        self._counts.retransmitted += segment.retransmitted
        return segment.delivery_s

    def delivered(self, now_s: float, due_s: float, size_bytes: int) -> None:
        """Note that a segment has been handed over."""
        self._counts.packets_delivered += 1
        self._counts.bytes_delivered += size_bytes
        self._counts.max_late_ms = max(self._counts.max_late_ms, (now_s - due_s) * 1e3)


class Way:
    """One way of one connection: what one end sends, in order, until the other end gets it."""

    def __init__(self, direction: RelayedDirection, now_s: Callable[[], float]) -> None:
        self.direction = direction
        self.source: asyncio.Transport | None = None
        self.sink: asyncio.Transport | None = None
        self.ended = False
        """The end of the stream has been delivered, or there is nobody left to deliver it to."""
        self.sink_full = False
        self._now_s = now_s
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._waiting_bytes = 0
        self._last_due_s = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._on_end: Callable[[], None] = lambda: None

    def connect(self, source: asyncio.Transport, sink: asyncio.Transport, on_end: Callable[[], None]) -> None:
        """Begin: both ends are there."""
        self.source, self.sink, self._on_end = source, sink, on_end
        self.advance()

    def receive(self, data: bytes) -> None:
        """The source has sent ``data``."""
        if self.ended:
            return
        step = SEGMENT_BYTES if self.direction.split else len(data)
        now_s = self._now_s()
        for begin in range(0, len(data), step):
            segment = data[begin : begin + step]
            self._enqueue(self.direction.send(now_s, len(segment)), segment)
        self.advance()

    def finish(self) -> None:
        """The source will send no more. That is news too, and travels behind the data."""
        self._enqueue(self.direction.schedule.offer(self._now_s(), 0).delivery_s, b"")
        self.advance()

    def discard(self) -> None:
        """The sink is gone, and so is what was on its way to it."""
        self.sink = None
        self._waiting.clear()
        self._waiting_bytes = 0
        self._end()

    def advance(self) -> None:
        """Deliver what is due, read on or stop reading, and come back when there is more to do."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        now_s = self._now_s()
        if self.sink is not None:
            self._deliver(self.sink, now_s)
        if self.ended:
            return
        backlog_s = self.direction.schedule.backlog_s(now_s) if self.direction.limited else 0.0
        queue_s = self.direction.schedule.queue_s(now_s)
        self._choose_reading(backlog_s > queue_s)
        wake_s = self._waiting[0][0] if self._waiting and self.sink is not None else math.inf
        excess_s = backlog_s - queue_s
        if excess_s > 0:  # nothing of this way may be waiting when others have filled the queue
            wake_s = min(wake_s, now_s + max(excess_s, _MIN_PAUSE_S))
        if wake_s < math.inf:
            self._timer = self._loop.call_later(max(0.0, wake_s - now_s), self.advance)

    def _enqueue(self, due_s: float, segment: bytes) -> None:
        self._last_due_s = max(due_s, self._last_due_s)
        self._waiting.append((self._last_due_s, segment))
        self._waiting_bytes += len(segment)

    def _deliver(self, sink: asyncio.Transport, now_s: float) -> None:
        ready: list[bytes] = []
        at_end = False
        while self._waiting and self._waiting[0][0] <= now_s:
            due_s, segment = self._waiting.popleft()
            self._waiting_bytes -= len(segment)
            if segment:
                self.direction.delivered(now_s, due_s, len(segment))
                ready.append(segment)
            else:
                at_end = True
        if ready:
            sink.write(ready[0] if len(ready) == 1 else b"".join(ready))
        if at_end:
            if not sink.is_closing():
                with suppress(OSError):  # the other side has closed the connection meanwhile
                    sink.write_eof()
            self._end()

    def _end(self) -> None:
        if not self.ended:
            self.ended = True
            self._on_end()

    def _choose_reading(self, queue_full: bool) -> None:
        if self.source is None or self.source.is_closing():
            return
        full = self.sink_full or queue_full or self._waiting_bytes > _MAX_WAITING_BYTES
        if full and self.source.is_reading():
            self.source.pause_reading()
        elif not full and not self.source.is_reading():
            self.source.resume_reading()


class End(asyncio.BufferedProtocol):
    """One end of a relayed connection: ``out`` carries what it sends, ``back`` what it gets."""

    def __init__(self, out: Way, back: Way, on_connected: Callable[[asyncio.Transport], None]) -> None:
        self._out = out
        self._back = back
        self._on_connected = on_connected
        self._buffer = bytearray(_READ_BYTES)
        self._sent_all = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        transport.pause_reading()  # until the other end is there
        self._on_connected(transport)

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        self._out.receive(bytes(memoryview(self._buffer)[:nbytes]))

    def eof_received(self) -> bool:
        self._finish()
        return True  # the other way stays open

    def connection_lost(self, exc: Exception | None) -> None:
        self._back.discard()
        self._finish()

    def pause_writing(self) -> None:
        self._back.sink_full = True
        self._back.advance()

    def resume_writing(self) -> None:
        self._back.sink_full = False
        self._back.advance()

    def _finish(self) -> None:
        if not self._sent_all:
            self._sent_all = True
            self._out.finish()
