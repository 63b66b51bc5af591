"""What every service has around its own loop: identity, peers, heartbeat, record, a clean end."""

from __future__ import annotations

import contextlib
import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common import topics
from common.clock import Clock, SystemClock
from common.clock_exchange import UNKNOWN, OffsetTracker, serve_clock
from common.codec import decode, encode
from common.errors import MessageError, ServiceError
from common.inbox import Inbox, Refusals
from common.messages import Command, CommandReply, Finished, Status, TaskSpec
from common.record import RunRecord
from common.run_settings import RunSettings
from common.transport import Transport

logger = logging.getLogger(__name__)

HEARTBEAT_S = 0.2
"""Period of the status message."""
RECORD_S = 1.0
"""Period of the part and the metrics."""
GONE_AFTER_S = 1.5
"""A peer whose last status is older than this counts as gone."""
OUTAGE_S = 5.0
"""At the end of a run, a peer that has been silent for less than this is waited for."""
DRAIN_TIMEOUT_S = 30.0
"""Longest time a service waits at the end for messages that are still on their way."""
CLOSE_TIMEOUT_S = 1.0
"""Longest time that leaving the mesh may take."""
STOP_TIMEOUT_S = 2.0
"""The same when it was asked to stop (Ctrl-C)."""


@dataclass
class Peer:
    """The last that was heard of another service."""

    status: Status
    at_ns: int


class Service:
    """One running service: identity, transport, peers, record. The loop is the service's own class."""

    def __init__(
        self,
        name: str,
        run: RunSettings,
        transport: Transport,
        clock: Clock | None = None,
        incarnation: int | None = None,
    ) -> None:
        self.name = name
        self.run = run
        self.transport = transport
        self.clock = clock or SystemClock()
        self.incarnation = time.time_ns() if incarnation is None else incarnation
        """Start of this process, nanoseconds since 1970, unless given: larger is newer."""
        self.started_ns = self.clock.now_ns()
        self.refusals = Refusals()
        self.record = RunRecord(Path(run.directory), name, self.incarnation)
        self.stopping = threading.Event()
        """Set by a signal, a ``stop`` command, or a newer incarnation of this service."""
        self.failure: str | None = None
        """Why the service has to end with exit code 1."""
        self.note: str | None = None
        """What people should know of this service's end that is no failure."""
        self.on_stop: Callable[[], None] = lambda: None
        """Called, by any thread, once the service is asked to stop; it must not wait."""
        self.wake = self.clock.condition()
        """Notified when a message has arrived or the service is asked to stop."""
        self.state = "starting"
        self.counters: Callable[[], dict[str, float]] = dict
        """The service's counts and gauges: sent with the heartbeat, recorded as metrics."""
        self.wall_s: Callable[[], float] = lambda: (self.clock.now_ns() - self.started_ns) / 1e9
        """Seconds since the service started, for the record."""
        self.details: Callable[[], dict[str, Any]] = dict
        """What else belongs into the service's part of the record."""
        self.closing = contextlib.ExitStack()
        """What is released once the last part has been written."""
        self._peers: dict[str, Peer] = {}
        self._foreign: set[str] = set()
        self._finished: Finished | None = None
        self._offset: OffsetTracker | None = None
        if name == topics.ROBOT_BRIDGE:
            serve_clock(transport, self.clock, self.incarnation)
        else:
            self._offset = OffsetTracker(name, transport, self.clock, self.refusals)
        self._heart_wake = self.clock.condition()
        self._heart = self.clock.thread(self._beat, f"{name} heartbeat")
        self._heart_stop = False
        self._status_publisher = transport.publisher(topics.STATUS)
        self._status_inbox = Inbox(
            transport,
            topics.STATUS,
            Status,
            self._heart_wake,
            self.clock,
            self.refusals,
            capacity=64,
            any_run=True,
        )
        self._finished_inbox = (
            None
            if name == topics.ROBOT_BRIDGE
            else Inbox(transport, topics.FINISHED, Finished, self._heart_wake, self.clock, self.refusals)
        )

    def start(self) -> None:
        """Begin the heartbeat and the record."""
        self.record.start()
        self._heart.start()
        if self._offset:
            self._offset.start()

    def stop(self, reason: str) -> None:
        """Ask the service's loop to end."""
        if not self.stopping.is_set():
            logger.info("stopping: %s", reason)
            self.stopping.set()
            try:
                self.on_stop()
            except Exception:  # A task's own: the service has to stop all the same.
                logger.exception("asked to stop")
        with self.wake:
            self.wake.notify_all()

    def pause(self, seconds: float) -> None:
        """Do nothing for a while, or until a message comes or the service is asked to stop."""
        with self.wake:
            if not self.stopping.is_set():
                self.clock.wait(self.wake, seconds)

    def close(self) -> None:
        """Say goodbye, write the last part, leave the mesh."""
        self.state = "stopped"
        if self._offset:
            self._offset.stop()
        with self._heart_wake:
            self._heart_stop = True
            self._heart_wake.notify()
        if self._heart.is_alive():
            self._heart.join()
        self._send_status()
        self.close_record()
        # Zenoh tries for long to say goodbye over a dead link; nobody is there who could hear it.
        closing = threading.Thread(target=self.transport.close, name="close", daemon=True)
        closing.start()
        closing.join(CLOSE_TIMEOUT_S)

    def close_record(self) -> None:
        """Write the last part; then release what was kept up to it."""
        self.write_record()
        self.record.close()
        if not self.record.dropped:
            self.closing.close()

    @property
    def finished(self) -> Finished | None:
        """The bridge's word that the run is over, once it has come."""
        return self._finished

    @property
    def ends_early(self) -> bool:
        """True if this service, or the run, was asked to end: whoever asked is waiting."""
        return self.stopping.is_set() or (self.finished is not None and self.finished.reason != "steps")

    def peer_age_s(self, service: str) -> float:
        """Seconds since the last status of ``service``; infinite before the first and after its goodbye."""
        peer = self._peers.get(service)
        if peer is None or peer.status.state == "stopped":
            return float("inf")
        return (self.clock.now_ns() - peer.at_ns) / 1e9

    def peer_state(self, service: str, gone_after_s: float = GONE_AFTER_S) -> str:
        """State of ``service``; ``gone`` if nothing was heard of it for a while."""
        return self._peers[service].status.state if self.peer_age_s(service) < gone_after_s else "gone"

    def peer_counter(self, service: str, name: str) -> float:
        """A count that ``service`` last reported; 0 before it did."""
        peer = self._peers.get(service)
        return peer.status.counters.get(name, 0.0) if peer else 0.0

    def bridge_offset(self, now_ns: int) -> tuple[int, int]:
        """Bridge's clock minus this service's at ``now_ns`` and the largest error of that, ns; (0, -1) if unknown."""
        return self._offset.at(now_ns) if self._offset else UNKNOWN

    def query_spec(self) -> TaskSpec | None:
        """Ask the bridge what the task looks like until it answers; None if stopped, or the run is over, first."""
        warned_ns = self.clock.now_ns()
        while not self.stopping.is_set():
            if self._finished is not None:
                logger.info("the run finished before this service had begun")
                return None
            asked_ns = self.clock.now_ns()
            payload = self.transport.query(topics.SPEC)
            if payload is not None:
                try:
                    return decode(payload, TaskSpec)
                except MessageError as error:
                    raise ServiceError(f"the bridge's task specification cannot be used: {error}") from error
            if self.clock.now_ns() - warned_ns > 10e9:
                warned_ns = self.clock.now_ns()
                logger.warning("no robot_bridge has answered yet; is it running, and do the endpoints match?")
            # Nobody there answers at once: ask again in a moment.
            self.pause(max(0.0, 0.1 - (self.clock.now_ns() - asked_ns) / 1e9))
        return None

    def serve_commands(self, handlers: dict[str, Callable[[], str]]) -> None:
        """Answer ``command/<service>`` queries; ``stop`` is known to every service."""

        def stop() -> str:
            self.stop("stop command")
            return "stopping"

        known = {"stop": stop, **handlers}

        def answer(payload: bytes) -> bytes:
            try:
                command = decode(payload, Command)
            except MessageError as error:
                return encode(CommandReply(False, str(error)))
            if command.name not in known:
                return encode(CommandReply(False, f"expected one of {sorted(known)}, got {command.name!r}"))
            return encode(CommandReply(True, known[command.name]()))

        self.transport.serve(topics.command_topic(self.name), answer)

    def drain(self, is_drained: Callable[[], bool], work: Callable[[], None]) -> bool:
        """End of the run: ``work`` until nothing is on its way here, then until no peer needs this service.

        Returns False if the time was up first.
        """
        self.state = "draining"
        begun_ns = self.clock.now_ns()
        while True:
            limit_s = STOP_TIMEOUT_S if self.ends_early else DRAIN_TIMEOUT_S
            if (self.clock.now_ns() - begun_ns) / 1e9 > limit_s:
                logger.warning("not drained after %.0f s; peers: %s", limit_s, self._peer_states())
                return False
            work()
            if is_drained():
                self.state = "drained"
                # One that is only starting has nothing yet that could be lost.
                if all(state in ("starting", "drained", "gone") for state in self._peer_states().values()):
                    return True
            with self.wake:
                self.clock.wait(self.wake, 0.02)

    def _peer_states(self) -> dict[str, str]:
        # The network may be silent just now: whoever waits there may still need what this service has.
        patience_s = GONE_AFTER_S if self.ends_early else OUTAGE_S
        return {name: self.peer_state(name, patience_s) for name in topics.SERVICES if name != self.name}

    def _beat(self) -> None:
        next_status_ns = next_record_ns = 0
        while True:
            with self._heart_wake:
                if self._heart_stop:
                    return
                if not self._status_inbox:
                    self.clock.wait(self._heart_wake, HEARTBEAT_S / 2)
            self._take_messages()
            now_ns = self.clock.now_ns()
            if now_ns >= next_status_ns:
                next_status_ns = now_ns + round(HEARTBEAT_S * 1e9)
                self._send_status()
            if now_ns >= next_record_ns:
                next_record_ns = now_ns + round(RECORD_S * 1e9)
                self.write_record()

    def _take_messages(self) -> None:
        for status, at_ns in self._status_inbox.take():
            self._hear(status, at_ns)
        if self._finished_inbox and (finished := self._finished_inbox.take_newest()):
            bridge = self._peers.get(topics.ROBOT_BRIDGE)
            # Of the bridge that is running, and no other's: it is sent again until all have heard it.
            if bridge is not None and bridge.status.incarnation == finished.message.incarnation:
                self._finished = finished.message
                with self.wake:
                    self.wake.notify_all()

    def _hear(self, status: Status, at_ns: int) -> None:
        if status.run != self.run.id:
            if status.run not in self._foreign:
                self._foreign.add(status.run)
                logger.error(
                    "%s on this mesh belongs to run %r, expected %r: check [run] id and the endpoints",
                    status.service,
                    status.run,
                    self.run.id,
                )
            return
        if status.robot != self.run.robot:
            return
        # Two of a kind need not be connected to each other: the others tell.
        newest = status.peers.get(self.name, 0)
        if status.service == self.name and status.state != "stopped":
            newest = max(newest, status.incarnation)
        if newest > self.incarnation and self.failure is None:
            self.failure = f"a newer {self.name} has joined this run; two cannot serve one robot"
            self.stop(self.failure)
        if status.service == self.name:
            return
        known = self._peers.get(status.service)
        if known and status.incarnation < known.status.incarnation:
            return
        if known is None or known.status.incarnation != status.incarnation:
            logger.info("%s has joined", status.service)
        self._peers[status.service] = Peer(status, at_ns)

    def _send_status(self) -> None:
        # A loss that is no number any more must not make the whole service look gone.
        counters = {name: float(value) for name, value in self.counters().items() if math.isfinite(value)}
        peers = {name: peer.status.incarnation for name, peer in list(self._peers.items())}
        status = Status(self.name, self.run.id, self.run.robot, self.incarnation, self.state, counters, peers)
        self._status_publisher.put(encode(status))

    def write_record(self) -> None:
        """Record counts and details as they are now; done once a second without being asked."""
        counters = self.counters()
        wall_s = self.wall_s()
        self.record.part(
            {
                "state": self.state,
                "failure": self.failure,
                **({"note": self.note} if self.note else {}),
                "run": self.run.id,
                "wall_s": round(wall_s, 3),
                "counters": counters,
                "bytes_sent": dict(self.transport.bytes_sent),
                "bytes_received": dict(self.transport.bytes_received),
                "refused_messages": dict(self.refusals.counts),
                "record_entries_dropped": self.record.dropped,
                **({"clock": self._offset.details()} if self._offset else {}),
                **self.details(),
            }
        )
        step = int(counters.get("steps", counters.get("updates", counters.get("rows", 0))))
        self.record.metrics(step, wall_s, counters)
