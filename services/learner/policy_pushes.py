"""Policies on their way to the actor: always the newest one, in a configured share of what the network gives them.

What a ``put`` returns says little: the end of the policy is still in Zenoh's queue and the system's buffers, hundreds
of kilobytes of it. So the actor acknowledges each policy when it has arrived, and the time from the put to the
acknowledgement is what the network took for the policy's bytes::

    put ── T on its way ──▶ acknowledged ── T / share - T of silence for the others ──▶ put of what is newest then
"""

from __future__ import annotations

from common import topics
from common.errors import TransportError
from common.inbox import Inbox
from common.messages import PolicyAcknowledgement
from common.service import Service

ACKNOWLEDGED_WITHIN_S = 10.0
"""An acknowledgement that has not come this long after its put is not waited for: it was lost, or is never sent."""
_LOOK_S = 0.1
"""While an acknowledgement is waited for, it may turn out that the actor is gone."""


class PushPacing:
    """When the next policy may be sent, by how long the last one was on its way. Holds no thread and no clock.

    Silence follows each push in proportion to the time that it took, so over many pushes their bytes per second are
    ``share`` times the bytes per second of a push, whatever the network's rate does meanwhile.
    """

    def __init__(self, share: float) -> None:
        self._share = share
        self._begun_ns = 0
        self.next_ns = 0
        """No push before this time."""
        self.bytes_per_s = 0.0
        """What the network gave to the last push that was acknowledged; 0 before the first."""

    def begin(self, now_ns: int) -> None:
        """A push begins."""
        self._begun_ns = now_ns

    def arrived(self, size: int, now_ns: int) -> None:
        """All ``size`` bytes of the push have arrived."""
        # Two readings of a clock may be equal.
        taken_ns = max(1, now_ns - self._begun_ns)
        self.bytes_per_s = size * 1e9 / taken_ns
        self.next_ns = self._begun_ns + round(taken_ns / self._share)


class PolicyPusher:
    """Publishes policies on a thread of its own: a slow link delays the next push, never an update.

    While one is on its way, or it is the others' turn, the next ones replace each other: only the newest is worth
    sending.
    """

    def __init__(self, service: Service, share: float = 1.0) -> None:
        self._service, self._clock = service, service.clock
        self._publisher = service.transport.publisher(topics.POLICY)
        self._wake = self._clock.condition()
        self._acknowledgements = Inbox(
            service.transport, topics.POLICY_ACK, PolicyAcknowledgement, self._wake, self._clock, service.refusals
        )
        self._pacing = PushPacing(share)
        self._pending: tuple[int, bytes] | None = None
        self._stopping = False
        self.pushes = 0
        self.skipped = 0
        """Policies replaced by a newer one before they were sent."""
        self._thread = self._clock.thread(self._run, "policy push")
        self._thread.start()

    @property
    def bytes_per_s(self) -> float:
        """What the network gave to the last push that was acknowledged; 0 before the first."""
        return self._pacing.bytes_per_s

    def push(self, version: int, payload: bytes) -> None:
        """Send an encoded policy as soon as the one before is gone and pushes have not had more than their share."""
        with self._wake:
            self.skipped += self._pending is not None
            self._pending = version, payload
            self._wake.notify()

    def close(self) -> None:
        """Stop; what is pending is not sent. A push that is stuck in a dead link ends with the session."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        self._thread.join(0.2)

    def _run(self) -> None:
        while (pending := self._next()) is not None:
            version, payload = pending
            self._pacing.begin(self._clock.now_ns())
            try:
                self._publisher.put(payload)
            except TransportError:
                return  # The session was closed around a push that was stuck in a dead link.
            self.pushes += 1
            self._wait_for_arrival(version, len(payload))

    def _next(self) -> tuple[int, bytes] | None:
        """Wait until a push may begin, and return what is newest then; None if there is to be none."""
        with self._wake:
            while not self._stopping:
                silence_s = (self._pacing.next_ns - self._clock.now_ns()) / 1e9
                if self._pending is not None and silence_s <= 0:
                    break
                self._clock.wait(self._wake, None if self._pending is None else silence_s)
            pending, self._pending = self._pending, None
            return None if self._stopping else pending

    def _wait_for_arrival(self, version: int, size: int) -> None:
        """Wait for the acknowledgement of a policy that has been put; not if nobody is there who would send one."""
        put_ns = self._clock.now_ns()
        with self._wake:
            while not self._stopping:
                for acknowledgement, at_ns in self._acknowledgements.take():
                    if acknowledgement.version >= version:
                        self._pacing.arrived(size, at_ns)
                        return
                waited_s = (self._clock.now_ns() - put_ns) / 1e9
                if waited_s >= ACKNOWLEDGED_WITHIN_S or self._service.peer_state(topics.ACTOR) == "gone":
                    return
                self._clock.wait(self._wake, _LOOK_S)
