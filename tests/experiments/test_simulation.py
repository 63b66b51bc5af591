"""Simulated time: one thread at a time, in a known order, and no real waiting."""

from __future__ import annotations

import threading

import pytest

from common import topics
from common.run_settings import RunSettings
from experiments.simulation import START_NS, SimulatedClock, SimulatedNetwork, SimulationEnded

SECOND_NS = 1_000_000_000


class Scene:
    """A clock and what its threads have written down, with the simulated second."""

    def __init__(self) -> None:
        self.clock = SimulatedClock()
        self.said: list[tuple[float, str]] = []

    def say(self, text: str) -> None:
        self.said.append(((self.clock.now_ns() - START_NS) / 1e9, text))

    def sleep(self, seconds: float) -> None:
        with (condition := self.clock.condition()):
            assert not self.clock.wait(condition, seconds)

    def start(self, *targets) -> list[threading.Thread]:
        threads = [self.clock.thread(target, f"thread {number}") for number, target in enumerate(targets)]
        for thread in threads:
            thread.start()
        return threads


@pytest.fixture
def scene():
    scene = Scene()
    yield scene
    scene.clock.end()


def test_threads_run_one_after_the_other_and_time_jumps_to_the_next_deadline(scene):
    def work(name, period_s):
        for _ in range(3):
            scene.sleep(period_s)
            scene.say(name)

    threads = scene.start(lambda: work("a", 2.0), lambda: work("b", 3.0))
    for thread in threads:
        thread.join()
    # At six seconds both are due; b asked first, at three seconds.
    assert scene.said == [(2, "a"), (3, "b"), (4, "a"), (6, "b"), (6, "a"), (9, "b")]


def test_an_interruption_ends_the_wait_of_the_first_thread_though_others_never_stop(scene):
    turns = 0

    def go_on():
        nonlocal turns
        while True:
            turns += 1
            scene.sleep(0.0)  # No time passes, so no deadline comes.

    (thread,) = scene.start(go_on)
    scene.clock.interrupted = lambda: turns == 1000
    with pytest.raises(SimulationEnded):
        scene.sleep(1.0)
    assert (turns, scene.clock.now_ns(), thread.is_alive()) == (1000, START_NS, True)
    scene.clock.end()
    assert (turns, thread.is_alive()) == (1000, False)


def test_an_hour_passes_without_waiting(scene):
    scene.sleep(3600.0)
    assert scene.clock.now_ns() == START_NS + 3600 * SECOND_NS


def test_who_is_notified_goes_on_in_the_order_of_waiting_at_the_same_time(scene):
    condition = scene.clock.condition()

    def wait(name):
        with condition:
            assert scene.clock.wait(condition, 10.0)
        scene.say(name)

    threads = scene.start(lambda: wait("a"), lambda: wait("b"), lambda: wait("c"))
    scene.sleep(1.0)
    with condition:
        condition.notify()
    scene.sleep(1.0)
    with condition:
        condition.notify_all()
    for thread in threads:
        thread.join()
    assert scene.said == [(1, "a"), (2, "b"), (2, "c")]


def test_a_time_out_of_an_earlier_wait_does_not_end_a_later_one(scene):
    condition = scene.clock.condition()

    def wait_twice():
        with condition:
            scene.say(f"notified {scene.clock.wait(condition, 5.0)}")
            scene.say(f"notified {scene.clock.wait(condition, 100.0)}")

    (thread,) = scene.start(wait_twice)
    scene.sleep(4.0)
    condition.notify()
    thread.join()
    assert scene.said == [(4, "notified True"), (104, "notified False")]


def test_a_deadline_in_the_past_is_not_waited_for(scene):
    assert not scene.clock.wait_until(START_NS, scene.clock.condition())
    assert scene.clock.now_ns() == START_NS


def test_a_join_with_a_time_limit_gives_up(scene):
    (thread,) = scene.start(lambda: scene.sleep(10.0))
    assert thread.is_alive()
    thread.join(3.0)
    assert thread.is_alive()
    thread.join()
    assert not thread.is_alive()
    assert scene.clock.now_ns() == START_NS + 10 * SECOND_NS


def test_the_end_unwinds_threads_that_wait_for_ever_and_those_that_have_not_begun():
    scene = Scene()
    condition = scene.clock.condition()

    def wait_for_ever():
        try:
            with condition:
                scene.clock.wait(condition)
        finally:
            scene.say("cleaned up")

    waiting = scene.start(wait_for_ever, wait_for_ever)
    scene.sleep(1.0)
    unbegun = scene.start(lambda: scene.say("never"))
    scene.clock.end()
    for thread in (*waiting, *unbegun):
        threading.Thread.join(thread, timeout=30)  # the operating system's thread has ended too
        assert not threading.Thread.is_alive(thread)
    assert scene.said == [(1, "cleaned up")] * 2


def test_a_message_with_a_delay_arrives_later_and_one_without_at_once(scene):
    network = SimulatedNetwork(scene.clock)
    run = RunSettings(id="test", directory="unused")
    sender, receiver = network.transport(run), network.transport(run)
    network.delays_ns[topics.ACTION.name] = 2 * SECOND_NS
    for topic in (topics.ACTION, topics.TIME_STEP):
        receiver.subscribe(topic, lambda payload: scene.say(payload.decode()))
        sender.publisher(topic).put(topic.name.encode())
    scene.sleep(5.0)
    assert scene.said == [(0, "timestep"), (2, "action")]
