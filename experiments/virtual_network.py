"""The network of a run in virtual time: what crosses the link between the hosts takes as long as it would there.

Services on one host hear each other after the time that a message takes between two processes. Services on two hosts
are connected as in a real run, by one TCP connection per pair of services and lane; the connections share the link,
one :class:`~deploy.network.PacketSchedule` per direction, with its delay, jitter, loss, rate, queue and outages.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from common.run_settings import RunSettings
from common.topics import Lane, Topic
from common.transport import InMemoryNetwork, InMemoryTransport, Subscription
from deploy.network import (
    DIRECTIONS,
    Direction,
    DropCause,
    Host,
    NetworkConditions,
    NetworkPart,
    OutageTimes,
    PacketSchedule,
    direction_random,
)
from deploy.network.conditions import direction_from
from deploy.network.link_process import trace_over
from deploy.network.part import DeviceBytes, DirectionCounts, outages_so_far
from experiments.simulation import SimulatedClock
from experiments.virtual_tcp import TcpStream

BACKEND = "virtual"
"""Name of this kind of link in a run's record."""
MESSAGE_OVERHEAD_BYTES = 40
"""Zenoh's framing and key of a message."""
LIMITED_BUFFER_BYTES = 320 * 1024
"""What a connection over a link of limited rate holds before it takes no more: the kernel doubles a send buffer of 128
KiB, and Zenoh holds a batch of 64 KiB."""
BUFFER_BYTES = 4 * 1024 * 1024
"""The same where nothing limits the send buffer."""


class VirtualLink:
    """The link between the two hosts, shared by all connections."""

    def __init__(self, clock: SimulatedClock, conditions: NetworkConditions, seed: int) -> None:
        self._clock, self._conditions = clock, conditions
        self._start_ns = clock.now_ns()
        limited = any(conditions.direction(name).bytes_per_s for name in DIRECTIONS)
        self.buffer_bytes = LIMITED_BUFFER_BYTES if limited else BUFFER_BYTES
        """What the sender's end of a connection can hold."""
        self.directions: dict[Direction, VirtualDirection] = {
            name: VirtualDirection(clock, PacketSchedule(conditions, name, direction_random(seed, name)))
            for name in DIRECTIONS
        }

    def stream(self, sender: Host) -> TcpStream:
        """One direction of a new connection."""
        there = self.directions[direction_from(sender)]
        back = self.directions[direction_from("remote" if sender == "local" else "local")]
        return TcpStream(self._clock, there, back)

    def over(self) -> str | None:
        """Why the link is over: a trace that stops. None if it is not."""
        return trace_over(self._conditions, self._clock.now_ns() - self._start_ns)

    def part(self) -> NetworkPart:
        """The link's part of the record."""
        now_ns = self._clock.now_ns()
        uplink, downlink = (self.directions[name].counts for name in DIRECTIONS)
        return NetworkPart(
            kind=BACKEND,
            start_monotonic_ns=self._start_ns,
            written_monotonic_ns=now_ns,
            directions={name: direction.counts for name, direction in self.directions.items()},
            outages=outages_so_far(OutageTimes.from_conditions(self._conditions), self._start_ns, now_ns),
            kernel={
                "local": DeviceBytes(uplink.bytes_in, downlink.bytes_delivered),
                "remote": DeviceBytes(downlink.bytes_in, uplink.bytes_delivered),
            },
        )


class VirtualDirection:
    """One direction of the link, and what has happened to its packets."""

    def __init__(self, clock: SimulatedClock, schedule: PacketSchedule) -> None:
        self._clock, self._schedule = clock, schedule
        self._start_ns = clock.now_ns()
        self.counts = DirectionCounts()

    def send(self, size_bytes: int) -> int | DropCause:
        """See :class:`experiments.virtual_tcp.PacketPath`."""
        now_s = (self._clock.now_ns() - self._start_ns) / 1e9
        fate = self._schedule.offer(now_s, size_bytes)
        counts = self.counts
        counts.packets_in += 1
        counts.bytes_in += size_bytes
        if isinstance(fate, DropCause):
            counts.dropped[fate.value] += 1
            return fate
        counts.max_queue_delay_ms = self._schedule.max_queue_delay_s * 1e3
        # What is on its way at the end of a simulation counts as delivered.
        counts.packets_delivered += 1
        counts.bytes_delivered += size_bytes
        return max(0, round((fate - now_s) * 1e9))


class VirtualNetwork(InMemoryNetwork):
    """Carries messages between services that are placed on hosts."""

    def __init__(
        self,
        clock: SimulatedClock,
        host: Mapping[str, Host],
        link: VirtualLink | None,
        message_s: float,
        crossing_s: float = 0.0,
    ) -> None:
        """Args:
        clock: of the simulation.
        host: service -> where it runs.
        link: between the hosts; None if all services are on one.
        message_s: from a service to another through both their processes, besides the link, seconds.
        crossing_s: what a message from host to host takes longer, besides the link's conditions, seconds.
        """
        super().__init__()
        self._clock, self._host, self._link = clock, host, link
        self._message_ns = round(message_s * 1e9)
        self._crossing_ns = round((message_s + crossing_s) * 1e9)
        self._services: dict[InMemoryTransport, str] = {}
        self._streams: dict[tuple[str, str, Lane], TcpStream] = {}
        self._room = clock.condition()
        self.dropped: Counter[str] = Counter()
        """Messages that found a connection's buffers full, by topic name."""

    def transport_of(self, service: str, run: RunSettings) -> InMemoryTransport:
        """Join the mesh as ``service``."""
        transport = self.transport(run)
        self._services[transport] = service
        return transport

    def deliver(
        self, topic: Topic, payload: bytes, sender: InMemoryTransport, subscriptions: list[Subscription]
    ) -> None:
        """See :class:`InMemoryNetwork`."""
        source = self._services[sender]
        for subscription in subscriptions:
            sink = self._services[subscription.transport]
            if self._host[source] != self._host[sink]:
                self._cross(topic, payload, source, sink, subscription)
            elif topic.urgent:
                self._clock.call_later(self._message_ns, lambda s=subscription: s.receive(payload))  # type: ignore[misc]
            else:  # Nobody waits for it as closely: no need to take the time.
                subscription.receive(payload)

    def _cross(self, topic: Topic, payload: bytes, source: str, sink: str, subscription: Subscription) -> None:
        stream = self._stream(source, sink, topic.lane)
        size_bytes = len(payload) + MESSAGE_OVERHEAD_BYTES
        buffer_bytes = self._link.buffer_bytes
        if not topic.waits and stream.backlog_bytes + size_bytes > buffer_bytes:
            self.dropped[topic.name] += 1
            return
        stream.write(
            size_bytes, lambda: self._clock.call_later(self._crossing_ns, lambda: subscription.receive(payload))
        )
        while topic.waits and stream.backlog_bytes > buffer_bytes:
            with self._room:
                self._clock.wait(self._room)

    def _stream(self, source: str, sink: str, lane: Lane) -> TcpStream:
        key = source, sink, lane
        if key not in self._streams:
            assert self._link is not None, "services on two hosts, and no link between them"
            stream = self._streams[key] = self._link.stream(self._host[source])
            stream.on_room = self._room.notify_all
        return self._streams[key]
