"""TimeSteps become experience: in order, each once, numbered and retained, on a thread of its own."""

from __future__ import annotations

from collections import OrderedDict, deque

from common import topics
from common.codec import encode
from common.inbox import Inbox
from common.journal import JournalSender, OrderedReceiver
from common.messages import Acknowledgement, Experience, PolicyExtras, StreamHead, TimeStep
from common.service import Service
from services.actor.config import ActorSettings

ACKNOWLEDGE_S = 0.1
"""Period of the acknowledgement to the bridge."""
REMEMBERED_ANSWERS = 4096
"""Answers kept for the experience that they belong to; more than a journal's repairs need."""


class ExperienceForwarder:
    """Receives the bridge's numbered TimeSteps and sends them on to replay with the policy's extras."""

    def __init__(self, service: Service, settings: ActorSettings) -> None:
        self._service = service
        self._receiver: OrderedReceiver[TimeStep] = OrderedReceiver()
        self._sender = JournalSender(
            service.transport,
            service.incarnation,
            settings,
            topic=topics.EXPERIENCE,
            resent=topics.EXPERIENCE_RESENT,
            head=topics.EXPERIENCE_HEAD,
            acknowledgement=topics.EXPERIENCE_ACK,
            on_acknowledgement=self._note_acknowledgement,
            clock=service.clock,
        )
        self._ack_publisher = service.transport.publisher(topics.TIME_STEP_ACK)
        self._wake = service.clock.condition()
        self._heads = Inbox(
            service.transport, topics.TIME_STEP_HEAD, StreamHead, self._wake, service.clock, service.refusals
        )
        self._incoming: deque[TimeStep] = deque()
        self._answers: OrderedDict[tuple[int, int], PolicyExtras] = OrderedDict()
        self._in_hand = 0  # taken from the receiver and not yet with the sender
        self._stopping = False
        self._thread = service.clock.thread(self._run, "experience")
        self.experiences = 0
        """Experiences sent."""
        self._earns = False
        self.updates_owed = 0.0
        """Replay's unspent update budget, as of its last acknowledgement."""

    def start(self) -> None:
        """Begin to forward."""
        self._sender.start()
        self._thread.start()

    def stop(self) -> None:
        """Stop forwarding."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        self._thread.join()
        self._sender.stop()

    def add(self, time_step: TimeStep) -> None:
        """Take over a TimeStep as it came."""
        with self._wake:
            self._incoming.append(time_step)
            self._wake.notify()

    def remember_answer(self, time_step: TimeStep, extras: PolicyExtras) -> None:
        """Keep what the policy knows of its answer to ``time_step``."""
        with self._wake:
            self._answers[time_step.incarnation, time_step.seq] = extras
            if len(self._answers) > REMEMBERED_ANSWERS:
                self._answers.popitem(last=False)

    @property
    def updates_owed_at_most(self) -> float:
        """What replay owed as of its last acknowledgement, or may owe by what has been sent since."""
        with self._wake:
            sent_since = len(self._incoming) + self._in_hand + self._sender.unacknowledged
        # Before the minimum size is reached, nothing is earned by it.
        return max(self.updates_owed, sent_since if self._earns else 0)

    def is_drained(self, incarnation: int, produced: int) -> bool:
        """True if all that the bridge produced has come, gone on to replay, and been acknowledged there."""
        with self._wake:
            complete = self._receiver.has_all(incarnation, produced) and not (self._incoming or self._in_hand)
        return complete and self._sender.unacknowledged == 0

    def counters(self) -> dict[str, float]:
        """Counts for the heartbeat and the record."""
        return {
            "experiences": self.experiences,
            "resent": self._sender.resent,
            "unacknowledged": self._sender.unacknowledged,
            "given_up": self._sender.given_up,
            "lost": self._receiver.lost,
            "duplicates": self._receiver.duplicates,
            "updates_owed": self.updates_owed,
        }

    def _run(self) -> None:
        clock, next_ack_ns = self._service.clock, 0
        while True:
            with self._wake:
                if not (self._incoming or self._heads or self._stopping):
                    clock.wait(self._wake, ACKNOWLEDGE_S)
                if self._stopping:
                    return
                while self._incoming:
                    time_step = self._incoming.popleft()
                    self._receiver.accept(time_step.incarnation, time_step.seq, time_step)
                for head, _ in self._heads.take():
                    self._receiver.note_head(head)
                ready = [self._experience(time_step) for time_step in self._receiver.take_ready()]
                self._in_hand = len(ready)
                acknowledgement = self._receiver.acknowledgement()
            for experience in ready:
                self._sender.put(experience.seq, encode(experience))
            self._in_hand = 0
            if acknowledgement and clock.now_ns() >= next_ack_ns:
                next_ack_ns = clock.now_ns() + round(ACKNOWLEDGE_S * 1e9)
                self._ack_publisher.put(encode(acknowledgement))

    def _experience(self, time_step: TimeStep) -> Experience:
        # Not the answer whose action was applied, which an earlier TimeStep may have got: what is learnt from is what
        # the policy chose on an observation, with all that came of it.
        before = time_step.incarnation, time_step.seq - 1
        extras = None if time_step.is_first else self._answers.get(before)
        experience = Experience(self._service.incarnation, self.experiences, time_step, extras)
        self.experiences += 1
        return experience

    def _note_acknowledgement(self, acknowledgement: Acknowledgement) -> None:
        self.updates_owed = acknowledgement.updates_owed
        self._earns = self._earns or acknowledgement.updates_owed > 0
        # In lockstep the actor may be waiting for the budget to be spent.
        with self._service.wake:
            self._service.wake.notify_all()
