"""One direction of a TCP connection over a lossy link, in simulated time.

To the application a lost packet is not a loss but a delay: the packet is sent again once the sender has noticed, and
what came behind it waits for it. How long that takes, and how much may be on its way meanwhile, is what this models,
after Linux's defaults:

* a packet is lost when one that was sent later has been acknowledged and a quarter of the round trip is over (RACK,
  RFC 8985; at once from the third acknowledgement on). So a stream of small messages repairs a loss one message and
  one round trip later;
* a tail loss probe two round trips after the newest data; without an answer the retransmission time-out, the round trip
  and 200 ms, which doubles each time. As long as the window has room, new data goes out meanwhile, and the first of it
  that gets through after an outage shows what was lost; a full window may stay silent for as long as the outage;
* a congestion window: ten packets at first, doubling per round trip up to the first loss, which leaves 70 % of it
  (CUBIC's factor), then growing by one packet per round trip; one packet after a time-out.

Not modelled: delayed acknowledgements (each packet is acknowledged at once), acknowledgements on the back of data,
CUBIC's growth over seconds without loss, the receiver's window, reordering, the handshake. Nor is BBR, which some
systems prefer: it does not take a loss for congestion, so it carries more over a link that loses some percent.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from deploy.network import DropCause

SEGMENT_BYTES = 1448
"""What a packet carries at an MTU of 1500."""
HEADER_BYTES = 52
"""IP, TCP and its time stamps; also the size of an acknowledgement."""
INITIAL_WINDOW = 10.0
WINDOW_AFTER_LOSS = 0.7
MIN_VARIATION_NS = 200_000_000
"""Linux's least retransmission time-out is this much above the round trip."""
MAX_TIMEOUT_NS = 120_000_000_000
UNKNOWN_ROUND_TRIP_TIMEOUT_NS = 1_000_000_000
TIMER_NS = 8_000_000
"""The least that the kernel's loss timers add: two ticks, of which most kernels have 250 a second."""
RACK_CERTAIN = 3
"""Packets acknowledged behind a missing one, from which on it is lost without further waiting."""


class Timers(Protocol):
    """Time, and what is to happen then."""

    def now_ns(self) -> int: ...
    def call_later(self, delay_ns: int, callback: Callable[[], None]) -> None: ...


class PacketPath(Protocol):
    """One direction of the link: takes a packet now; when it arrives, or why it does not."""

    def send(self, size_bytes: int) -> int | DropCause:
        """Return nanoseconds until the packet of ``size_bytes`` arrives."""
        ...


@dataclass(eq=False, slots=True)
class _Segment:
    number: int
    size: int
    deliver: Callable[[], None] | None
    """Of the message that ends with this segment."""
    sent_ns: int = 0
    order: int = 0
    """Counts transmissions: what has a smaller one was sent earlier."""
    transmissions: int = 0
    lost: bool = False


@dataclass(frozen=True, slots=True)
class _Transmission:
    order: int
    sent_ns: int
    first: bool
    """Of its segment: only then does the answer tell the round trip."""


class TcpStream:
    """Carries messages from one end of a connection to the other, all of them, in order."""

    def __init__(self, timers: Timers, path: PacketPath, way_back: PacketPath) -> None:
        """Use ``path`` for data and ``way_back`` for its acknowledgements."""
        self._timers, self._path, self._way_back = timers, path, way_back
        self.backlog_bytes = 0
        """Written and not yet acknowledged: what the sender's buffers hold."""
        self.on_room: Callable[[], None] = lambda: None
        """Called when the backlog has become smaller."""
        self.retransmitted = 0
        """Packets sent again."""
        self._unsent: deque[_Segment] = deque()
        self._lost: deque[_Segment] = deque()
        self._outstanding: dict[int, _Segment] = {}
        """Sent and not acknowledged, by number, in order; those that count as lost too."""
        self._next_number = 0
        self._order = 0
        self._window = INITIAL_WINDOW
        self._threshold = float("inf")
        self._recovery_end = 0
        """While segments before this one are outstanding, a further loss belongs to the same event."""
        self._in_flight = 0
        self._sent_ns = 0
        self._newest_order = 0
        """Of the newest transmission that is known to have arrived."""
        self._round_trip_ns = 0
        """Of that transmission."""
        self._delivered_behind = 0
        """Segments that have arrived behind a missing one."""
        self._looking_again = False
        self._smoothed_ns = 0.0
        self._variation_ns = 0.0
        self._least_ns = 0
        self._backoff = 1
        self._probed = False
        self._timer = 0
        """Number of the armed timer; one that fires with another number means nothing."""
        self._received = 0
        """Receiver's: all segments before this number have come."""
        self._waiting: dict[int, _Segment] = {}
        """Receiver's: segments that came before one that is missing."""

    def write(self, size_bytes: int, deliver: Callable[[], None]) -> None:
        """Send a message; ``deliver`` is called when the other end has all of it, and all before it."""
        if not self._outstanding and self._timers.now_ns() - self._sent_ns > self._time_out_ns():
            self._window = min(self._window, INITIAL_WINDOW)  # what is known of the link is old
        self.backlog_bytes += size_bytes
        left = size_bytes
        while True:
            size = min(left, SEGMENT_BYTES)
            left -= size
            self._unsent.append(_Segment(self._next_number, size, None if left else deliver))
            self._next_number += 1
            if not left:
                break
        self._send()

    # ------------------------------------------------------------------ sender

    def _send(self) -> None:
        while self._in_flight + 1 <= self._window:
            was_idle = self._in_flight == 0
            if self._lost:
                segment = self._lost.popleft()
                if segment.number not in self._outstanding:
                    continue  # An acknowledgement came after all.
                self.retransmitted += 1
            elif self._unsent:
                segment = self._unsent.popleft()
                self._outstanding[segment.number] = segment
            else:
                return
            segment.lost = False
            self._in_flight += 1
            self._put(segment)
            is_new = segment.transmissions == 1 and self._backoff == 1 and not self._in_recovery()
            if was_idle or is_new:
                self._arm()  # New data puts the probe off: its acknowledgement would tell as much.

    def _put(self, segment: _Segment) -> None:
        self._order += 1
        segment.order, segment.sent_ns = self._order, self._timers.now_ns()
        segment.transmissions += 1
        self._sent_ns = segment.sent_ns
        transmission = _Transmission(segment.order, segment.sent_ns, segment.transmissions == 1)
        transit_ns = self._path.send(segment.size + HEADER_BYTES)
        if not isinstance(transit_ns, DropCause):
            self._timers.call_later(transit_ns, lambda: self._receive(segment, transmission))

    def _acknowledge(self, received: int, waiting: tuple[int, ...], answered: _Transmission) -> None:
        """Sender's end of an acknowledgement.

        Args:
            received: all segments before this number have come.
            waiting: those that have come beyond it.
            answered: what made the receiver send it.
        """
        outstanding = self._outstanding
        acknowledged = [number for number in waiting if number in outstanding]
        for number in outstanding:
            if number >= received:
                break
            acknowledged.append(number)
        round_trip_ns = self._timers.now_ns() - answered.sent_ns
        if answered.order > self._newest_order:
            self._newest_order, self._round_trip_ns = answered.order, round_trip_ns
        if answered.first:
            self._measure(round_trip_ns)
        is_limiting = bool(self._unsent) or 2 * self._in_flight > self._window
        for number in acknowledged:
            segment = outstanding.pop(number)
            self.backlog_bytes -= segment.size
            self._in_flight -= not segment.lost
        self._delivered_behind = len(waiting)
        if acknowledged:
            self._backoff, self._probed = 1, False
            if is_limiting:
                self._grow(len(acknowledged))
            self._arm(progress=True)
        self._detect_losses()
        self._send()
        if acknowledged:
            self.on_room()

    def _grow(self, acknowledged: int) -> None:
        if self._window < self._threshold:
            self._window += acknowledged
        else:
            self._window += acknowledged / self._window

    def _measure(self, round_trip_ns: int) -> None:
        """RFC 6298."""
        if not self._least_ns:
            self._smoothed_ns, self._variation_ns = float(round_trip_ns), round_trip_ns / 2
            self._least_ns = round_trip_ns
            return
        self._variation_ns += (abs(self._smoothed_ns - round_trip_ns) - self._variation_ns) / 4
        self._smoothed_ns += (round_trip_ns - self._smoothed_ns) / 8
        self._least_ns = min(self._least_ns, round_trip_ns)

    def _detect_losses(self) -> None:
        """RACK: what was sent before something that has arrived is lost, if it is late enough."""
        now_ns = self._timers.now_ns()
        certain = self._delivered_behind >= RACK_CERTAIN or self._in_recovery()
        patience_ns = self._round_trip_ns + (0 if certain else self._least_ns // 4)
        latest_ns = 0
        for segment in self._outstanding.values():
            if segment.order > self._newest_order:
                if segment.transmissions == 1:
                    break  # and all behind it too
                continue
            if segment.lost:
                continue
            left_ns = segment.sent_ns + patience_ns - now_ns
            if left_ns <= 0:
                self._lose(segment)
            else:
                latest_ns = max(latest_ns, left_ns)
        if latest_ns and not self._looking_again:
            self._looking_again = True
            self._timers.call_later(latest_ns + TIMER_NS, self._look_again)

    def _look_again(self) -> None:
        self._looking_again = False
        self._detect_losses()
        self._send()

    def _in_recovery(self) -> bool:
        return bool(self._outstanding) and next(iter(self._outstanding)) < self._recovery_end

    def _lose(self, segment: _Segment) -> None:
        if not self._in_recovery():
            self._recovery_end = self._next_unsent()
            self._threshold = self._window = max(2.0, self._window * WINDOW_AFTER_LOSS)
        segment.lost = True
        self._in_flight -= 1
        self._lost.append(segment)

    def _next_unsent(self) -> int:
        return self._unsent[0].number if self._unsent else self._next_number

    # ------------------------------------------------------------------ sender's timer

    def _arm(self, *, progress: bool = False) -> None:
        """Begin to wait anew, for a probe or for the time-out; ``progress``: because something has arrived."""
        self._timer += 1
        if not self._outstanding:
            return
        number = self._timer
        if not self._least_ns or self._backoff > 1 or self._in_recovery():
            self._timers.call_later(self._time_out_ns(), lambda: self._time_out(number))
            return
        # Of a single segment the acknowledgement may be delayed on purpose.
        wait_ns = round(2 * self._smoothed_ns) + (MIN_VARIATION_NS if len(self._outstanding) == 1 else TIMER_NS)
        left_ns = self._time_out_ns() if progress else self._until_time_out_ns()
        self._timers.call_later(min(wait_ns, left_ns) if left_ns > 0 else wait_ns, lambda: self._probe(number))

    def _until_time_out_ns(self) -> int:
        """Counted from when the oldest segment was sent; not above 0 if that is over."""
        oldest = next(iter(self._outstanding.values()))
        return oldest.sent_ns + self._time_out_ns() - self._timers.now_ns()

    def _time_out_ns(self) -> int:
        if not self._least_ns:
            return UNKNOWN_ROUND_TRIP_TIMEOUT_NS * self._backoff
        return min(
            self._backoff * round(self._smoothed_ns + max(MIN_VARIATION_NS, 4 * self._variation_ns)), MAX_TIMEOUT_NS
        )

    def _probe(self, number: int) -> None:
        """Ask with the last segment whether all has come; once, then there is only the time-out."""
        if number != self._timer:
            return
        if self._probed:
            wait_ns = max(0, self._until_time_out_ns())
        else:
            self._probed = True
            self.retransmitted += 1
            self._put(next(reversed(self._outstanding.values())))
            wait_ns = self._time_out_ns()
        self._timers.call_later(wait_ns, lambda: self._time_out(number))

    def _time_out(self, number: int) -> None:
        """Nothing has come back: all that is on its way counts as lost, and is sent again carefully."""
        if number != self._timer:
            return
        if self._backoff == 1:
            self._threshold = max(2.0, self._window * WINDOW_AFTER_LOSS)
        self._backoff *= 2
        self._recovery_end = self._next_unsent()
        self._window, self._in_flight = 1.0, 0
        self._lost = deque(self._outstanding.values())
        for segment in self._lost:
            segment.lost = True
        self._send()

    # ------------------------------------------------------------------ receiver

    def _receive(self, segment: _Segment, transmission: _Transmission) -> None:
        if segment.number >= self._received and segment.number not in self._waiting:
            self._waiting[segment.number] = segment
            while (ready := self._waiting.pop(self._received, None)) is not None:
                self._received += 1
                if ready.deliver:
                    ready.deliver()
        transit_ns = self._way_back.send(HEADER_BYTES)
        if not isinstance(transit_ns, DropCause):
            received, waiting = self._received, tuple(self._waiting)
            self._timers.call_later(transit_ns, lambda: self._acknowledge(received, waiting, transmission))
