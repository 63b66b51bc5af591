"""Publish, subscribe and query between the services: Zenoh, and its in-memory twin for tests and studies.

This is the only file that imports zenoh. Both transports pass the same conformance tests. Rules for users:

* callbacks run on a receiving thread: they enqueue and return, nothing else (a slow one stalls every priority);
* ``put`` never waits for the network, except on a topic that ``waits``, which wants a thread of its own;
* ``put`` and ``query`` on a closed transport are a :class:`~common.errors.TransportError`;
* a query that nobody answers returns None, at the latest after its time-out.
"""

from __future__ import annotations

import json
import re
import threading
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from common.errors import EndpointInUseError, TransportError
from common.run_settings import RunSettings, TransportSettings
from common.topics import Delivery, Lane, Topic

PayloadCallback = Callable[[bytes], None]
Answer = Callable[[bytes], bytes]

LEASE_MS = 3000
"""A connection over which nothing came for this long is closed and opened anew. Longer than a short outage: TCP's
retransmission is back .1 to .4 s after a second of silence, a new connection, whose first packet was lost, after 1.1
to 1.5 s. Who is gone is told by the status messages, not by this."""


class Publisher(Protocol):
    """Sends payloads on one topic."""

    def put(self, payload: bytes) -> None:
        """Send ``payload``."""
        ...


class Transport(Protocol):
    """One service's way to its peers."""

    bytes_sent: Counter[str]
    """Payload bytes put, by topic name."""
    bytes_received: Counter[str]
    """Payload bytes that arrived, by topic name."""

    def publisher(self, topic: Topic) -> Publisher:
        """Declare that this service publishes ``topic``."""
        ...

    def subscribe(self, topic: Topic, callback: PayloadCallback, *, any_run: bool = False) -> None:
        """Call ``callback`` with each payload on ``topic``; of every run and robot on the mesh if ``any_run``."""
        ...

    def serve(self, topic: Topic, answer: Answer) -> None:
        """Answer queries on ``topic``: ``answer`` maps the query's payload to the reply's."""
        ...

    def query(self, topic: Topic, payload: bytes = b"", timeout_s: float = 1.0) -> bytes | None:
        """Ask on ``topic``; the first reply, or None if none came in time."""
        ...

    def close(self) -> None:
        """Leave the mesh. May be called twice."""
        ...


class ZenohTransport:
    """Zenoh sessions of one service, one per lane, in an explicit mesh: no discovery, no forwarding.

    Raises:
        EndpointInUseError: a listening endpoint is taken.
        TransportError: an endpoint is malformed, or Zenoh refuses the configuration.
    """

    def __init__(self, run: RunSettings, settings: TransportSettings) -> None:
        import zenoh

        self._zenoh = zenoh
        self._run = run
        self.bytes_sent: Counter[str] = Counter()
        self.bytes_received: Counter[str] = Counter()
        self._count_lock = threading.Lock()
        self._closed = False
        self._declared: list[Any] = []
        zenoh.init_log_from_env_or("off")
        self._sessions: dict[Lane, Any] = {}
        endpoints = {
            Lane.REAL_TIME: (settings.listen_real_time, settings.connect_real_time),
            Lane.BULK: (settings.listen_bulk, settings.connect_bulk),
        }
        try:
            for lane, (listen, connect) in endpoints.items():
                self._sessions[lane] = self._open(listen, connect, settings)
        except BaseException:
            self.close()
            raise

    def publisher(self, topic: Topic) -> Publisher:
        zenoh, session = self._zenoh, self._sessions[topic.lane]
        key = topic.key(self._run.id, self._run.robot)
        if topic.delivery is Delivery.CACHED:
            # Zenoh's recovery would tell of a message before a slow link has carried it: the subscriber asks for it
            # again, gets it twice, and after a while nothing any more. Who joins again gets the newest as history.
            publisher = zenoh.ext.declare_advanced_publisher(
                session,
                key,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA_LOW,
                cache=zenoh.ext.CacheConfig(1),
                publisher_detection=True,
            )
        else:
            publisher = session.declare_publisher(
                key,
                congestion_control=zenoh.CongestionControl.BLOCK if topic.waits else zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME if topic.urgent else zenoh.Priority.DATA,
                express=topic.urgent,
            )
        self._declared.append(publisher)

        def put(payload: bytes) -> None:
            try:
                publisher.put(payload)
            except zenoh.ZError as error:
                raise TransportError(f"put on {key}: {_first_line(error)}") from error

        return _CountingPublisher(topic.name, put, self.bytes_sent, self._count_lock)

    def subscribe(self, topic: Topic, callback: PayloadCallback, *, any_run: bool = False) -> None:
        zenoh, session = self._zenoh, self._sessions[topic.lane]
        key = topic.key("*", "*") if any_run else topic.key(self._run.id, self._run.robot)

        def receive(sample: Any) -> None:
            payload = sample.payload.to_bytes()
            callback(payload)
            # Afterwards, while who was notified wakes up.
            with self._count_lock:
                self.bytes_received[topic.name] += len(payload)

        handler = zenoh.handlers.Callback(receive, indirect=False)
        if topic.delivery is Delivery.CACHED:
            subscriber = zenoh.ext.declare_advanced_subscriber(
                session,
                key,
                handler,
                history=zenoh.ext.HistoryConfig(max_samples=1, detect_late_publishers=True),
                subscriber_detection=True,
            )
        else:
            subscriber = session.declare_subscriber(key, handler)
        self._declared.append(subscriber)

    def serve(self, topic: Topic, answer: Answer) -> None:
        key = topic.key(self._run.id, self._run.robot)

        def reply(query: Any) -> None:
            with query:
                query.reply(key, answer(query.payload.to_bytes() if query.payload else b""))

        self._declared.append(self._sessions[topic.lane].declare_queryable(key, reply))

    def query(self, topic: Topic, payload: bytes = b"", timeout_s: float = 1.0) -> bytes | None:
        key = topic.key(self._run.id, self._run.robot)
        try:
            for reply in self._sessions[topic.lane].get(key, payload=payload, timeout=timeout_s):
                if reply.ok is not None:
                    received: bytes = reply.ok.payload.to_bytes()
                    return received
        except self._zenoh.ZError as error:
            raise TransportError(f"query on {key}: {_first_line(error)}") from error
        return None

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        for session in self._sessions.values():
            session.close()

    def _open(self, listen: str, connect: list[str], settings: TransportSettings) -> Any:
        config = self._zenoh.Config()
        values = {
            "mode": "peer",
            "listen/endpoints": [_checked_endpoint(listen)],
            "connect/endpoints": [_checked_endpoint(endpoint) for endpoint in connect],
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
            "connect/exit_on_failure": False,
            "connect/timeout_ms": -1,
            "listen/exit_on_failure": True,
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            # Opening would wait this long (ms) for peers to be found, though nobody looks for any.
            "scouting/delay": 0,
            # With it on, services in two network namespaces exchange data around the emulated link.
            "transport/shared_memory/enabled": settings.shared_memory,
            "transport/link/tx/lease": LEASE_MS,
            "transport/link/tx/keep_alive": 4,
            "timestamping/enabled": True,
            # How long a put of a message of several fragments may wait for room before it is dropped: 50 ms by
            # default, more than an action cycle.
            "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 2000,
        }
        if settings.socket_buffer_kib:
            values["transport/link/tcp/so_sndbuf"] = settings.socket_buffer_kib * 1024
        for key, value in values.items():
            config.insert_json5(key, json.dumps(value))
        try:
            return self._zenoh.open(config)
        except self._zenoh.ZError as error:
            if "Address already in use" in str(error):
                raise EndpointInUseError(
                    f"cannot listen on {listen}: another process listens there; stop it or choose another port"
                ) from error
            if "Cannot assign requested address" in str(error):
                raise TransportError(
                    f"cannot listen on {listen}: expected an address of this computer; see `ip address`"
                ) from error
            raise TransportError(f"cannot open a Zenoh session on {listen}: {_first_line(error)}") from error


class _CountingPublisher:
    def __init__(self, name: str, put: Callable[[bytes], None], counter: Counter[str], lock: threading.Lock) -> None:
        self._name, self._put, self._counter, self._lock = name, put, counter, lock

    def put(self, payload: bytes) -> None:
        self._put(payload)
        with self._lock:
            self._counter[self._name] += len(payload)


@dataclass(frozen=True, eq=False)
class Subscription:
    """Who listens on the in-memory twin, to what."""

    transport: InMemoryTransport
    pattern: re.Pattern[str]
    """Of the key."""
    receive: PayloadCallback


class InMemoryNetwork:
    """The twin's mesh: delivers at once, on the sender's thread; ``drops`` decides what is lost on the way."""

    def __init__(self, drops: Callable[[Topic, bytes], bool] | None = None) -> None:
        self.drops = drops or (lambda topic, payload: False)
        self.lock = threading.RLock()
        self.subscriptions: dict[str, list[Subscription]] = defaultdict(list)
        """By topic name."""
        self.cache: dict[str, tuple[object, bytes]] = {}
        self.answers: dict[str, tuple[object, Answer]] = {}

    def transport(self, run: RunSettings) -> InMemoryTransport:
        """Join the mesh."""
        return InMemoryTransport(self, run)

    def deliver(
        self, topic: Topic, payload: bytes, sender: InMemoryTransport, subscriptions: list[Subscription]
    ) -> None:
        """Hand a message to those who listened when it was published."""
        for subscription in subscriptions:
            subscription.receive(payload)

    def ask(self, topic: Topic, payload: bytes, answer: Answer, timeout_s: float) -> bytes | None:
        """Carry a question to ``answer`` and its answer back, or None if that takes longer than ``timeout_s``."""
        return answer(payload)


class InMemoryTransport:
    """One service's session on an :class:`InMemoryNetwork`."""

    def __init__(self, network: InMemoryNetwork, run: RunSettings) -> None:
        self._network = network
        self._run = run
        self._closed = False
        self._lock = threading.Lock()
        self.bytes_sent: Counter[str] = Counter()
        self.bytes_received: Counter[str] = Counter()

    def publisher(self, topic: Topic) -> Publisher:
        key = topic.key(self._run.id, self._run.robot)

        def put(payload: bytes) -> None:
            if self._closed:
                raise TransportError(f"put on {key}: the session is closed")
            with self._network.lock:
                if topic.delivery is Delivery.CACHED:
                    self._network.cache[key] = (self, payload)
                listening = [s for s in self._network.subscriptions[topic.name] if s.pattern.fullmatch(key)]
            if not self._network.drops(topic, payload):
                self._network.deliver(topic, payload, self, listening)

        return _CountingPublisher(topic.name, put, self.bytes_sent, self._lock)

    def subscribe(self, topic: Topic, callback: PayloadCallback, *, any_run: bool = False) -> None:
        key = topic.key(self._run.id, self._run.robot)
        pattern = re.compile(topic.key("[^/]+", "[^/]+") if any_run else re.escape(key))

        def receive(payload: bytes) -> None:
            with self._lock:
                self.bytes_received[topic.name] += len(payload)
            callback(payload)

        with self._network.lock:
            self._network.subscriptions[topic.name].append(Subscription(self, pattern, receive))
            cached = self._network.cache.get(key) if topic.delivery is Delivery.CACHED else None
        if cached is not None:
            receive(cached[1])

    def serve(self, topic: Topic, answer: Answer) -> None:
        with self._network.lock:
            self._network.answers[topic.key(self._run.id, self._run.robot)] = (self, answer)

    def query(self, topic: Topic, payload: bytes = b"", timeout_s: float = 1.0) -> bytes | None:
        key = topic.key(self._run.id, self._run.robot)
        if self._closed:
            raise TransportError(f"query on {key}: the session is closed")
        with self._network.lock:
            served = self._network.answers.get(key)
        return self._network.ask(topic, payload, served[1], timeout_s) if served else None

    def close(self) -> None:
        self._closed = True
        network = self._network
        with network.lock:
            for name, subscriptions in network.subscriptions.items():
                network.subscriptions[name] = [item for item in subscriptions if item.transport is not self]
            network.answers = {key: item for key, item in network.answers.items() if item[0] is not self}
            network.cache = {key: item for key, item in network.cache.items() if item[0] is not self}


def _checked_endpoint(endpoint: str) -> str:
    parts = re.fullmatch(r"tcp/(?:\[[0-9a-fA-F:]+\]|[^\s:/]+):(\d{1,5})", endpoint, re.ASCII)
    if not parts or not 1 <= int(parts[1]) <= 65535:
        raise TransportError(f"endpoint {endpoint!r}: expected tcp/ADDRESS:PORT, for example tcp/127.0.0.1:7450")
    return endpoint


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
