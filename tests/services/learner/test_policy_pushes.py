"""Policies on their way: always the newest, never more than their share of what the network gives them."""

import threading

import numpy as np
import pytest

from common import topics
from common.clock import FakeClock
from common.codec import decode, encode
from common.messages import PolicyAcknowledgement, PolicyWeights
from common.transport import InMemoryNetwork
from experiments.simulation import START_NS, SimulatedClock
from services.learner.policy_pushes import ACKNOWLEDGED_WITHIN_S, PolicyPusher, PushPacing
from tests.helpers import TIMEOUT_S, eventually
from tests.services.builders import Peer, SoloService


def make_push(version, size=100):
    """What is pushed: a version, and its policy of ``size`` bytes, which nobody is going to act with."""
    none = np.zeros(0, np.int64)
    return version, encode(
        PolicyWeights(version, version, "sac", 8, none, [], [], "float32", np.zeros(size, np.uint8), "")
    )


# ---------------------------------------------------------------------- one at a time


class SlowLink:
    """A link on which each policy takes until the test lets it through."""

    def __init__(self, directory) -> None:
        self.network = InMemoryNetwork()
        self.service = SoloService(topics.LEARNER, self.network, directory)
        self.arrived, self._free, self.entered = [], threading.Semaphore(0), threading.Semaphore(0)
        Peer(self.network).transport.subscribe(topics.POLICY, self._carry)
        self.pusher = PolicyPusher(self.service)

    def push(self, version) -> None:
        self.pusher.push(*make_push(version))

    def wait_for_one_on_its_way(self) -> None:
        assert self.entered.acquire(timeout=TIMEOUT_S)

    def let_through(self, count) -> None:
        for _ in range(count):
            self._free.release()

    def _carry(self, payload) -> None:
        self.entered.release()
        assert self._free.acquire(timeout=TIMEOUT_S)
        self.arrived.append(decode(payload, PolicyWeights).version)


def test_while_one_policy_is_on_its_way_the_next_ones_replace_each_other(tmp_path):
    link = SlowLink(tmp_path)
    link.push(1)
    link.wait_for_one_on_its_way()
    for version in (2, 3, 4):
        link.push(version)  # returns at once
    assert link.pusher.skipped == 2
    link.let_through(2)
    eventually(lambda: link.pusher.pushes == 2)
    assert link.arrived == [1, 4]
    link.pusher.close()


def test_a_push_that_is_stuck_does_not_hold_up_the_end(tmp_path):
    link = SlowLink(tmp_path)
    link.push(1)
    link.wait_for_one_on_its_way()
    link.push(2)
    link.pusher.close()
    assert link.arrived == []
    link.let_through(2)
    eventually(lambda: link.arrived == [1])  # what was pending is not sent after the end


# ---------------------------------------------------------------------- share


def test_silence_follows_a_push_in_proportion_to_its_time():
    pacing = PushPacing(share=0.25)
    assert (pacing.next_ns, pacing.bytes_per_s) == (0, 0.0)
    pacing.begin(1_000)
    pacing.arrived(600, 1_300)
    assert pacing.bytes_per_s == 2e9  # 600 bytes in 300 ns
    assert pacing.next_ns == 1_000 + 4 * 300
    pacing.begin(5_000)
    pacing.arrived(600, 5_100)
    assert pacing.next_ns == 5_000 + 4 * 100  # the network has become faster


def test_the_whole_share_is_no_silence_at_all():
    pacing = PushPacing(share=1.0)
    pacing.begin(1_000)
    pacing.arrived(600, 1_300)
    assert pacing.next_ns == 1_300
    pacing.begin(1_300)
    pacing.arrived(600, 1_300)  # a network without limits
    assert pacing.next_ns <= 1_301


class SimulatedLink(InMemoryNetwork):
    """A link of limited rate in simulated time; a put returns once the rest of its payload fits the buffers."""

    BUFFERS = 64_000
    DELAY_S = 0.003
    """One way."""

    def __init__(self, clock, bytes_per_s) -> None:
        super().__init__()
        self._clock, self._room = clock, clock.condition()
        self.bytes_per_s = bytes_per_s
        self.silent = False
        """True for a link that loses all acknowledgements."""
        self.puts = []
        """(seconds since the start, version, bytes) of each push."""

    def deliver(self, topic, payload, sender, subscriptions) -> None:
        def arrive():
            super(SimulatedLink, self).deliver(topic, payload, sender, subscriptions)

        if topic is topics.POLICY:
            seconds = (self._clock.now_ns() - START_NS) / 1e9
            self.puts.append((seconds, decode(payload, PolicyWeights).version, len(payload)))
            blocked_s = max(0, len(payload) - self.BUFFERS) / self.bytes_per_s
            if blocked_s:
                self._clock.wait(self._room, blocked_s)
            left_s = min(len(payload), self.BUFFERS) / self.bytes_per_s
            self._clock.call_later(round((left_s + self.DELAY_S) * 1e9), arrive)
        elif not self.silent:
            self._clock.call_later(round(self.DELAY_S * 1e9), arrive)


class Simulation:
    """A learner that has a new policy every 20 ms, a link, and an actor that acknowledges."""

    PERIOD_S = 0.02

    def __init__(self, directory, share, bytes_per_s, size=100_000) -> None:
        self.clock = SimulatedClock()
        self.link = SimulatedLink(self.clock, bytes_per_s)
        self.service = SoloService(topics.LEARNER, self.link, directory, self.clock)
        self.service.peers[topics.ACTOR] = "running"
        self.actor = Peer(self.link)
        self.actor.transport.subscribe(topics.POLICY, self._acknowledge)
        self.pusher = PolicyPusher(self.service, share)
        self._size, self._version = size, 0
        self._never = self.clock.condition()

    def run(self, seconds) -> list[tuple[float, int, int]]:
        """Let time pass; return the pushes that began in it."""
        before = len(self.link.puts)
        for _ in range(round(seconds / self.PERIOD_S)):
            self._version += 1
            self.pusher.push(*make_push(self._version, self._size))
            self.clock.wait(self._never, self.PERIOD_S)
        return self.link.puts[before:]

    def _acknowledge(self, payload) -> None:
        self.actor.send(topics.POLICY_ACK, PolicyAcknowledgement(decode(payload, PolicyWeights).version))


@pytest.fixture
def simulation(tmp_path):
    """Makes simulations, and ends their threads."""
    made = []

    def make(share, bytes_per_s, **changes):
        made.append(Simulation(tmp_path, share, bytes_per_s, **changes))
        return made[-1]

    yield make
    for each in made:
        each.clock.end()


def share_of(pushes, seconds, bytes_per_s):
    return sum(size for _, _, size in pushes) / seconds / bytes_per_s


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5])
@pytest.mark.parametrize("bytes_per_s", [1.5e6, 5e6])
def test_pushes_take_their_share_of_what_the_link_gives(simulation, share, bytes_per_s):
    scene = simulation(share, bytes_per_s, size=400_000)
    taken = share_of(scene.run(120), 120, bytes_per_s)
    # The way there and back, 6 ms, counts as time that the push took.
    assert taken == pytest.approx(share, rel=0.1)
    way_s = 400_000 / bytes_per_s + 2 * SimulatedLink.DELAY_S
    assert scene.pusher.bytes_per_s == pytest.approx(400_000 / way_s, rel=0.01)


def test_the_share_follows_a_link_that_changes(simulation):
    scene = simulation(0.25, 4e6, size=400_000)
    for bytes_per_s in (4e6, 1e6, 8e6):
        scene.link.bytes_per_s = bytes_per_s
        scene.run(5)  # the silence of before
        assert share_of(scene.run(60), 60, bytes_per_s) == pytest.approx(0.25, rel=0.15)


def test_what_is_sent_after_a_silence_is_the_newest_policy(simulation):
    scene = simulation(0.25, 1e6)
    pushes = scene.run(20)
    assert len(pushes) > 10
    for seconds, version, _ in pushes:
        # A new version every 20 ms, the first at once.
        assert version == int(seconds / Simulation.PERIOD_S + 1e-6) + 1
    assert scene.pusher.skipped == scene._version - len(scene.link.puts) - 1  # one is pending


def test_on_a_link_without_limits_every_policy_is_sent(simulation):
    for share in (1.0, 0.1):
        scene = simulation(share, 1e12)
        scene.link.DELAY_S = 0.0001
        assert len(scene.run(2)) == 100
        assert scene.pusher.skipped == 0


def test_the_whole_share_uses_the_link_all_the_time(simulation):
    scene = simulation(1.0, 1e6, size=400_000)
    assert share_of(scene.run(60), 60, 1e6) == pytest.approx(1.0, rel=0.03)


def test_nobody_who_is_gone_is_waited_for(simulation):
    scene = simulation(0.1, 1e9, size=1000)
    scene.link.silent = True
    scene.service.peers.clear()
    assert len(scene.run(2)) == 100


def test_a_lost_acknowledgement_costs_its_time_and_no_more(simulation):
    scene = simulation(0.1, 1e9, size=1000)
    scene.link.silent = True
    (first,) = scene.run(5)
    (second,) = scene.run(10)
    assert second[0] - first[0] == pytest.approx(ACKNOWLEDGED_WITHIN_S, abs=0.1)
    assert scene.pusher.bytes_per_s == 0.0
    scene.link.silent = False
    assert len(scene.run(20)) > 100


def test_a_late_acknowledgement_is_not_taken_for_the_next_push(tmp_path):
    clock, network = FakeClock(), InMemoryNetwork()
    service = SoloService(topics.LEARNER, network, tmp_path, clock)
    service.peers[topics.ACTOR] = "running"
    actor = Peer(network)
    policies = actor.messages(topics.POLICY)
    pusher = PolicyPusher(service, share=1.0)
    pusher.push(*make_push(1))
    policies.wait_for(1)
    clock.advance(ACKNOWLEDGED_WITHIN_S)
    pusher.push(*make_push(2))
    policies.wait_for(2)
    actor.send(topics.POLICY_ACK, PolicyAcknowledgement(1))
    pusher.push(*make_push(3))
    assert pusher.bytes_per_s == 0.0
    clock.advance(2.0)
    actor.send(topics.POLICY_ACK, PolicyAcknowledgement(2))
    policies.wait_for(3)
    assert pusher.bytes_per_s == pytest.approx(len(make_push(2)[1]) / 2.0)
    pusher.close()


def test_what_is_no_acknowledgement_is_dropped_and_counted(simulation):
    scene = simulation(0.5, 1e9)
    scene.actor.send_bytes(topics.POLICY_ACK, b"\xff")
    scene.run(0.1)
    assert scene.service.refusals.counts == {"policy/ack": 1}
