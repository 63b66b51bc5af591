"""TimeSteps become experience: in order, each once, with what the policy chose on the one before."""

import threading

import numpy as np
import pytest

from common import topics
from common.clock import FakeClock
from common.codec import encode
from common.messages import Acknowledgement, Experience, PolicyExtras, StreamHead
from common.retained_messages import FIRST_TIMEOUT_S
from common.transport import InMemoryNetwork
from services.actor import forwarding
from services.actor.config import ActorSettings
from services.actor.forwarding import ACKNOWLEDGE_S, REMEMBERED_ANSWERS, ExperienceForwarder
from tests.helpers import TIMEOUT_S, eventually, make_spec, make_time_step
from tests.services.actor.scene import ACTOR, BRIDGE
from tests.services.builders import Peer, SoloService

SPEC = make_spec(camera=False)


def step(seq, **changes):
    return make_time_step(seq, SPEC, **changes)


class Line:
    """A forwarder between a bridge and a replay that the test plays."""

    def __init__(self, directory, clock=None) -> None:
        self.network = InMemoryNetwork()
        self.service = SoloService(topics.ACTOR, self.network, directory, clock, incarnation=ACTOR)
        self.forwarder = ExperienceForwarder(self.service, ActorSettings(resend_kib_per_s=1e6))
        self.peer = Peer(self.network)
        self.experiences = self.peer.messages(topics.EXPERIENCE)
        self.resent = self.peer.messages(topics.EXPERIENCE_RESENT)
        self.heads = self.peer.messages(topics.EXPERIENCE_HEAD)
        self.acks = self.peer.messages(topics.TIME_STEP_ACK)

    def add(self, *time_steps) -> None:
        for time_step in time_steps:
            self.forwarder.add(step(time_step) if isinstance(time_step, int) else time_step)

    def send_head(self, next_seq, oldest_seq=0, stream=BRIDGE) -> None:
        self.peer.send(topics.TIME_STEP_HEAD, StreamHead(stream, oldest_seq, next_seq))

    def acknowledge(self, next_seq, missing=(), owed=0.0) -> None:
        ranges = np.array(missing, np.int64).reshape(-1, 2)
        self.peer.send(topics.EXPERIENCE_ACK, Acknowledgement(ACTOR, next_seq, ranges, owed))

    def wait_for_ack(self, next_seq, missing=()) -> None:
        """Wait until the bridge is told exactly this."""
        wanted = next_seq, [list(r) for r in missing]
        eventually(lambda: len(self.acks) and (self.acks[-1].next_seq, self.acks[-1].missing.tolist()) == wanted)
        assert self.acks[-1].stream == BRIDGE


@pytest.fixture
def line(tmp_path):
    """A running line."""
    line = Line(tmp_path)
    line.forwarder.start()
    yield line
    line.forwarder.stop()


def extras(number):
    return PolicyExtras(np.full(2, number, np.float32), -float(number), number)


def test_experience_is_numbered_and_holds_the_time_step_unchanged(line):
    line.add(0, 1, 2)
    experiences = line.experiences.wait_for(3)
    assert [(e.actor_incarnation, e.seq, e.time_step.seq) for e in experiences] == [(ACTOR, i, i) for i in range(3)]
    for sent, got in zip((step(0), step(1), step(2)), experiences, strict=True):
        for name, value in vars(sent).items():
            np.testing.assert_array_equal(getattr(got.time_step, name), value)


def test_the_extras_are_those_of_the_answer_to_the_time_step_before_whichever_was_applied(line):
    line.forwarder.remember_answer(step(0), extras(10))
    line.forwarder.remember_answer(step(1), extras(11))
    line.forwarder.remember_answer(step(2), extras(12))
    # Number 2 was answered too late: the answer to number 1 was held through two cycles. Number 3 was not answered.
    line.add(0, 1, 2, step(3, answered_seq=1), 4)
    experiences = line.experiences.wait_for(5)
    assert [e.extras and e.extras.policy_version for e in experiences] == [None, 10, 11, 12, None]
    np.testing.assert_array_equal(experiences[1].extras.chosen_action, [10, 10])
    assert experiences[1].extras.log_probability == -10.0


def test_the_first_time_step_of_an_attempt_has_no_extras(line):
    # The answer to number 0 came after the attempt that it belongs to had been given up.
    line.forwarder.remember_answer(step(0), extras(10))
    line.add(0, step(1, step_index=0, answered_seq=-1))
    assert line.experiences.wait_for(2)[1].extras is None


def test_an_answer_that_was_never_applied_is_experience_too(line):
    line.forwarder.remember_answer(step(0), extras(10))
    line.add(0, step(1, answered_seq=-1))
    assert line.experiences.wait_for(2)[1].extras.policy_version == 10


def test_the_extras_of_another_bridges_time_step_are_not_taken(line):
    line.forwarder.remember_answer(step(0, incarnation=BRIDGE), extras(10))
    line.add(step(0, incarnation=BRIDGE + 1), step(1, incarnation=BRIDGE + 1))
    assert line.experiences.wait_for(2)[1].extras is None


def test_answers_are_remembered_long_enough_and_not_for_ever(line):
    for seq in range(REMEMBERED_ANSWERS + 1):
        line.forwarder.remember_answer(step(seq), extras(seq))
    line.add(0, step(1, answered_seq=0), step(2, answered_seq=1))
    experiences = line.experiences.wait_for(3)
    assert experiences[1].extras is None
    assert experiences[2].extras.policy_version == 1


def test_a_gap_holds_back_what_comes_after_it_until_it_is_filled(line):
    line.send_head(0)
    line.add(0, 1, 4, 3)
    line.wait_for_ack(2, [(2, 3), (5, 5)])
    assert len(line.experiences) == 2
    line.add(2)
    assert [e.time_step.seq for e in line.experiences.wait_for(5)] == [0, 1, 2, 3, 4]
    assert [e.seq for e in line.experiences] == [0, 1, 2, 3, 4]
    line.wait_for_ack(5)


def test_a_loss_at_the_end_is_noticed_by_the_bridges_word(line):
    line.add(0, 1)
    line.send_head(4)
    line.wait_for_ack(2, [(2, 4)])


def test_what_the_bridge_gave_up_is_lost_and_counted(line):
    line.send_head(0)
    line.add(0, 1, 5)
    line.send_head(6, oldest_seq=4)
    line.add(4)
    assert [e.time_step.seq for e in line.experiences.wait_for(4)] == [0, 1, 4, 5]
    assert [e.seq for e in line.experiences] == [0, 1, 2, 3]  # replay's stream has no gap
    assert line.forwarder.counters()["lost"] == 2


def test_a_copy_is_forwarded_once(line):
    line.add(0, 1, 1, 0, 2, 2)
    line.wait_for_ack(3)
    assert len(line.experiences) == 3
    assert line.forwarder.counters()["duplicates"] == 3


def test_an_actor_that_comes_late_begins_where_the_bridge_still_has_something(line):
    line.add(41, 42)
    line.send_head(43, oldest_seq=40)
    line.wait_for_ack(40, [(40, 41), (43, 43)])
    line.add(40)
    assert [e.time_step.seq for e in line.experiences.wait_for(3)] == [40, 41, 42]
    assert line.forwarder.counters()["lost"] == 0


def test_a_new_bridge_begins_a_new_stream(line):
    line.add(0, 1)
    line.add(step(0, incarnation=BRIDGE + 1), step(2), step(1, incarnation=BRIDGE + 1))
    experiences = line.experiences.wait_for(4)
    streams = [(e.time_step.incarnation, e.time_step.seq) for e in experiences]
    assert streams == [(BRIDGE, 0), (BRIDGE, 1), (BRIDGE + 1, 0), (BRIDGE + 1, 1)]
    assert [e.seq for e in experiences] == [0, 1, 2, 3]


def test_the_bridge_is_told_at_most_ten_times_a_second(tmp_path):
    clock = FakeClock()
    line = Line(tmp_path, clock)
    line.forwarder.start()
    line.add(0)
    line.acks.wait_for(1)
    line.add(1, 2, 3)
    line.experiences.wait_for(4)
    assert [ack.next_seq for ack in line.acks] == [1]
    clock.advance(ACKNOWLEDGE_S)
    line.add(4)
    line.experiences.wait_for(5)
    eventually(lambda: len(line.acks) == 2)
    assert line.acks[1].next_seq == 5
    line.forwarder.stop()


def test_replay_gets_again_what_it_misses(tmp_path):
    clock = FakeClock()
    line = Line(tmp_path, clock)
    line.network.drops = lambda topic, payload: topic is topics.EXPERIENCE and len(line.experiences) == 2
    line.forwarder.start()
    line.add(0, 1, 2)
    eventually(lambda: line.forwarder.counters()["unacknowledged"] == 3)
    line.acknowledge(2, missing=[(2, 3)])
    eventually(lambda: line.forwarder.counters()["unacknowledged"] == 1)
    clock.advance(FIRST_TIMEOUT_S)
    line.acknowledge(2, missing=[(2, 3)])
    assert line.resent.wait_for(1)[0].seq == 2
    eventually(lambda: line.forwarder.counters()["resent"] == 1)
    assert line.forwarder.counters()["unacknowledged"] == 1
    line.acknowledge(3)
    eventually(lambda: line.forwarder.counters()["unacknowledged"] == 0)
    line.forwarder.stop()


def test_replay_is_told_what_there_is(line):
    line.add(0, 1, 2)
    eventually(lambda: len(line.heads) and line.heads[-1].next_seq == 3)
    assert (line.heads[-1].stream, line.heads[-1].oldest_seq) == (ACTOR, 0)
    line.acknowledge(2)
    eventually(lambda: line.heads[-1].oldest_seq == 2)


def test_it_is_drained_when_all_the_bridge_produced_is_acknowledged_by_replay(line):
    line.send_head(0)
    line.add(0, 1, 3)
    line.experiences.wait_for(2)
    line.acknowledge(2)
    eventually(lambda: line.forwarder.counters()["unacknowledged"] == 0)
    assert not line.forwarder.is_drained(BRIDGE, 4)
    line.add(2)
    line.experiences.wait_for(4)
    assert not line.forwarder.is_drained(BRIDGE, 4)
    line.acknowledge(4)
    eventually(lambda: line.forwarder.is_drained(BRIDGE, 4))
    assert not line.forwarder.is_drained(BRIDGE + 1, 4)
    assert not line.forwarder.is_drained(BRIDGE, 5)


def test_it_is_not_drained_while_experience_is_on_its_way_to_the_sender(line, monkeypatch):
    begun, go_on = threading.Event(), threading.Event()

    def slow_encode(message):
        if isinstance(message, Experience):
            begun.set()
            assert go_on.wait(TIMEOUT_S)
        return encode(message)

    monkeypatch.setattr(forwarding, "encode", slow_encode)
    line.add(0)
    assert begun.wait(TIMEOUT_S)
    drained = line.forwarder.is_drained(BRIDGE, 1)
    go_on.set()
    assert not drained
    line.experiences.wait_for(1)
    line.acknowledge(1)
    eventually(lambda: line.forwarder.is_drained(BRIDGE, 1))


def test_another_actors_acknowledgement_is_none_of_ours(line):
    line.add(0)
    line.experiences.wait_for(1)
    line.peer.send(topics.EXPERIENCE_ACK, Acknowledgement(ACTOR - 1, 1, np.zeros((0, 2), np.int64), 9.0))
    line.acknowledge(0, owed=3.0)
    eventually(lambda: line.forwarder.updates_owed == 3.0)
    assert line.forwarder.counters()["unacknowledged"] == 1


def test_an_unreadable_head_is_dropped_and_counted(line):
    line.peer.send_bytes(topics.TIME_STEP_HEAD, b"noise")
    eventually(lambda: line.service.refusals.counts["timestep/head"] == 1)
    line.add(0)
    line.experiences.wait_for(1)
