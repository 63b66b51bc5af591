"""What the sender of a numbered stream holds for repairs, and which repair is to go when.

Two questions are TCP's, and so are the answers; time is told, and no thread is held.

*Is it lost, or only late?* A connection keeps order. So a message is lost once one that was sent after it has arrived
(RFC 8985, RACK). Where nothing arrives any more, it counts as lost after the time that acknowledgements take, with room
for their variation (RFC 6298), doubled with each repair of it. That is only a guess, so one message is tried first.

*How much may be on its way?* A window of repairs that have been sent and are neither acknowledged nor lost. It grows
with each that arrives and halves when one is lost (RFC 5681), so repairs adapt to what the network link leaves them;
the oldest message goes first, because the receiver needs it first.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from common.messages import Int64Array

LEAST_TIMEOUT_S = 0.5
"""A message of which nothing is known is not sent again before this has passed: it may still be on its way."""
FIRST_TIMEOUT_S = 1.0
"""The same before the first acknowledgement (RFC 6298, 2.1)."""
MAX_DOUBLINGS = 4
"""Of the time-out, with the repairs of one message."""
MAX_RANGES = 64
"""Missing ranges in one acknowledgement; the rest follow in later ones."""
INITIAL_WINDOW_BYTES = 256 * 1024
"""Repairs that may be on their way at first; what a connection's buffers hold over a slow link."""


@dataclass(slots=True)
class _Retained:
    payload: bytes
    first_sent_ns: int
    last_sent_ns: int
    order: int
    """Of its last sending, among all sendings."""
    repairs: int = 0
    ambiguous: bool = False
    """Sent again without being known as lost: which of the two arrives cannot be told (Karn's rule)."""


class AcknowledgedTime:
    """How long it takes from sending a message to its acknowledgement, at most (RFC 6298)."""

    def __init__(self) -> None:
        self._smoothed_ns = 0.0
        self._variation_ns = 0.0
        self.timeout_ns = round(FIRST_TIMEOUT_S * 1e9)
        """After this much silence, nothing is expected any more."""

    def measure(self, elapsed_ns: int) -> None:
        """Take in one measurement."""
        if not self._smoothed_ns:
            self._smoothed_ns, self._variation_ns = float(elapsed_ns), elapsed_ns / 2
        else:
            self._variation_ns += (abs(self._smoothed_ns - elapsed_ns) - self._variation_ns) / 4
            self._smoothed_ns += (elapsed_ns - self._smoothed_ns) / 8
        self.timeout_ns = max(round(LEAST_TIMEOUT_S * 1e9), round(self._smoothed_ns + 4 * self._variation_ns))


class RepairWindow:
    """How many bytes of repairs may be on their way (RFC 5681, 3.1, in units of the messages themselves)."""

    def __init__(self, size_bytes: float) -> None:
        self.size_bytes = size_bytes
        self._threshold = math.inf
        self._shrunk_at = -1

    def arrived(self, size_bytes: int) -> None:
        """Grow: by each message at first, after a loss by one message per window."""
        share = 1.0 if self.size_bytes < self._threshold else min(1.0, size_bytes / self.size_bytes)
        self.size_bytes += share * size_bytes

    def lost(self, size_bytes: int, order: int, newest_order: int) -> None:
        """Halve, but once for all the losses among what had been sent by then.

        Args:
            size_bytes: of the lost message; the window holds at least that.
            order: of the lost sending.
            newest_order: of the newest sending of all.
        """
        if order <= self._shrunk_at:
            return
        self._shrunk_at = newest_order
        self.size_bytes = self._threshold = max(self.size_bytes / 2, float(size_bytes))


class RetainedMessages:
    """What the sender of one stream holds until it is acknowledged, bounded in time and memory."""

    def __init__(self, max_age_ns: int, max_bytes: int, *, one_connection: bool) -> None:
        """Args:
        max_age_ns, max_bytes: limits of what is held.
        one_connection: repairs travel in order with the messages that are sent for the first time.
        """
        self._messages: OrderedDict[int, _Retained] = OrderedDict()
        self._max_age_ns, self._max_bytes = max_age_ns, max_bytes
        self._repairs_path = 0 if one_connection else 1
        self._acknowledged_seq = 0
        self._order = -1
        self._arrived_order = [-1, -1]
        """Newest sending that is known to have arrived, of first ones and of repairs if those travel apart."""
        self._news_ns = [0, 0]
        """When that was heard."""
        self._newest_sent_ns = 0
        """When the newest sending that has arrived had left, of first ones."""
        self._time = AcknowledgedTime()
        self._heard_ns = 0
        """When the last acknowledgement came."""
        self._before_silence = -1
        """Newest sending before the acknowledgements last fell silent: its time would measure an outage."""
        self._window: RepairWindow | None = None
        """None while nothing is missing: what was known of the network link is old then."""
        self._in_flight: dict[int, _Retained] = {}
        """Repairs on their way, in the order of sending."""
        self._in_flight_bytes = 0
        self.next_seq = 0
        """Number the next message will get."""
        self.retained_bytes = 0
        self.given_up = 0
        """Messages dropped unacknowledged, because they were too old or too many."""

    def __len__(self) -> int:
        return len(self._messages)

    @property
    def oldest_seq(self) -> int:
        """Oldest message that can still be resent."""
        return next(iter(self._messages), self.next_seq)

    def retain(self, seq: int, payload: bytes, now_ns: int) -> None:
        """Keep message ``seq``, which is being sent now, unless it has been acknowledged already."""
        if seq != self.next_seq:
            raise ValueError(f"seq: expected {self.next_seq}, got {seq}")
        self.next_seq += 1
        if seq < self._acknowledged_seq:
            return
        self._order += 1
        self._messages[seq] = _Retained(payload, now_ns, now_ns, self._order)
        self.retained_bytes += len(payload)
        while len(self._messages) > 1 and self._over_limit(now_ns):
            self._drop_oldest()
            self.given_up += 1

    def acknowledge(self, next_seq: int, missing: Int64Array | Sequence[Sequence[int]], now_ns: int) -> None:
        """Learn what has arrived and what has not; forget all messages before ``next_seq``.

        The last of them may be one that is not retained yet.

        Args:
            missing: half-open ranges in rising order; see :class:`~common.messages.Acknowledgement`.
        """
        # No later one can have arrived, whatever the receiver says.
        self._acknowledged_seq = max(self._acknowledged_seq, min(next_seq, self.next_seq + 1))
        ranges = [(int(start), int(end)) for start, end in missing]
        newest = self._arrived_order[0]
        if now_ns - self._heard_ns > self._time.timeout_ns:
            self._before_silence = self._order
        self._heard_ns = now_ns
        while self._messages and self.oldest_seq < next_seq:
            seq = self.oldest_seq
            self._note_arrival(seq, self._messages[seq], now_ns)
            self._drop_oldest()
        for seq in self._arrived_repairs(ranges):
            self._note_arrival(seq, self._messages[seq], now_ns)
        # What is before a gap, or before the empty range that tells of the newest, has arrived.
        for start, _ in reversed(ranges):
            message = self._messages.get(start - 1)
            if message and not message.repairs:
                self._note_arrival(start - 1, message, now_ns)
                break
        if self._arrived_order[0] > max(newest, self._before_silence):
            self._time.measure(now_ns - self._newest_sent_ns)
        self._find_lost_repairs(now_ns)
        if not ranges and not self._in_flight:
            self._window = None

    def due(self, ranges: Iterator[tuple[int, int]], now_ns: int) -> Iterator[bytes]:
        """Payloads of the missing messages that are to be sent again now, the oldest first."""
        for start, end in ranges:
            for seq in range(max(start, self.oldest_seq), min(end, self.next_seq)):
                message = self._messages.get(seq)
                if message is None or seq in self._in_flight:
                    continue
                # A repair that is no longer on its way has been found lost.
                is_lost = message.repairs > 0 or message.order < self._arrived_order[0]
                if not is_lost and not self._is_overdue(message, now_ns):
                    continue
                size = len(message.payload)
                if self._window is None:
                    self._window = RepairWindow(INITIAL_WINDOW_BYTES if is_lost else size)
                if self._in_flight and self._in_flight_bytes + size > self._window.size_bytes:
                    return
                message.ambiguous = message.ambiguous or not is_lost
                message.repairs += 1
                self._order += 1
                message.last_sent_ns, message.order = now_ns, self._order
                self._in_flight[seq] = message
                self._in_flight_bytes += size
                yield message.payload

    def _arrived_repairs(self, ranges: Sequence[tuple[int, int]]) -> list[int]:
        """Repairs on their way that are in none of the ranges, which say so."""
        gaps = [(start, end) for start, end in ranges if start < end]
        if not gaps:
            return []
        # A list that is full says nothing of what lies behind it.
        known_end = gaps[-1][1] if len(gaps) >= MAX_RANGES else ranges[-1][1]
        arrived = []
        for seq in self._in_flight:
            gap = bisect_right(gaps, (seq, math.inf)) - 1
            if seq < known_end and (gap < 0 or seq >= gaps[gap][1]):
                arrived.append(seq)
        return arrived

    def _note_arrival(self, seq: int, message: _Retained, now_ns: int) -> None:
        if self._take_from_flight(seq) and self._window:
            self._window.arrived(len(message.payload))
        path = self._path(message)
        if not message.ambiguous and message.order > self._arrived_order[path]:
            self._arrived_order[path] = message.order
            self._news_ns[path] = now_ns
            if path == 0:
                self._newest_sent_ns = message.last_sent_ns

    def _find_lost_repairs(self, now_ns: int) -> None:
        for seq, message in list(self._in_flight.items()):
            overtaken = message.order < self._arrived_order[self._repairs_path]
            if overtaken or self._is_overdue(message, now_ns):
                message.ambiguous = message.ambiguous or not overtaken
                self._take_from_flight(seq)
                if self._window:
                    self._window.lost(len(message.payload), message.order, self._order)

    def _is_overdue(self, message: _Retained, now_ns: int) -> bool:
        # While later and later ones arrive, what is behind them is late, however long it takes (RFC 6298, 5.3).
        since_ns = max(message.last_sent_ns, self._news_ns[self._path(message)])
        return now_ns - since_ns >= self._time.timeout_ns << min(message.repairs, MAX_DOUBLINGS)

    def _path(self, message: _Retained) -> int:
        return self._repairs_path if message.repairs else 0

    def _take_from_flight(self, seq: int) -> bool:
        """Return whether it was on its way."""
        message = self._in_flight.pop(seq, None)
        if message:
            self._in_flight_bytes -= len(message.payload)
        return message is not None

    def _over_limit(self, now_ns: int) -> bool:
        oldest = next(iter(self._messages.values()))
        return self.retained_bytes > self._max_bytes or now_ns - oldest.first_sent_ns > self._max_age_ns

    def _drop_oldest(self) -> None:
        seq, message = self._messages.popitem(last=False)
        self._take_from_flight(seq)
        self.retained_bytes -= len(message.payload)
