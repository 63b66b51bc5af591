"""When a packet that enters the link leaves it, or why it never does. Pure: no clock, no sockets.

Times are seconds since the link started. The packet link, the TCP relay and a simulation that needs a delay
model give the time of arrival and act on the answer.
"""

from __future__ import annotations

import enum
import math
import random
from collections import deque
from dataclasses import dataclass

from deploy.network.channel import Channel
from deploy.network.conditions import SEGMENT_BYTES, Direction, NetworkConditions


class DropCause(enum.Enum):
    """Why a packet does not arrive."""

    LOSS = "loss"
    """Lost on the air, after it had taken its time at the rate."""
    QUEUE = "queue"
    """It would have waited longer than ``queue_ms``, or behind ``queue_packets`` others."""
    OUTAGE = "outage"
    """It was sent, queued or in flight while the link was silent."""
    WRITE = "write"
    """The receiving device took no more packets. Found by the link, never by the schedule."""


@dataclass(frozen=True)
class OutageTimes:
    """Outage number k (from 1) silences the link during [k * every_s, k * every_s + length_s)."""

    every_s: float
    length_s: float

    @classmethod
    def from_conditions(cls, conditions: NetworkConditions) -> OutageTimes | None:
        """The outages of ``conditions``; None if there are none."""
        if not conditions.outage_s:
            return None
        return cls(conditions.outage_every_s, conditions.outage_s)

    def silent(self, time_s: float) -> bool:
        number = time_s // self.every_s
        return number >= 1 and time_s - number * self.every_s < self.length_s

    def touch(self, start_s: float, end_s: float) -> bool:
        """Whether any outage overlaps [start_s, end_s]."""
        return self.silent(start_s) or (start_s // self.every_s + 1) * self.every_s <= end_s

    def until(self, time_s: float) -> list[tuple[float, float]]:
        """Start and end of every outage that has begun by ``time_s``; the last one may end later."""
        numbers = range(1, int(time_s // self.every_s) + 1)
        return [(number * self.every_s, number * self.every_s + self.length_s) for number in numbers]

    def to_live(self, time_s: float) -> float:
        """Seconds out of the first ``time_s`` in which the link was not silent."""
        number = time_s // self.every_s
        if number < 1:
            return time_s
        if time_s - number * self.every_s < self.length_s:
            return number * self.every_s - (number - 1) * self.length_s
        return time_s - number * self.length_s

    def after(self, start_s: float, live_s: float) -> float:
        """When the link has been live for another ``live_s`` from ``start_s`` on: never inside an outage."""
        # Not by way of to_live() and back: rounding would put what waits for the end of an outage at its start.
        if math.isinf(live_s):
            return live_s
        number = start_s // self.every_s
        if self.silent(start_s):
            start_s = number * self.every_s + self.length_s
        left_s = (number + 1) * self.every_s - start_s
        if live_s < left_s:
            return start_s + live_s
        live_between_s = self.every_s - self.length_s
        passed = (live_s - left_s) // live_between_s
        resumed_s = (number + 1 + passed) * self.every_s + self.length_s
        return resumed_s + (live_s - left_s) - passed * live_between_s


def direction_random(seed: int, direction: Direction) -> random.Random:
    """The random numbers of one direction: reproducible, and independent of the other's traffic."""
    return random.Random(f"{seed}/{direction}")


class PacketSchedule:
    """One direction of a link that may lose packets but never reorders them.

    A packet waits behind those before it, takes size / rate on the air, may be lost there, and arrives one
    delay later. An outage loses every packet that is queued, in flight or sent while it lasts. Where a trace
    changes the rate, a packet goes out at the one that holds when its turn comes; its delay and its chance of being
    lost are those of when it was offered.
    """

    def __init__(self, conditions: NetworkConditions, direction: Direction, rng: random.Random) -> None:
        one_way = conditions.direction(direction)
        self._channel = Channel(one_way, rng)
        self._queue_s = one_way.queue_ms / 1e3
        self._queue_packets = one_way.queue_packets
        self._outages = OutageTimes.from_conditions(conditions)
        self._waiting: deque[float] = deque()
        self._free_s = 0.0
        self._last_delivery_s = 0.0
        self.max_queue_delay_s = 0.0
        """Longest time that a packet which got its turn had waited for it, s."""

    def offer(self, arrival_s: float, size_bytes: int) -> float | DropCause:
        """Send a packet at ``arrival_s``, never earlier than the one before; when it arrives, or why it does not."""
        if self._outages is not None and self._outages.silent(arrival_s):
            return DropCause.OUTAGE
        turn_s = arrival_s
        departure_s = arrival_s
        if self._channel.limited:
            turn_s = max(arrival_s, self._free_s)
            if turn_s - arrival_s > self._queue_s or self._queue_is_full(arrival_s, turn_s):
                return DropCause.QUEUE
            departure_s = turn_s + size_bytes / self._channel.bytes_per_s(turn_s)
        delivery_s = max(departure_s + self._channel.draw_delay_s(arrival_s), self._last_delivery_s)
        # Checked before the queue moves on: what an outage will lose must not delay what is sent after it.
        if self._outages is not None and self._outages.touch(arrival_s, delivery_s):
            return DropCause.OUTAGE
        self._free_s = departure_s
        if self._queue_packets and turn_s > arrival_s:
            self._waiting.append(turn_s)
        self.max_queue_delay_s = max(self.max_queue_delay_s, turn_s - arrival_s)
        if self._channel.draw_loss(arrival_s):
            return DropCause.LOSS
        self._last_delivery_s = delivery_s
        return delivery_s

    def _queue_is_full(self, arrival_s: float, turn_s: float) -> bool:
        if not self._queue_packets or turn_s <= arrival_s:
            return False
        while self._waiting and self._waiting[0] <= arrival_s:
            self._waiting.popleft()
        return len(self._waiting) >= self._queue_packets


@dataclass(frozen=True)
class Segment:
    """The fate of one segment of a TCP stream."""

    delivery_s: float
    """When it may be delivered, s. Segments of one connection still have to keep their order."""
    retransmitted: bool
    """Whether it was lost once, and came late for it."""


class StreamSchedule:
    """One direction of a link seen from above TCP: nothing is lost, what would be lost comes late.

    A lost segment comes ``retransmission_s`` later: the round trip, and a quarter more, until the sender
    notices and sends it again; where a trace then loses everything, once it does not any more. During an outage
    everything waits: the schedule runs on live time, which then stands still.
    """

    MIN_RETRANSMISSION_S = 0.01
    """No TCP repairs a loss faster than this, s, however short the link."""

    def __init__(self, conditions: NetworkConditions, direction: Direction, rng: random.Random) -> None:
        one_way = conditions.direction(direction)
        self._channel = Channel(one_way, rng)
        self._queue_s = one_way.queue_ms / 1e3
        self._queue_packets = one_way.queue_packets
        self._outages = OutageTimes.from_conditions(conditions)
        self._free_s = 0.0
        round_trip_s = (conditions.uplink.mean_delay_ms + conditions.downlink.mean_delay_ms) / 1e3
        self.retransmission_s = max(self.MIN_RETRANSMISSION_S, 1.25 * round_trip_s)
        """What a lost segment is late by, s; more while everything is lost."""
        self.max_queue_delay_s = 0.0
        """Longest time that a segment waited for its turn, s, outages not counted."""

    def offer(self, arrival_s: float, size_bytes: int) -> Segment:
        """Send a segment at ``arrival_s``, never earlier than the one before."""
        departure_s = self._after(arrival_s, 0.0)
        if self._channel.limited:
            self.max_queue_delay_s = max(self.max_queue_delay_s, self.backlog_s(arrival_s))
            turn_s = max(arrival_s, self._free_s)
            departure_s = self._after(turn_s, size_bytes / self._channel.bytes_per_s(turn_s))
            self._free_s = departure_s
        transit_s = self._channel.draw_delay_s(arrival_s)
        retransmitted = self._channel.draw_loss(arrival_s)
        if retransmitted:
            noticed_s = departure_s + self.retransmission_s
            transit_s += self._channel.passable_s(noticed_s) - departure_s
        return Segment(self._after(departure_s, transit_s), retransmitted)

    def backlog_s(self, time_s: float) -> float:
        """How long a segment sent at ``time_s`` would wait for its turn, s, outages not counted."""
        if self._outages is None:
            return max(0.0, self._free_s - time_s)
        return max(0.0, self._outages.to_live(self._free_s) - self._outages.to_live(time_s))

    def queue_s(self, time_s: float) -> float:
        """The longest backlog that the queue can hold, s."""
        if not (self._queue_packets and self._channel.limited):
            return self._queue_s
        return min(self._queue_s, self._queue_packets * SEGMENT_BYTES / self._channel.bytes_per_s(time_s))

    def _after(self, start_s: float, live_s: float) -> float:
        return start_s + live_s if self._outages is None else self._outages.after(start_s, live_s)
