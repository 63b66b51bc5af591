"""Messages between placed services take the time of the link that they cross."""

from __future__ import annotations

import pytest

from common import topics
from common.run_settings import RunSettings
from common.topics import ACTOR, LEARNER, REPLAY, ROBOT_BRIDGE
from deploy.network import DirectionConditions, NetworkConditions, Trace
from experiments.simulation import START_NS, SimulatedClock
from experiments.virtual_network import LIMITED_BUFFER_BYTES, MESSAGE_OVERHEAD_BYTES, VirtualLink, VirtualNetwork
from experiments.virtual_tcp import HEADER_BYTES

REMOTE_ONLY = {ROBOT_BRIDGE: "local", ACTOR: "remote", REPLAY: "remote", LEARNER: "remote"}
REMOTE_LOCAL = {ROBOT_BRIDGE: "local", ACTOR: "local", REPLAY: "remote", LEARNER: "remote"}
MESSAGE_MS = 1.0


class Scene:
    """Services that note what they hear, and when, in ms."""

    def __init__(self, host, uplink=None, downlink=None, **outages) -> None:
        self.clock = SimulatedClock()
        conditions = NetworkConditions(
            uplink or DirectionConditions(delay_ms=10), downlink or DirectionConditions(delay_ms=30), **outages
        )
        self.link = VirtualLink(self.clock, conditions, seed=0)
        self.network = VirtualNetwork(self.clock, host, self.link, MESSAGE_MS / 1e3)
        run = RunSettings(id="test", directory="unused")
        self.transports = {name: self.network.transport_of(name, run) for name in topics.SERVICES}
        self.heard: list[tuple[str, float]] = []

    def now_ms(self) -> float:
        return (self.clock.now_ns() - START_NS) / 1e6

    def listen(self, service, topic) -> None:
        self.transports[service].subscribe(topic, lambda _: self.heard.append((service, round(self.now_ms(), 3))))

    def put(self, service, topic, payload=b"message") -> None:
        self.transports[service].publisher(topic).put(payload)

    def sleep(self, seconds=1.0) -> None:
        condition = self.clock.condition()
        with condition:
            self.clock.wait(condition, seconds)


@pytest.fixture
def scene():
    """Make scenes; what they leave is ended after the test."""
    made = []

    def make(*arguments, **options) -> Scene:
        made.append(Scene(*arguments, **options))
        return made[-1]

    yield make
    for scene in made:
        scene.clock.end()


def test_what_crosses_takes_its_direction_s_delay_and_the_way_through_the_processes(scene):
    office = scene(REMOTE_ONLY)
    office.listen(ACTOR, topics.TIME_STEP)
    office.listen(ROBOT_BRIDGE, topics.ACTION)
    office.put(ROBOT_BRIDGE, topics.TIME_STEP)
    office.put(ACTOR, topics.ACTION)
    office.sleep()
    assert office.heard == [(ACTOR, 10 + MESSAGE_MS), (ROBOT_BRIDGE, 30 + MESSAGE_MS)]


def test_a_message_does_not_look_at_every_row_of_a_trace(scene, monkeypatch):
    traced = scene(REMOTE_ONLY, uplink=DirectionConditions(trace=Trace("t", (0, 1), delay_ms=(5, 6), rate_mbit=(8, 8))))
    monkeypatch.setattr(Trace, "mean", None)  # whose time grows with the rows
    traced.listen(ACTOR, topics.TIME_STEP)
    traced.put(ROBOT_BRIDGE, topics.TIME_STEP)
    traced.sleep()
    # A byte takes 1 us at 8 Mbit/s.
    on_air_ms = (len(b"message") + MESSAGE_OVERHEAD_BYTES + HEADER_BYTES) / 1e3
    assert traced.heard == [(ACTOR, pytest.approx(5 + on_air_ms + MESSAGE_MS))]


def test_what_stays_on_a_host_does_not_meet_the_link(scene):
    office = scene(REMOTE_LOCAL)
    office.listen(ACTOR, topics.TIME_STEP)
    office.listen(LEARNER, topics.ROW_MINIBATCH)
    office.put(ROBOT_BRIDGE, topics.TIME_STEP)
    office.put(REPLAY, topics.ROW_MINIBATCH)
    office.sleep()
    assert office.heard == [(LEARNER, 0), (ACTOR, MESSAGE_MS)]
    assert all(direction.counts.packets_in == 0 for direction in office.link.directions.values())


def test_one_publication_crosses_once_for_each_listener_on_the_other_host(scene):
    office = scene(REMOTE_LOCAL)
    for service in topics.SERVICES:
        office.listen(service, topics.STATUS)
    office.put(ROBOT_BRIDGE, topics.STATUS)
    office.sleep()
    assert sorted(office.heard) == [
        (ACTOR, 0),
        (LEARNER, 10 + MESSAGE_MS),
        (REPLAY, 10 + MESSAGE_MS),
        (ROBOT_BRIDGE, 0),
    ]
    assert office.link.directions["uplink"].counts.packets_in == 2


def test_a_large_message_takes_its_bytes_at_the_rate(scene):
    # 1 Mbit/s is 125 bytes per ms.
    office = scene(REMOTE_ONLY, uplink=DirectionConditions(rate_mbit=1.0))
    office.listen(ACTOR, topics.TIME_STEP)
    payload = bytes(1250 - MESSAGE_OVERHEAD_BYTES - HEADER_BYTES)
    office.put(ROBOT_BRIDGE, topics.TIME_STEP, payload)
    office.sleep()
    assert office.heard == [(ACTOR, 10 + MESSAGE_MS)]
    part = office.link.part()
    assert part.directions["uplink"].bytes_in == part.kernel["local"].sent == part.kernel["remote"].received == 1250


def test_real_time_messages_do_not_wait_for_bulk_data_of_their_service_to_be_acknowledged(scene):
    office = scene(REMOTE_ONLY)
    office.listen(ACTOR, topics.TIME_STEP)
    office.put(ROBOT_BRIDGE, topics.TIME_STEP_RESENT, bytes(1_000_000))
    office.put(ROBOT_BRIDGE, topics.TIME_STEP)
    office.sleep()
    assert office.heard == [(ACTOR, 10 + MESSAGE_MS)]


def test_what_finds_the_buffers_full_is_dropped_and_counted(scene):
    office = scene(REMOTE_ONLY, uplink=DirectionConditions(rate_mbit=1.0))
    office.listen(ACTOR, topics.TIME_STEP)
    size = 40_000 - MESSAGE_OVERHEAD_BYTES
    for _ in range(10):
        office.put(ROBOT_BRIDGE, topics.TIME_STEP, bytes(size))
    fitting = LIMITED_BUFFER_BYTES // 40_000
    assert office.network.dropped == {topics.TIME_STEP.name: 10 - fitting}
    office.sleep(20.0)
    assert len(office.heard) == fitting == 8


def test_a_put_that_waits_goes_on_when_the_buffers_hold_the_rest(scene):
    office = scene(REMOTE_ONLY, downlink=DirectionConditions(rate_mbit=8.0))  # 1000 bytes per ms
    custom = {**REMOTE_ONLY, ACTOR: "local"}
    office.network = VirtualNetwork(office.clock, custom, office.link, MESSAGE_MS / 1e3)
    run = RunSettings(id="test", directory="unused")
    office.transports = {name: office.network.transport_of(name, run) for name in topics.SERVICES}
    office.listen(ACTOR, topics.POLICY)
    excess = 100_000
    office.put(LEARNER, topics.POLICY, bytes(LIMITED_BUFFER_BYTES + excess))
    # 100 ms at the rate, 4 % of headers, and a few round trips of slow start.
    assert 100 < office.now_ms() < 250
    assert office.heard == []
    office.sleep()
    assert [service for service, _ in office.heard] == [ACTOR]


def test_after_an_outage_a_connection_delivers_what_was_written_in_it(scene):
    office = scene(REMOTE_ONLY, outage_every_s=2.0, outage_s=1.0)
    office.listen(ACTOR, topics.TIME_STEP)
    office.put(ROBOT_BRIDGE, topics.TIME_STEP)
    office.sleep(2.5)
    office.put(ROBOT_BRIDGE, topics.TIME_STEP)
    office.sleep(2.5)
    first, second = (at_ms for _, at_ms in office.heard)
    assert first == 10 + MESSAGE_MS
    # Round trip 40: asked after 240 ms, tried again 240 and 480 ms later, the last after the outage's end at 3000.
    assert second == 2500 + 240 + 240 + 480 + 10 + MESSAGE_MS
    (outage,) = office.link.part().outages[:1]
    assert (outage.start_monotonic_ns - START_NS, outage.end_monotonic_ns - START_NS) == (2e9, 3e9)
