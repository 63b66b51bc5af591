"""Questions for the bridge's time: what a service then knows, and what it does when no usable answer comes."""

from __future__ import annotations

import logging

import pytest

from common import topics
from common.clock import SkewedClock
from common.clock_exchange import EXCHANGE_S, EXCHANGE_TIMEOUT_S, OffsetTracker, serve_clock
from common.codec import decode, encode
from common.inbox import Refusals
from common.messages import ClockReading
from common.service import Service
from experiments.simulation import SimulatedClock, SimulatedNetwork
from tests.helpers import make_run

MS = 1_000_000
SECOND_NS = 1_000_000_000


class Scene:
    """An actor's tracker whose clock is 3 s ahead, and a bridge, 20 ms apart each way, in simulated time."""

    def __init__(self):
        self.clock = SimulatedClock()
        self.network = SimulatedNetwork(self.clock)
        self.delay(20, 20)
        self.own_clock = SkewedClock(self.clock, 3.0)
        self.refusals = Refusals()
        self.transport = self.network.transport(make_run())
        self.tracker = OffsetTracker(topics.ACTOR, self.transport, self.own_clock, self.refusals)
        self._bridges = []

    def delay(self, question_ms, answer_ms):
        self.network.question_delays_ns[topics.CLOCK.name] = round(question_ms * MS)
        self.network.delays_ns[topics.CLOCK.name] = round(answer_ms * MS)

    def answer_with(self, answer):
        """Somebody answers instead of whoever did before."""
        for bridge in self._bridges:
            bridge.close()
        self._bridges = [self.network.transport(make_run())]
        self._bridges[0].serve(topics.CLOCK, answer)

    def bridge(self, clock=None, incarnation=7):
        for bridge in self._bridges:
            bridge.close()
        self._bridges = [self.network.transport(make_run())]
        serve_clock(self._bridges[0], clock or self.clock, incarnation)

    def run(self, seconds):
        self.clock.wait_until(self.clock.now_ns() + round(seconds * SECOND_NS), self.clock.condition())

    @property
    def offset_s(self):
        return self.tracker.at(self.own_clock.now_ns())[0] / 1e9

    @property
    def bound_ms(self):
        return self.tracker.at(self.own_clock.now_ns())[1] / MS


@pytest.fixture
def scene():
    scene = Scene()
    yield scene
    scene.clock.end()


def test_a_bridge_answers_with_its_time_and_who_it_is(scene):
    scene.bridge(incarnation=7)
    scene.run(2.5)
    before_ns = scene.clock.now_ns()
    reading = decode(scene.transport.query(topics.CLOCK), ClockReading)
    assert reading == ClockReading(7, before_ns + 20 * MS, before_ns + 20 * MS)


def test_the_offset_is_unknown_before_the_first_answer(scene):
    assert scene.tracker.at(0) == (0, -1)
    scene.tracker.start()
    scene.run(3.0)
    assert scene.tracker.at(0) == (0, -1)
    assert scene.tracker.details() == {"exchanges": 0, "unanswered": 30, "jumps": 0}


def test_the_offset_is_known_from_the_first_answer_on(scene):
    scene.bridge()
    scene.tracker.start()
    scene.run(0.041)
    assert scene.offset_s == pytest.approx(-3.0, abs=1e-5)
    assert scene.bound_ms == pytest.approx(20.0, abs=0.1)
    scene.run(30.0)
    details = scene.tracker.details()
    assert details["exchanges"] == pytest.approx(30.0 / (EXCHANGE_S[topics.ACTOR] + 0.04), abs=2)
    assert details["offset_s"] == pytest.approx(-3.0, abs=1e-6)
    assert details["best_round_trip_ms"] == 40.0
    assert (details["unanswered"], details["jumps"]) == (0, 0)


def test_an_answer_that_comes_too_late_is_none_and_the_bound_grows_meanwhile(scene):
    scene.bridge()
    scene.tracker.start()
    scene.run(20.0)
    bound_ms, details = scene.bound_ms, scene.tracker.details()
    scene.delay(300, 300)  # an outage: nothing comes within the time-out
    scene.run(60.0)
    assert scene.tracker.details()["unanswered"] == pytest.approx(60 / (EXCHANGE_TIMEOUT_S + 0.1), abs=2)
    assert scene.tracker.details()["exchanges"] - details["exchanges"] <= 1, "the one that was on its way"
    assert scene.bound_ms > bound_ms
    assert scene.offset_s == pytest.approx(-3.0, abs=1e-3)
    scene.delay(20, 20)
    scene.run(10.0)
    assert scene.bound_ms == pytest.approx(20.0, abs=0.5)


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (lambda payload: b"no message", "ClockReading: "),
        (lambda payload: encode(ClockReading(7, 5, 10**15)), "round trip: expected 0 ns or more"),
        (lambda payload: encode(ClockReading(-1, 5, 5)), "ClockReading.incarnation"),
    ],
    ids=["no message", "longer than the question was out", "out of bounds"],
)
def test_an_answer_that_cannot_be_is_refused_and_the_estimate_stays(scene, caplog, answer, reason):
    scene.bridge()
    scene.tracker.start()
    scene.run(5.0)
    scene.answer_with(answer)
    scene.run(5.0)
    assert scene.refusals.counts[topics.CLOCK.name] > 30
    assert caplog.text.count("dropped a message on clock") == 1
    assert reason in caplog.text
    assert scene.offset_s == pytest.approx(-3.0, abs=1e-3)
    scene.bridge()
    scene.run(1.0)
    assert scene.offset_s == pytest.approx(-3.0, abs=1e-4)


def test_a_bridge_on_another_computer_is_followed_and_is_no_jump(scene, caplog):
    scene.bridge()
    scene.tracker.start()
    scene.run(5.0)
    scene.bridge(SkewedClock(scene.clock, 100.0), incarnation=8)
    scene.run(0.3)
    assert scene.offset_s == pytest.approx(97.0, abs=1e-5)
    assert scene.tracker.details()["jumps"] == 0
    assert "jumped" not in caplog.text


def test_a_jump_is_logged_with_its_size_and_counted(scene, caplog):
    scene.bridge()
    scene.tracker.start()
    scene.run(20.0)
    with caplog.at_level(logging.WARNING):
        scene.own_clock.jump(-1.25)  # this computer slept
        scene.run(1.0)
    assert "jumped: they are +1.250 s further apart" in caplog.text
    assert scene.tracker.details()["jumps"] == 1
    assert scene.offset_s == pytest.approx(-1.75, abs=1e-4)


def test_a_clock_that_jumps_all_the_time_does_not_fill_the_log(scene, caplog):
    scene.bridge()
    scene.tracker.start()
    for _ in range(20):
        scene.run(2.0)
        scene.own_clock.jump(1.0)
    scene.run(1.0)
    assert scene.tracker.details()["jumps"] == 20
    assert [record.args[1] for record in caplog.records if "jumped" in record.msg] == [1, 2, 4, 8, 16]
    assert scene.offset_s == pytest.approx(-23.0, abs=1e-3)


@pytest.mark.parametrize("jump_s", [-40.0, 40.0])
def test_a_jump_while_a_question_is_out_is_told_too(scene, caplog, jump_s):
    scene.bridge()
    scene.tracker.start()
    scene.run(1.41)  # ten exchanges of 40 ms and their pauses; the eleventh has begun
    assert scene.tracker.details()["exchanges"] == 10
    scene.own_clock.jump(jump_s)
    scene.run(0.6)
    assert scene.tracker.details()["unanswered"] == 1
    assert scene.tracker.details()["jumps"] == 1
    assert f"jumped: they are {-jump_s:+.3f} s further apart" in caplog.text
    assert scene.offset_s == pytest.approx(-3.0 - jump_s, abs=1e-4)


def test_asking_ends_at_once_and_survives_a_session_that_closes_first(scene):
    scene.bridge()
    scene.tracker.start()
    scene.run(1.0)
    scene.transport.close()
    scene.run(1.0)
    assert scene.tracker.details()["unanswered"] > 5
    before_ns = scene.clock.now_ns()
    scene.tracker.stop()
    assert scene.clock.now_ns() == before_ns


def test_every_service_but_the_bridge_asks_and_records_what_it_knows(scene, tmp_path):
    services = {
        name: Service(name, make_run(tmp_path), scene.network.transport(make_run(tmp_path)), clock, incarnation=number)
        for number, (name, clock) in enumerate(
            {
                topics.ROBOT_BRIDGE: scene.clock,
                topics.ACTOR: SkewedClock(scene.clock, 3.0),
                topics.LEARNER: SkewedClock(scene.clock, 8.0),
            }.items()
        )
    }
    parts = {}
    for name, service in services.items():
        service.record.part = lambda values, name=name: parts.update({name: values})
        service.start()
    assert services[topics.ACTOR].bridge_offset(0) == (0, -1)
    scene.run(10.0)
    for service in services.values():
        service.write_record()
        service.record.close()
    assert "clock" not in parts[topics.ROBOT_BRIDGE]
    assert parts[topics.ACTOR]["clock"]["offset_s"] == pytest.approx(-3.0, abs=1e-4)
    assert parts[topics.LEARNER]["clock"]["offset_s"] == pytest.approx(-8.0, abs=1e-4)
    assert parts[topics.ACTOR]["clock"]["exchanges"] > 5 * parts[topics.LEARNER]["clock"]["exchanges"] > 0
    offset_ns, bound_ns = services[topics.ACTOR].bridge_offset(services[topics.ACTOR].clock.now_ns())
    assert abs(offset_ns + 3 * SECOND_NS) < bound_ns
