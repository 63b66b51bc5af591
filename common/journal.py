"""The numbered stream: newest first, nothing lost.

The sender publishes each message once, at once, and may lose it on the way. It retains what the receiver has not
acknowledged. The receiver takes messages as they come, hands them on in order, and tells the sender what it misses;
the sender resends that, paced, below everything else. So the newest message is never queued behind repairs, and a
short network outage costs freshness only while it lasts.

    sender                                            receiver
      put ; retain(seq, payload)  ── message ───────▶   accept
      head() every 0.2 s          ── StreamHead ────▶   note_head        what exists, what can still be resent
      acknowledge                 ◀─ Acknowledgement    acknowledgement  what is done, what is missing
      due() ; put on `resent`     ── message ───────▶   accept

:class:`~common.retained_messages.RetainedMessages` and :class:`OrderedReceiver` decide; they hold no thread and no
clock.
:class:`JournalSender` runs the sender's side on a thread of its own.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np

from common.clock import Clock, SystemClock
from common.codec import decode, encode
from common.errors import MessageError
from common.messages import Acknowledgement, StreamHead
from common.retained_messages import MAX_RANGES, RetainedMessages
from common.run_settings import JournalSettings
from common.topics import Topic
from common.transport import Transport

HEAD_PERIOD_S = 0.2
"""How often the sender tells what it holds."""

Item = TypeVar("Item")
logger = logging.getLogger(__name__)


class OrderedReceiver(Generic[Item]):
    """Takes a stream's messages as they come and hands them on in order, each once.

    A stream begins where its sender says it can still resend from. What the sender has given up is counted as lost
    and skipped. A newer incarnation of the sender ends the older one's stream.
    """

    def __init__(self) -> None:
        self.stream: int | None = None
        """Sender incarnation that is being received."""
        self._waiting: dict[int, Item] = {}
        self._ready: list[Item] = []
        self._next_seq: int | None = None
        self._end_seq = 0
        self._taken_seq = 0
        self.lost = 0
        """Messages known to have existed that will never come."""
        self.duplicates = 0
        """Messages that came more than once; the first was taken."""
        self.stale = 0
        """Messages of an incarnation that has been followed by a newer one."""

    @property
    def received_all(self) -> bool:
        """True if nothing that is known to exist is missing."""
        return self._next_seq is not None and self._next_seq >= self._end_seq

    def has_all(self, stream: int, count: int) -> bool:
        """True if ``stream`` is being received and its messages before number ``count`` have all been handed on."""
        return self.stream == stream and self._taken_seq >= count

    def accept(self, stream: int, seq: int, item: Item) -> bool:
        """Take one message; False if it was not wanted (known already, or of an old incarnation)."""
        if not self._follow(stream):
            self.stale += 1
            return False
        if seq in self._waiting or (self._next_seq is not None and seq < self._next_seq):
            self.duplicates += 1
            return False
        self._waiting[seq] = item
        self._end_seq = max(self._end_seq, seq + 1)
        if seq == 0 and self._next_seq is None:
            self._next_seq = 0
        self._advance()
        return True

    def note_head(self, head: StreamHead) -> None:
        """Learn what the sender has sent and can still resend."""
        if not self._follow(head.stream):
            return
        self._end_seq = max(self._end_seq, head.next_seq, head.oldest_seq)
        if self._next_seq is None:
            # A receiver that starts late begins where the sender still has something: what was before has been
            # acknowledged by its predecessor.
            self._next_seq = self._taken_seq = min([head.oldest_seq, *self._waiting])
        if head.oldest_seq > self._next_seq:
            self._give_up_before(head.oldest_seq)
        self._advance()

    def take_ready(self) -> list[Item]:
        """Messages that are next in order; taking them makes the next acknowledgement cover them."""
        ready, self._ready = self._ready, []
        if self._next_seq is not None:
            self._taken_seq = self._next_seq
        return ready

    def acknowledgement(self, updates_owed: float = 0.0) -> Acknowledgement | None:
        """What to tell the sender; None before anything is known of it."""
        if self.stream is None or self._next_seq is None:
            return None
        missing: list[tuple[int, int]] = []
        start = self._next_seq
        waiting = sorted(self._waiting)
        for seq in [*waiting, self._end_seq]:
            if seq > start:
                missing.append((start, seq))
            start = seq + 1
            if len(missing) == MAX_RANGES:
                break
        if waiting:
            missing.append((waiting[-1] + 1, waiting[-1] + 1))  # misses nothing, but tells what the newest is
        ranges = np.array(missing, dtype=np.int64).reshape(-1, 2)
        return Acknowledgement(self.stream, self._taken_seq, ranges, updates_owed)

    def _follow(self, stream: int) -> bool:
        """Switch to a newer stream; False for an older one."""
        if self.stream is not None and stream < self.stream:
            return False
        if self.stream != stream:
            # The old sender's memory is gone: what has not come will not come.
            self._give_up_before(self._end_seq)
            self.stream, self._next_seq, self._end_seq, self._taken_seq = stream, None, 0, 0
        return True

    def _give_up_before(self, end_seq: int) -> None:
        """Hand on what came of the messages before ``end_seq``; count the others as lost."""
        start = min(self._waiting, default=end_seq) if self._next_seq is None else self._next_seq
        arrived = sorted(seq for seq in self._waiting if seq < end_seq)
        self._ready += [self._waiting.pop(seq) for seq in arrived]
        self.lost += end_seq - start - len(arrived)
        self._next_seq = end_seq

    def _advance(self) -> None:
        while self._next_seq is not None and self._next_seq in self._waiting:
            self._ready.append(self._waiting.pop(self._next_seq))
            self._next_seq += 1


class JournalSender:
    """The sender's side of a stream: publishes, retains, and repairs on a thread of its own.

    ``put`` is called by one thread, costs one publication, and waits for nothing that is slow.
    """

    def __init__(
        self,
        transport: Transport,
        incarnation: int,
        settings: JournalSettings,
        *,
        topic: Topic,
        resent: Topic,
        head: Topic,
        acknowledgement: Topic,
        on_acknowledgement: Callable[[Acknowledgement], None] | None = None,
        clock: Clock | None = None,
    ) -> None:
        self._clock = clock or SystemClock()
        self._incarnation = incarnation
        self._retained = RetainedMessages(
            round(settings.journal_s * 1e9), settings.journal_mib << 20, one_connection=topic.lane is resent.lane
        )
        self._bytes_per_s = settings.resend_kib_per_s * 1024
        self._publisher = transport.publisher(topic)
        self._resent_publisher = transport.publisher(resent)
        self._head_publisher = transport.publisher(head)
        self._on_acknowledgement = on_acknowledgement
        self._lock = threading.Lock()
        self._wake = self._clock.condition()
        self._pace = self._clock.condition()
        self._acknowledgements: list[Acknowledgement] = []
        self._stopping = False
        self.resent = 0
        """Messages sent again."""
        self.refused = 0
        """Acknowledgements that could not be read."""
        transport.subscribe(acknowledgement, self._receive)
        self._thread = self._clock.thread(self._run, f"journal {topic.name}")

    def start(self) -> None:
        """Begin to repair."""
        self._thread.start()

    def stop(self) -> None:
        """Stop repairing; what is unacknowledged is given up."""
        self._stopping = True
        for condition in (self._wake, self._pace):
            with condition:
                condition.notify()
        if self._thread.is_alive():
            self._thread.join()

    @property
    def unacknowledged(self) -> int:
        """Messages retained."""
        return len(self._retained)

    @property
    def given_up(self) -> int:
        """Messages dropped unacknowledged."""
        return self._retained.given_up

    def put(self, seq: int, payload: bytes) -> None:
        """Publish and retain message ``seq``."""
        try:
            self._publisher.put(payload)
        finally:
            # While it is on its way: whoever waits for it need not wait for that.
            with self._lock:
                self._retained.retain(seq, payload, self._clock.now_ns())

    def republish(self, payload: bytes) -> None:
        """Publish once more what :meth:`put` has published."""
        self.resent += 1
        self._publisher.put(payload)

    def send_head(self) -> None:
        """Tell the receiver what there is."""
        with self._lock:
            head = StreamHead(self._incarnation, self._retained.oldest_seq, self._retained.next_seq)
        self._head_publisher.put(encode(head))

    def _receive(self, payload: bytes) -> None:
        try:
            acknowledgement = decode(payload, Acknowledgement)
        except MessageError as error:
            self.refused += 1
            if self.refused == 1:
                logger.warning("dropped an acknowledgement: %s", error)
            return
        with self._wake:
            self._acknowledgements.append(acknowledgement)
            self._wake.notify()

    def _run(self) -> None:
        next_head_ns = 0
        while True:
            with self._wake:
                if not self._acknowledgements and not self._stopping:
                    self._clock.wait(self._wake, HEAD_PERIOD_S)
                if self._stopping:
                    return
                acknowledgements, self._acknowledgements = self._acknowledgements, []
            if self._clock.now_ns() >= next_head_ns:
                next_head_ns = self._clock.now_ns() + round(HEAD_PERIOD_S * 1e9)
                self.send_head()
            for acknowledgement in acknowledgements:
                if acknowledgement.stream == self._incarnation:
                    self._take(acknowledgement, newest=acknowledgement is acknowledgements[-1])

    def _take(self, acknowledgement: Acknowledgement, newest: bool) -> None:
        with self._lock:
            self._retained.acknowledge(acknowledgement.next_seq, acknowledgement.missing, self._clock.now_ns())
        if self._on_acknowledgement:
            self._on_acknowledgement(acknowledgement)
        if newest:
            self._resend(acknowledgement)

    def _resend(self, acknowledgement: Acknowledgement) -> None:
        ranges = ((int(start), int(end)) for start, end in acknowledgement.missing)
        payloads = self._retained.due(ranges, self._clock.now_ns())
        while True:
            with self._lock:
                payload = next(payloads, None)
            if payload is None:
                return
            self._resent_publisher.put(payload)
            self.resent += 1
            with self._pace:
                if not self._stopping:
                    self._clock.wait(self._pace, len(payload) / self._bytes_per_s)
            # A newer acknowledgement knows better what is missing.
            if self._stopping or self._acknowledgements:
                return
