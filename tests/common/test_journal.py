"""The numbered stream: in order, each once; what is lost is known; the newest never waits for repairs."""

from __future__ import annotations

import queue
import random
import threading
from collections import defaultdict

import numpy as np
import pytest

from common import topics
from common.clock import FakeClock
from common.codec import decode, encode
from common.errors import TransportError
from common.journal import HEAD_PERIOD_S, JournalSender, OrderedReceiver
from common.messages import Acknowledgement, StreamHead
from common.retained_messages import LEAST_TIMEOUT_S, MAX_RANGES, RetainedMessages
from common.run_settings import JournalSettings
from common.transport import InMemoryNetwork
from tests.helpers import TIMEOUT_S, eventually, make_run

S = 1_000_000_000
MS = 1_000_000


# ------------------------------------------------------------------ the receiver orders


def received(*numbers, stream=1, head=None, receiver=None):
    """Return a receiver that got these messages, then perhaps a head (oldest, next)."""
    receiver = receiver or OrderedReceiver()
    for seq in numbers:
        receiver.accept(stream, seq, (stream, seq))
    if head is not None:
        receiver.note_head(StreamHead(stream, *head))
    return receiver


def taken(receiver):
    return [seq for _, seq in receiver.take_ready()]


def missing(receiver):
    """Return the gaps that the acknowledgement names."""
    return [[start, end] for start, end in receiver.acknowledgement().missing.tolist() if start < end]


def counts(receiver):
    return receiver.lost, receiver.duplicates, receiver.stale


def test_nothing_is_acknowledged_before_anything_is_known():
    assert OrderedReceiver().acknowledgement() is None
    assert received(5).acknowledgement() is None  # where the stream begins is not known yet
    assert not received(5).received_all


def test_messages_in_order_are_handed_on_at_once():
    receiver = received(0, 1, 2)
    assert taken(receiver) == [0, 1, 2]
    assert taken(receiver) == []
    assert counts(receiver) == (0, 0, 0)
    assert receiver.received_all


def test_messages_out_of_order_wait_for_what_is_before_them():
    receiver = received(0, 2, 4, 3)
    assert taken(receiver) == [0]
    received(1, receiver=receiver)
    assert taken(receiver) == [1, 2, 3, 4]


def test_a_message_is_handed_on_once_however_often_it_comes():
    receiver = received(0, 0, 2, 2, 1, 2, 0)
    assert taken(receiver) == [0, 1, 2]
    assert counts(receiver) == (0, 4, 0)


def test_accepting_tells_whether_the_message_was_wanted():
    receiver = OrderedReceiver()
    assert receiver.accept(5, 0, "a")
    assert not receiver.accept(5, 0, "again")
    assert receiver.accept(5, 2, "c")
    assert not receiver.accept(5, 2, "again")
    assert not receiver.accept(4, 1, "older incarnation")
    assert receiver.accept(5, 1, "b")
    assert receiver.take_ready() == ["a", "b", "c"]


def test_an_acknowledgement_covers_what_was_taken_not_what_only_came():
    receiver = received(0, 1, 2)
    assert receiver.acknowledgement().next_seq == 0
    receiver.take_ready()
    assert receiver.acknowledgement().next_seq == 3


def test_gaps_are_reported_as_half_open_ranges():
    receiver = received(0, 1, 4, 6, 7, 9)
    receiver.take_ready()
    acknowledgement = receiver.acknowledgement(updates_owed=2.5)
    assert acknowledgement.stream == 1
    assert acknowledgement.next_seq == 2
    assert acknowledgement.missing.tolist() == [[2, 4], [5, 6], [8, 9], [10, 10]]
    assert acknowledgement.missing.dtype == np.int64
    assert acknowledgement.updates_owed == 2.5


def test_behind_the_gaps_an_empty_range_tells_what_the_newest_is():
    receiver = received(0, 2, 3, 7)
    assert receiver.acknowledgement().missing.tolist() == [[1, 2], [4, 7], [8, 8]]
    received(1, receiver=receiver)
    assert receiver.acknowledgement().missing.tolist() == [[4, 7], [8, 8]]
    received(4, 5, 6, receiver=receiver)
    assert receiver.acknowledgement().missing.tolist() == []


def test_without_gaps_nothing_is_reported_missing():
    acknowledgement = received(0, 1, 2).acknowledgement()
    assert acknowledgement.missing.shape == (0, 2)
    assert decode(encode(acknowledgement), Acknowledgement).missing.shape == (0, 2)


def test_a_head_tells_of_messages_lost_at_the_tail():
    receiver = received(0, 1, head=(0, 5))
    assert missing(receiver) == [[2, 5]]
    assert not receiver.received_all
    received(2, 4, receiver=receiver)
    assert missing(receiver) == [[3, 4]]


def test_a_head_alone_makes_everything_missing():
    assert missing(received(head=(0, 3))) == [[0, 3]]


def test_a_head_without_news_changes_nothing():
    receiver = received(0, 1, 2, head=(0, 3))
    for head in ((0, 0), (0, 3), (2, 3), (1, 2)):
        received(receiver=receiver, head=head)
    assert receiver.received_all
    assert taken(receiver) == [0, 1, 2]
    assert counts(receiver) == (0, 0, 0)


def test_a_late_receiver_begins_where_the_sender_still_has_something():
    receiver = received(57, head=(50, 58))
    assert taken(receiver) == []
    acknowledgement = receiver.acknowledgement()
    assert (acknowledgement.next_seq, acknowledgement.missing.tolist()) == (50, [[50, 57], [58, 58]])
    received(*range(50, 57), receiver=receiver)
    assert taken(receiver) == list(range(50, 58))
    assert counts(receiver) == (0, 0, 0)  # what was before 50 had been acknowledged


def test_a_late_receiver_of_an_acknowledged_stream_waits_for_the_next_message():
    receiver = received(head=(50, 50))
    assert receiver.received_all
    assert receiver.acknowledgement().next_seq == 50
    received(50, receiver=receiver)
    assert taken(receiver) == [50]


def test_a_message_that_came_before_the_first_head_is_not_forgotten():
    receiver = received(5, 8, head=(7, 10))  # given up before the first head came: 6
    assert taken(receiver) == [5]
    assert missing(receiver) == [[7, 8], [9, 10]]
    assert counts(receiver) == (1, 0, 0)
    received(7, 9, receiver=receiver)
    assert taken(receiver) == [7, 8, 9]
    assert receiver.received_all


def test_what_the_sender_gave_up_is_lost_and_skipped():
    receiver = received(0, 1, 3, 6, head=(5, 8))  # 2 and 4 will not come; 5 and 7 may
    assert taken(receiver) == [0, 1, 3]
    assert receiver.lost == 2
    assert receiver.acknowledgement().next_seq == 5
    assert missing(receiver) == [[5, 6], [7, 8]]
    received(5, 7, receiver=receiver)
    assert taken(receiver) == [5, 6, 7]
    assert receiver.lost == 2


def test_what_was_given_up_is_counted_once():
    receiver = received(0, head=(3, 4))
    for _ in range(3):
        received(receiver=receiver, head=(3, 4))
    assert receiver.lost == 2
    received(receiver=receiver, head=(4, 4))
    assert receiver.lost == 3


def test_what_was_given_up_and_comes_after_all_is_refused():
    receiver = received(0, 3, head=(3, 4))
    assert not receiver.accept(1, 2, "late")
    assert taken(receiver) == [0, 3]
    assert counts(receiver) == (2, 1, 0)


def test_a_newer_incarnation_ends_the_older_stream_and_counts_its_gaps():
    receiver = received(0, 1, 4, head=(0, 7))  # of stream 1: 2, 3, 5, 6 are missing
    received(0, 1, stream=2, receiver=receiver)
    assert receiver.take_ready() == [(1, 0), (1, 1), (1, 4), (2, 0), (2, 1)]
    assert counts(receiver) == (4, 0, 0)
    assert receiver.acknowledgement().stream == 2
    assert receiver.acknowledgement().next_seq == 2


def test_a_newer_incarnation_is_noticed_by_its_head_too():
    receiver = received(0, 2)
    received(stream=2, head=(0, 3), receiver=receiver)
    assert receiver.lost == 1
    assert receiver.take_ready() == [(1, 0), (1, 2)]
    assert missing(receiver) == [[0, 3]]


def test_gaps_of_a_stream_whose_beginning_never_came_count_from_its_first_message():
    receiver = received(3, 5)  # no head: what was before 3 may have been acknowledged
    received(0, stream=2, receiver=receiver)
    assert receiver.take_ready() == [(1, 3), (1, 5), (2, 0)]
    assert receiver.lost == 1


def test_a_stream_that_was_only_announced_is_lost():
    receiver = received(head=(0, 3))
    received(0, stream=2, receiver=receiver)
    assert receiver.lost == 3


def test_a_complete_stream_leaves_no_loss_behind():
    receiver = received(0, 1, 2, head=(0, 3))
    received(0, stream=2, receiver=receiver)
    assert receiver.lost == 0


def test_messages_of_an_older_incarnation_are_stale():
    receiver = received(0, stream=2)
    received(1, 2, stream=1, receiver=receiver, head=(0, 9))
    assert taken(receiver) == [0]
    assert counts(receiver) == (0, 0, 2)
    assert receiver.received_all


def test_all_of_a_stream_is_there_only_once_it_has_been_taken():
    receiver = received(0, 1, 2)
    assert not receiver.has_all(1, 3)
    receiver.take_ready()
    assert receiver.has_all(1, 3)
    assert receiver.has_all(1, 0)
    assert not receiver.has_all(1, 4)
    assert not receiver.has_all(2, 0)


def test_an_acknowledgement_names_a_bounded_number_of_ranges():
    receiver = received(*range(0, 1001, 2))
    assert missing(receiver) == [[i, i + 1] for i in range(1, 2 * MAX_RANGES, 2)]


def test_a_number_far_ahead_costs_no_more_than_any_other():
    """A damaged or hostile number must not keep the service busy."""
    receiver = received(0, 2**62, head=(0, 2**62))
    receiver.take_ready()
    assert missing(receiver) == [[1, 2**62]]
    received(receiver=receiver, head=(2**62, 2**62))
    assert receiver.lost == 2**62 - 1
    assert taken(receiver) == [2**62]
    received(0, stream=2, receiver=receiver)
    assert receiver.lost == 2**62 - 1


def test_a_head_that_contradicts_itself_never_lowers_the_losses():
    receiver = received(0, head=(9, 3))
    assert receiver.lost == 8
    received(0, stream=2, receiver=receiver)
    assert receiver.lost == 8


# ------------------------------------------------------------------ both, at random


class LossyWay:
    """Carries messages from one side to the other: loses, doubles and reorders them."""

    def __init__(self, rng, loss):
        self._rng, self._loss, self._on_the_way = rng, loss, []

    def put(self, message):
        for _ in range(self._rng.choice([1, 1, 1, 2])):
            if self._rng.random() >= self._loss:
                self._on_the_way.append(message)

    def take(self):
        """Return some of what is on its way, in any order."""
        self._rng.shuffle(self._on_the_way)
        count = self._rng.randint(0, len(self._on_the_way))
        arrived, self._on_the_way = self._on_the_way[:count], self._on_the_way[count:]
        return arrived


@pytest.mark.parametrize("max_bytes", [10**9, 40], ids=["room for all", "room for ten"])
@pytest.mark.parametrize("seed", range(60))
def test_every_message_is_handed_on_in_order_or_counted_as_lost(seed, max_bytes):
    rng = random.Random(seed)
    loss = rng.choice([0.0, 0.1, 0.4, 0.8])
    sender, receiver = RetainedMessages(10**18, max_bytes, one_connection=True), OrderedReceiver()
    data, heads, acknowledgements = (LossyWay(rng, loss) for _ in range(3))
    receiver.note_head(StreamHead(1, 0, 0))
    handed_on, now_ns = [], 0

    def receive(messages):
        for seq in messages:
            receiver.accept(1, seq, seq)
        handed_on.extend(receiver.take_ready())

    for _ in range(300):
        now_ns += 100 * MS
        for _ in range(rng.randint(0, 3)):
            seq = sender.next_seq
            sender.retain(seq, seq.to_bytes(4, "big"), now_ns)
            data.put(seq)
        heads.put(StreamHead(1, sender.oldest_seq, sender.next_seq))
        receive(data.take())
        for head in heads.take():
            receiver.note_head(head)
        acknowledgements.put(receiver.acknowledgement())
        for acknowledgement in acknowledgements.take():
            sender.acknowledge(acknowledgement.next_seq, acknowledgement.missing, now_ns)
            for payload in sender.due(iter(acknowledgement.missing.tolist()), now_ns):
                data.put(int.from_bytes(payload, "big"))
    for _ in range(300):  # the end: nothing is lost on the way any more, and every time-out passes
        now_ns += 1000 * S
        receiver.note_head(StreamHead(1, sender.oldest_seq, sender.next_seq))
        acknowledgement = receiver.acknowledgement()
        sender.acknowledge(acknowledgement.next_seq, acknowledgement.missing, now_ns)
        receive(int.from_bytes(p, "big") for p in sender.due(iter(acknowledgement.missing.tolist()), now_ns))
    last = receiver.acknowledgement()
    sender.acknowledge(last.next_seq, last.missing, now_ns)

    assert handed_on == sorted(set(handed_on))
    assert len(handed_on) + receiver.lost == sender.next_seq
    assert receiver.lost <= sender.given_up
    assert receiver.received_all
    assert len(sender) == 0
    if max_bytes == 10**9:
        assert handed_on == list(range(sender.next_seq))


# ------------------------------------------------------------------ the sender's thread


class ReceivingSide:
    """The other end of a stream of Experience, whose payloads here are just their numbers."""

    def __init__(self, network, drops=None):
        self._transport = network.transport(make_run())
        self._arrived = queue.SimpleQueue()
        self._receiver = OrderedReceiver()
        self._ack_publisher = self._transport.publisher(topics.EXPERIENCE_ACK)
        self.handed_on = []
        for topic in (topics.EXPERIENCE, topics.EXPERIENCE_RESENT, topics.EXPERIENCE_HEAD):
            self._transport.subscribe(topic, lambda payload, topic=topic: self._arrived.put((topic, payload)))

    def receive(self):
        """Take what has come; return the receiver."""
        while not self._arrived.empty():
            topic, payload = self._arrived.get()
            if topic is topics.EXPERIENCE_HEAD:
                self._receiver.note_head(decode(payload, StreamHead))
            else:
                stream, seq = (int(text) for text in payload.split(b":"))
                self._receiver.accept(stream, seq, (stream, seq))
        self.handed_on += self._receiver.take_ready()
        return self._receiver

    def acknowledge(self):
        """Tell the sender what has come."""
        if acknowledgement := self.receive().acknowledgement():
            self.send(encode(acknowledgement))

    def send(self, payload):
        self._ack_publisher.put(payload)


def make_sender(network, clock, incarnation=1, on_acknowledgement=None, **settings):
    return JournalSender(
        network.transport(make_run()),
        incarnation,
        JournalSettings(**{"resend_kib_per_s": 1e9, **settings}),
        topic=topics.EXPERIENCE,
        resent=topics.EXPERIENCE_RESENT,
        head=topics.EXPERIENCE_HEAD,
        acknowledgement=topics.EXPERIENCE_ACK,
        on_acknowledgement=on_acknowledgement,
        clock=clock,
    )


def put(sender, count, incarnation=1, start=0):
    for seq in range(start, start + count):
        sender.put(seq, b"%d:%d" % (incarnation, seq))


def repair(sender, other, clock):
    """Let time pass and acknowledgements flow until the sender holds nothing any more."""

    def done():
        clock.advance(LEAST_TIMEOUT_S)
        sender.send_head()
        other.acknowledge()
        return sender.unacknowledged == 0

    eventually(done, "the end of the repairs")


def drop_at_random(seed, rate):
    """Lose messages on every topic; each topic has its own random numbers, for each is sent by one thread."""
    generators = defaultdict(random.Random)
    for topic in topics.TOPICS:
        generators[topic.name] = random.Random(f"{seed} {topic.name}")
    return lambda topic, payload: generators[topic.name].random() < rate


@pytest.fixture
def clock():
    return FakeClock()


@pytest.fixture
def started():
    """Start senders and stop them after the test."""
    senders = []

    def start(sender):
        senders.append(sender)
        sender.start()
        return sender

    yield start
    for sender in senders:
        sender.stop()


def test_a_message_leaves_before_it_is_retained(clock):
    network, retained_then = InMemoryNetwork(), []
    sender = make_sender(network, clock)
    network.transport(make_run()).subscribe(
        topics.EXPERIENCE, lambda payload: retained_then.append(sender.unacknowledged)
    )
    put(sender, 3)
    assert retained_then == [0, 1, 2]
    assert sender.unacknowledged == 3


def test_a_receiver_that_acknowledges_before_the_put_returns_leaves_nothing_unacknowledged(clock, started):
    network, taken = InMemoryNetwork(), threading.Event()
    sender = started(make_sender(network, clock, on_acknowledgement=lambda acknowledgement: taken.set()))
    receiver = network.transport(make_run())

    def acknowledge(payload):
        nothing = np.zeros((0, 2), np.int64)
        receiver.publisher(topics.EXPERIENCE_ACK).put(encode(Acknowledgement(1, 1, nothing, 0.0)))
        assert taken.wait(TIMEOUT_S)

    receiver.subscribe(topics.EXPERIENCE, acknowledge)
    put(sender, 1)
    assert sender.unacknowledged == 0


def test_a_message_that_cannot_leave_is_retained_all_the_same(clock):
    def refuse(topic, payload):
        raise TransportError("the session is closed")

    sender = make_sender(InMemoryNetwork(refuse), clock)
    for seq in range(2):
        with pytest.raises(TransportError, match="the session is closed"):
            sender.put(seq, b"x")
    assert sender.unacknowledged == 2


@pytest.mark.parametrize("rate", [0.0, 0.1, 0.4])
@pytest.mark.parametrize("seed", range(4))
def test_all_arrive_in_order_and_once_whatever_is_dropped(clock, started, seed, rate):
    network = InMemoryNetwork(drop_at_random(seed, rate))
    other = ReceivingSide(network)
    sender = started(make_sender(network, clock))
    for start in range(0, 400, 20):
        put(sender, 20, start=start)
        clock.advance(0.1)
        other.acknowledge()
    repair(sender, other, clock)
    receiver = other.receive()
    assert other.handed_on == [(1, seq) for seq in range(400)]
    assert counts(receiver)[0::2] == (0, 0)
    assert (sender.given_up, sender.refused) == (0, 0)
    assert (sender.resent > 0) == (rate > 0)


def test_an_outage_of_everything_is_repaired_after_it(clock, started):
    network = InMemoryNetwork()
    other = ReceivingSide(network)
    sender = started(make_sender(network, clock))
    put(sender, 10)
    network.drops = lambda topic, payload: True
    put(sender, 50, start=10)
    network.drops = lambda topic, payload: False
    put(sender, 1, start=60)
    assert other.receive().received_all is False
    assert other.handed_on == [(1, seq) for seq in range(10)]
    repair(sender, other, clock)
    assert other.handed_on == [(1, seq) for seq in range(61)]
    assert sender.resent == 50


def test_a_stream_goes_on_after_its_sender_was_replaced(clock, started):
    network = InMemoryNetwork(drop_at_random(7, 0.3))
    other = ReceivingSide(network)
    first = started(make_sender(network, clock, incarnation=1))
    put(first, 100)
    other.acknowledge()
    first.stop()  # killed: what it held is gone
    second = started(make_sender(network, clock, incarnation=2))
    put(second, 100, incarnation=2)
    repair(second, other, clock)
    of_first = [seq for stream, seq in other.handed_on if stream == 1]
    assert of_first == sorted(set(of_first))
    assert [seq for stream, seq in other.handed_on if stream == 2] == list(range(100))
    assert other.receive().lost == max(of_first) + 1 - len(of_first)


def test_a_receiver_that_was_replaced_gets_what_its_predecessor_did_not_acknowledge(clock, started):
    network = InMemoryNetwork()
    sender = started(make_sender(network, clock))
    first = ReceivingSide(network)
    put(sender, 30)
    first.acknowledge()
    eventually(lambda: sender.unacknowledged == 0)
    put(sender, 20, start=30)  # never acknowledged by the first, which dies
    second = ReceivingSide(network)
    put(sender, 5, start=50)
    repair(sender, second, clock)
    assert second.handed_on == [(1, seq) for seq in range(30, 55)]
    assert second.receive().lost == 0


def test_what_the_sender_gives_up_the_receiver_counts(clock, started):
    network = InMemoryNetwork()
    other = ReceivingSide(network)
    sender = started(make_sender(network, clock, journal_s=1.0))
    put(sender, 1)
    network.drops = lambda topic, payload: True
    put(sender, 9, start=1)
    clock.advance(2.0)
    network.drops = lambda topic, payload: False
    put(sender, 1, start=10)  # what is older than 1 s goes; it is the only one left
    assert (sender.given_up, sender.unacknowledged) == (10, 1)
    repair(sender, other, clock)
    assert other.handed_on == [(1, 0), (1, 10)]
    assert other.receive().lost == 9


def test_the_sender_tells_of_itself_without_being_asked(clock, started):
    network = InMemoryNetwork()
    heads = queue.SimpleQueue()
    network.transport(make_run()).subscribe(topics.EXPERIENCE_HEAD, heads.put)
    sender = started(make_sender(network, clock, incarnation=9))
    assert decode(heads.get(timeout=TIMEOUT_S), StreamHead).stream == 9
    put(sender, 3)
    clock.advance(HEAD_PERIOD_S)
    head = decode(heads.get(timeout=TIMEOUT_S), StreamHead)
    assert (head.oldest_seq, head.next_seq) == (0, 3)


def test_acknowledgements_are_handed_on_once_and_only_the_own_streams(clock, started):
    network = InMemoryNetwork()
    seen = []
    sender = started(make_sender(network, clock, incarnation=5, on_acknowledgement=seen.append))
    other = ReceivingSide(network)
    nothing = np.zeros((0, 2), np.int64)
    put(sender, 4, incarnation=5)
    for stream, next_seq in ((4, 3), (6, 3), (5, 2)):
        other.send(encode(Acknowledgement(stream, next_seq, nothing, updates_owed=next_seq / 2)))
    eventually(lambda: seen, "the acknowledgement")
    assert [(a.stream, a.next_seq, a.updates_owed) for a in seen] == [(5, 2, 1.0)]
    assert sender.unacknowledged == 2


def test_an_acknowledgement_that_cannot_be_read_is_counted_and_does_no_harm(clock, started, caplog):
    network = InMemoryNetwork()
    sender = started(make_sender(network, clock))
    other = ReceivingSide(network)
    put(sender, 4)
    other.send(b"\xc1")
    other.send(encode(StreamHead(1, 0, 4)))
    assert sender.refused == 2
    assert [r.levelname for r in caplog.records] == ["WARNING"]  # the first of them
    other.acknowledge()
    eventually(lambda: sender.unacknowledged == 0)


def test_an_acknowledgement_of_impossible_ranges_does_no_harm(clock, started):
    network = InMemoryNetwork()
    sender = started(make_sender(network, clock))
    other = ReceivingSide(network)
    put(sender, 4)
    clock.advance(1)
    limits = np.iinfo(np.int64)
    other.send(encode(Acknowledgement(1, 0, np.array([[limits.min, limits.max], [3, 1], [4, 4]]), 0.0)))
    eventually(lambda: sender.resent == 3)  # number 3 has come, says the empty range
    other.acknowledge()
    eventually(lambda: sender.unacknowledged == 0)


def test_repairs_go_on_a_topic_of_their_own(clock, started):
    network = InMemoryNetwork()
    resent = queue.SimpleQueue()
    network.transport(make_run()).subscribe(topics.EXPERIENCE_RESENT, resent.put)
    sender = started(make_sender(network, clock))
    put(sender, 3)
    clock.advance(1)
    ReceivingSide(network).send(encode(Acknowledgement(1, 1, np.array([[1, 2], [3, 3]]), 0.0)))
    assert resent.get(timeout=TIMEOUT_S) == b"1:1"
    eventually(lambda: sender.resent == 1)
    assert resent.empty()


def test_publishing_again_counts_as_resent(clock):
    network = InMemoryNetwork()
    seen = []
    network.transport(make_run()).subscribe(topics.EXPERIENCE, seen.append)
    sender = make_sender(network, clock)
    put(sender, 1)
    sender.republish(b"1:0")
    assert seen == [b"1:0", b"1:0"]
    assert (sender.resent, sender.unacknowledged) == (1, 1)


def test_stopping_does_not_wait_for_slow_repairs(clock):
    network = InMemoryNetwork()
    resent = queue.SimpleQueue()
    network.transport(make_run()).subscribe(topics.EXPERIENCE_RESENT, resent.put)
    sender = make_sender(network, clock, resend_kib_per_s=0.001)  # a byte a second
    sender.start()
    for seq in range(3):
        sender.put(seq, b"x" * 10_000)
    clock.advance(1)
    ReceivingSide(network).send(encode(Acknowledgement(1, 0, np.array([[0, 2], [3, 3]]), 0.0)))
    resent.get(timeout=TIMEOUT_S)
    stopper = threading.Thread(target=sender.stop)
    stopper.start()
    stopper.join(TIMEOUT_S)
    assert not stopper.is_alive()
    assert resent.empty()


def test_a_sender_that_was_never_started_can_be_stopped(clock):
    make_sender(InMemoryNetwork(), clock).stop()
