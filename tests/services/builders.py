"""A service without its process: a clock that tests move, peers that tests choose, a record in memory."""

from __future__ import annotations

import heapq
import itertools
import threading
from collections import defaultdict

from common import topics
from common.clock import FakeClock
from common.codec import decode, encode
from common.messages import Command, CommandReply
from common.run_settings import RunSettings
from common.service import Service
from common.transport import InMemoryNetwork
from tests.helpers import TIMEOUT_S

START_NS = 1_000_000_000
"""What a fresh :class:`FakeClock` shows."""


class EventClock(FakeClock):
    """A fake clock: while someone waits, time moves on, and what was planned for that time happens."""

    def __init__(self) -> None:
        super().__init__(START_NS)
        self._events = []
        self._order = itertools.count()
        self.oversleep_s = []
        """How much too late the next waits end that reach their deadline."""

    def at(self, seconds, event) -> None:
        """Call ``event()`` at ``seconds`` after the clock's start."""
        heapq.heappush(self._events, (START_NS + round(seconds * 1e9), next(self._order), event))

    def after(self, seconds, event) -> None:
        """Call ``event()`` after ``seconds`` from now."""
        self.at((self.now_ns() - START_NS) / 1e9 + seconds, event)

    @property
    def seconds(self) -> float:
        """Time since the clock's start."""
        return round((self.now_ns() - START_NS) / 1e9, 9)

    def wait_until(self, deadline_ns, condition) -> bool:
        if self._run_next(deadline_ns):
            return True
        self.advance_to(deadline_ns)
        if self.oversleep_s:
            self.advance(self.oversleep_s.pop(0))
        return False

    def sleep(self, seconds) -> None:
        """Let time pass, with all that happens in it."""
        deadline_ns = self.now_ns() + round(seconds * 1e9)
        while self._run_next(deadline_ns):
            pass
        self.advance_to(deadline_ns)

    def _run_next(self, deadline_ns) -> bool:
        if not self._events or self._events[0][0] > deadline_ns:
            return False
        at_ns, _, event = heapq.heappop(self._events)
        self.advance_to(at_ns)
        event()
        return True


class MemoryRecord:
    """Keeps what a service records."""

    def __init__(self) -> None:
        self.tables = defaultdict(list)
        self.dropped = 0

    def start(self) -> None:
        pass

    def close(self) -> None:
        pass

    def part(self, values) -> None:
        self.last_part = values

    def metrics(self, step, wall_s, values) -> None:
        pass

    def row(self, table, values) -> None:
        self.tables[table].append(dict(values))


class SoloService(Service):
    """A service whose peers are what the test says; its heartbeat does not run unless it is started."""

    def __init__(self, name, network, directory, clock=None, *, incarnation=None, seed=0, run="test") -> None:
        settings = RunSettings(id=run, directory=str(directory), seed=seed)
        super().__init__(name, settings, network.transport(settings), clock)
        self.record = MemoryRecord()
        self.peers = {}
        """Service -> state; who is not in it is gone."""
        self.ages_s = {}
        """Service -> seconds since its last status; 0 if not given."""
        self.reported = {}
        """(service, counter) -> value of its last status."""
        self.finished_message = None
        if incarnation is not None:
            self.incarnation = incarnation

    def pause(self, seconds) -> None:
        if not isinstance(self.clock, EventClock):
            super().pause(seconds)
        elif not self.stopping.is_set():
            self.clock.sleep(seconds)

    @property
    def finished(self):
        return self.finished_message

    def peer_age_s(self, service) -> float:
        return self.ages_s.get(service, 0.0) if service in self.peers else float("inf")

    def peer_state(self, service, gone_after_s=0.0) -> str:
        return self.peers.get(service, "gone")

    def peer_counter(self, service, name) -> float:
        return self.reported.get((service, name), 0.0)


class Messages:
    """All messages of a topic, decoded, in the order in which they were sent."""

    def __init__(self, transport, topic) -> None:
        self._changed = threading.Condition()
        self._message, self._items = topic.message, []
        transport.subscribe(topic, self._receive)

    def __len__(self) -> int:
        return len(self._items)

    def __getitem__(self, at):
        return self._items[at]

    def wait_for(self, count) -> list:
        """Return the messages once there are at least ``count``."""
        with self._changed:
            assert self._changed.wait_for(lambda: len(self._items) >= count, TIMEOUT_S), (
                f"expected {count} {self._message.__name__}, got {len(self._items)}"
            )
            return list(self._items)

    def _receive(self, payload) -> None:
        with self._changed:
            self._items.append(decode(payload, self._message))
            self._changed.notify_all()


class Peer:
    """Whoever is on the other side: publishes and collects."""

    def __init__(self, network: InMemoryNetwork, run="test") -> None:
        self.transport = network.transport(RunSettings(id=run, directory="unused"))
        self._publishers = {}

    def send(self, topic, message) -> None:
        """Publish a message."""
        self.send_bytes(topic, encode(message))

    def send_bytes(self, topic, payload) -> None:
        """Publish any payload."""
        if topic not in self._publishers:
            self._publishers[topic] = self.transport.publisher(topic)
        self._publishers[topic].put(payload)

    def messages(self, topic) -> Messages:
        """Collect a topic's messages from now on."""
        return Messages(self.transport, topic)

    def command(self, service, name) -> CommandReply:
        """Command a service."""
        reply = self.transport.query(topics.command_topic(service), encode(Command(name)))
        assert reply is not None
        return decode(reply, CommandReply)
