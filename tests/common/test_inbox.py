"""What a receiving thread leaves for a service: only usable messages come out, the others are counted."""

import logging
import threading

import pytest

from common import topics
from common.clock import FakeClock
from common.codec import encode
from common.inbox import Inbox, Refusals
from common.messages import Command, Credit, PolicyWeights
from common.transport import InMemoryNetwork
from tests.common.test_codec import example
from tests.helpers import TIMEOUT_S, make_run, make_spec, make_time_step


class Scene:
    """An inbox and whoever sends to it."""

    def __init__(self, topic=topics.CREDIT, expected=Credit, **options):
        self.network, self.clock, self.wake, self.refusals = (
            InMemoryNetwork(),
            FakeClock(),
            threading.Condition(),
            Refusals(),
        )
        self.topic = topic
        self.inbox = Inbox(
            self.network.transport(make_run()), topic, expected, self.wake, self.clock, self.refusals, **options
        )
        self.send_bytes = self.network.transport(make_run()).publisher(topic).put

    def send(self, *numbers):
        for number in numbers:
            self.send_bytes(encode(Credit(1, number, 0)))

    def taken(self):
        return [arrived.message.want_total for arrived in self.inbox.take()]


def test_an_empty_inbox_is_false_and_gives_nothing():
    scene = Scene()
    assert not scene.inbox
    assert scene.inbox.take() == []
    assert scene.inbox.take_newest() is None


def test_messages_come_out_in_order_and_once():
    scene = Scene(capacity=10)
    scene.send(1, 2, 3)
    assert scene.inbox
    assert scene.taken() == [1, 2, 3]
    assert not scene.inbox
    assert scene.taken() == []


def test_a_full_inbox_drops_the_oldest():
    scene = Scene(capacity=3)
    scene.send(*range(10))
    assert scene.taken() == [7, 8, 9]


def test_an_inbox_holds_only_the_newest_unless_it_is_told_otherwise():
    scene = Scene()
    scene.send(1, 2, 3)
    assert scene.taken() == [3]


def test_a_message_carries_the_time_at_which_it_came():
    scene = Scene(capacity=3)
    scene.send(1)
    scene.clock.advance(1.5)
    scene.send(2)
    scene.clock.advance(10)  # until the service looks
    assert [arrived.at_ns for arrived in scene.inbox.take()] == [1_000_000_000, 2_500_000_000]


def test_the_newest_usable_message_is_taken_and_the_others_are_gone():
    scene = Scene(capacity=5)
    scene.send(1, 2)
    scene.send_bytes(b"broken")
    assert scene.inbox.take_newest().message.want_total == 2
    assert scene.refusals.total == 1
    assert not scene.inbox


def test_what_cannot_be_used_is_dropped_counted_and_logged_once(caplog):
    scene = Scene(capacity=10)
    scene.send(1)
    for _ in range(3):
        scene.send_bytes(encode(Command("stop")))
    scene.send(2)
    assert scene.taken() == [1, 2]
    assert scene.refusals.counts == {"credit": 3}
    assert [record.levelno for record in caplog.records] == [logging.ERROR]
    assert "dropped a message on credit" in caplog.text
    assert "expected message Credit, got 'Command'" in caplog.text


def test_each_topics_first_refusal_is_logged(caplog):
    refusals = Refusals()
    for topic in ("credit", "action", "credit", "action"):
        refusals.refuse(topic, "no reason")
    assert refusals.counts == {"credit": 2, "action": 2}
    assert refusals.total == 4
    assert len(caplog.records) == 2


def test_messages_must_have_the_tasks_sizes():
    spec = make_spec()
    scene = Scene(topics.TIME_STEP, topics.TIME_STEP.message, dimensions=spec.dimensions, capacity=5)
    scene.send_bytes(encode(make_time_step(1, spec)))
    scene.send_bytes(encode(make_time_step(2, make_spec(camera=False))))
    assert [arrived.message.seq for arrived in scene.inbox.take()] == [1]
    assert scene.refusals.counts == {"timestep": 1}


def test_an_arriving_message_wakes_who_waits_for_it():
    scene = Scene()
    with scene.wake:
        sender = threading.Thread(target=scene.send, args=(1,))
        sender.start()
        # The sender needs the lock to notify, and gets it only while this thread waits.
        assert scene.wake.wait_for(lambda: bool(scene.inbox), TIMEOUT_S)
    sender.join()
    assert scene.taken() == [1]


def test_a_cached_message_is_there_at_once():
    network, wake, weights = InMemoryNetwork(), threading.Condition(), example(PolicyWeights)
    publisher = network.transport(make_run()).publisher(topics.POLICY)
    publisher.put(encode(weights))
    inbox = Inbox(network.transport(make_run()), topics.POLICY, PolicyWeights, wake, FakeClock(), Refusals())
    assert inbox.take_newest().message.version == weights.version


@pytest.mark.parametrize("any_run", [False, True])
def test_messages_of_other_runs_come_only_if_asked_for(any_run):
    scene = Scene(capacity=5, any_run=any_run)
    scene.network.transport(make_run(run="other")).publisher(scene.topic).put(encode(Credit(1, 7, 0)))
    scene.send(1)
    assert scene.taken() == ([7, 1] if any_run else [1])


def test_messages_may_arrive_while_others_are_taken():
    scene = Scene(capacity=4)
    sender = threading.Thread(target=scene.send, args=range(2000))
    sender.start()
    seen = []
    while sender.is_alive() or scene.inbox:
        seen += scene.taken()
    sender.join()
    assert seen == sorted(set(seen))
    assert seen[-1] == 1999
    assert scene.refusals.total == 0
