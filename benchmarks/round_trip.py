"""Observation -> action between two processes on this computer, 25 times a second.

Ours is everything but the policy's computation: the bridge's message is built, encoded, retained and published; the
real actor receives, checks and decodes it, rebuilds the stack, answers with a constant action and publishes the
experience as well; the bridge receives, checks and decodes the answer. The baseline is bare Zenoh with the same
settings: the same number of bytes there, the same number back.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from itertools import count, islice
from typing import Any, TypeVar

import numpy as np

from benchmarks import plain_zenoh
from benchmarks.comparison import Comparison, RowPlan, Side
from benchmarks.mesh import PORTS, first_service, run_in_background, second_service
from benchmarks.scene import recorded_experience, thesis_task
from benchmarks.side import Prepared
from benchmarks.side_process import SideProcess
from benchmarks.table import Budget
from common.messages import Action, TaskSpec, TimeStep
from deploy.ports import reserved_ports

HZ = 25
TRIPS = 75
"""In a round: three seconds."""
WARM_UP_TRIPS = 50
Observed = TypeVar("Observed")
ANSWER_S = 5.0
"""Longest time that an answer may take."""


def comparisons() -> list[Comparison]:
    """The p50 against the echo's, and as it is."""
    return [
        Comparison(
            sides={"ours": Side("benchmarks.round_trip:ours"), "echo": Side("benchmarks.round_trip:echo")},
            plans=(
                RowPlan("round_trip_p50_ms", Budget("<=", 1.6), "ours", "echo"),
                RowPlan("round_trip_p50_absolute_ms", Budget("<", 2.0, "ms"), "ours"),
            ),
            rounds=7,
        )
    ]


# ------------------------------------------------------------------ ours


def ours(resources: ExitStack) -> Prepared:
    """The bridge's side of the services' code, opposite the actor."""
    from common import topics
    from common.codec import encode
    from common.inbox import Inbox
    from common.journal import JournalSender
    from common.priority import BRIDGE_PRIORITY, run_before_others
    from common.run_settings import JournalSettings

    spec = thesis_task(camera=True)
    ports = list(resources.enter_context(reserved_ports(PORTS)))
    service = first_service(resources, topics.ROBOT_BRIDGE, ports)
    journal = JournalSender(
        service.transport,
        service.incarnation,
        JournalSettings(),
        topic=topics.TIME_STEP,
        resent=topics.TIME_STEP_RESENT,
        head=topics.TIME_STEP_HEAD,
        acknowledgement=topics.TIME_STEP_ACK,
        clock=service.clock,
    )
    actions: Inbox[Action] = Inbox(
        service.transport,
        topics.ACTION,
        Action,
        service.wake,
        service.clock,
        service.refusals,
        dimensions=spec.dimensions,
    )
    experiences: list[int] = []
    # Replay's part: without a subscriber the second publication would cost nothing.
    service.transport.subscribe(topics.EXPERIENCE, lambda payload: experiences.append(len(payload)))
    resources.enter_context(SideProcess("benchmarks.round_trip:actor", {"ports": ports})).wait_until_ready()
    _until(lambda: service.peer_state(topics.ACTOR) == "running", "the actor's status")
    run_before_others(BRIDGE_PRIORITY)
    journal.start()
    resources.callback(journal.stop)
    observed = [experience.time_step for experience in islice(recorded_experience(spec), 1, 33)]
    numbers = count()

    def observe() -> dict[str, Any]:
        seq = next(numbers)
        return new_observation(observed[seq % len(observed)], seq, service.incarnation, service.clock.now_ns())

    def trip(observation: dict[str, Any]) -> None:
        seq = observation["seq"]
        journal.put(seq, encode(TimeStep(**observation)))
        deadline_ns = service.clock.now_ns() + round(ANSWER_S * 1e9)
        with service.wake:  # as the bridge waits
            while not actions:
                if not service.clock.wait_until(deadline_ns, service.wake):
                    raise TimeoutError(f"TimeStep {seq}: no action within {ANSWER_S:g} s")
        answer = actions.take()[-1].message
        if answer.answered_seq != seq:
            raise RuntimeError(f"expected an answer to TimeStep {seq}, got one to {answer.answered_seq}")

    def measure() -> list[float]:
        wanted = len(experiences) + TRIPS
        durations = _paced(observe, trip, TRIPS)
        _until(lambda: len(experiences) >= wanted, "the last experience")
        return durations

    _paced(observe, trip, WARM_UP_TRIPS)
    _until(lambda: len(experiences) == WARM_UP_TRIPS, "the warm-up's experience")
    return Prepared(measure)


def actor(resources: ExitStack, *, ports: list[int]) -> Prepared:
    """The actor's service with a constant policy."""
    from common import topics
    from common.policies.base import ChosenAction, Observation
    from common.priority import ACTOR_PRIORITY, run_before_others
    from services.actor.actor import Actor
    from services.actor.config import ActorSettings

    spec = thesis_task(camera=True)
    chosen = ChosenAction(np.full(spec.dimensions.A, 0.25, np.float32), -1.5)

    class ConstantPolicy:
        """Answers at once."""

        version = 0

        def act(self, observation: Observation, rng: Any, deterministic: bool = False) -> ChosenAction:
            return chosen

    service = second_service(resources, topics.ACTOR, ports)
    running = Actor(service, spec, ConstantPolicy(), ActorSettings())
    run_before_others(ACTOR_PRIORITY)
    run_in_background(resources, service, running.run)
    return Prepared(lambda: [])


def new_observation(observed: TimeStep, seq: int, incarnation: int, now_ns: int) -> dict[str, Any]:
    """Return the fields of TimeStep ``seq`` of an attempt that never ends; its contents are those of ``observed``."""
    new = {
        "incarnation": incarnation,
        "seq": seq,
        "episode": 0,
        "attempt": 0,
        "step_index": seq,
        "published_ns": now_ns,
        "frame_ids": np.array([seq], np.int64),
        "frame_capture_ns": np.array([now_ns], np.int64),
        "answered_seq": seq - 1,
        "steps": seq,
        "acted_steps": seq,
    }
    return {**vars(observed), **new}


# ------------------------------------------------------------------ the baseline


def echo(resources: ExitStack) -> Prepared:
    """Bare Zenoh: put bytes, wait for the answer's bytes."""
    from common.priority import BRIDGE_PRIORITY, run_before_others

    there_bytes, back_bytes = message_sizes(thesis_task(camera=True))
    port = resources.enter_context(reserved_ports(1))[0]
    session = plain_zenoh.open_session(resources, listen=port)
    answered = threading.Event()
    publisher = plain_zenoh.urgent_publisher(session, "bench/there")
    subscriber = plain_zenoh.subscriber(session, "bench/back", lambda payload: answered.set())
    options = {"port": port, "back_bytes": back_bytes}
    resources.enter_context(SideProcess("benchmarks.round_trip:echoing", options)).wait_until_ready()
    run_before_others(BRIDGE_PRIORITY)
    payload = np.random.default_rng(0).bytes(there_bytes)

    def trip(payload: bytes) -> None:
        answered.clear()
        publisher.put(payload)
        if not answered.wait(ANSWER_S):
            raise TimeoutError(f"no echo within {ANSWER_S:g} s")

    plain_zenoh.wait_until_heard(publisher)
    _paced(lambda: payload, trip, WARM_UP_TRIPS)
    resources.callback(subscriber.undeclare)
    return Prepared(lambda: _paced(lambda: payload, trip, TRIPS))


def echoing(resources: ExitStack, *, port: int, back_bytes: int) -> Prepared:
    """The other end: answers from the receiving thread."""
    from common.priority import ACTOR_PRIORITY, run_before_others

    session = plain_zenoh.open_session(resources, connect=port)
    publisher = plain_zenoh.urgent_publisher(session, "bench/back")
    answer = np.random.default_rng(0).bytes(back_bytes)
    subscriber = plain_zenoh.subscriber(session, "bench/there", lambda payload: publisher.put(answer))
    resources.callback(subscriber.undeclare)
    run_before_others(ACTOR_PRIORITY)
    return Prepared(lambda: [])


def message_sizes(spec: TaskSpec) -> tuple[int, int]:
    """Return the bytes of a TimeStep with one frame and of the Action that answers it."""
    from common.codec import encode

    observed = next(islice(recorded_experience(spec), 1, None)).time_step
    now_ns, incarnation, seq = time.monotonic_ns(), time.time_ns(), 200
    action = Action(incarnation, incarnation, seq, observed.action, -1.5, 0, now_ns, now_ns, now_ns, 0, -1)
    time_step = TimeStep(**new_observation(observed, seq, incarnation, now_ns))
    return len(encode(time_step)), len(encode(action))


def _until(holds: Callable[[], bool], what: str) -> None:
    deadline_s = time.monotonic() + ANSWER_S
    while not holds():
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"{what} did not come within {ANSWER_S:g} s")
        time.sleep(0.01)


def _paced(observe: Callable[[], Observed], trip: Callable[[Observed], None], trips: int) -> list[float]:
    """Durations of ``trips`` at :data:`HZ`, ms, from the moment there is an observation."""
    durations, begun = [], time.perf_counter()
    for number in range(1, trips + 1):
        time.sleep(max(0.0, begun + number / HZ - time.perf_counter()))
        observation = observe()
        left = time.perf_counter()
        trip(observation)
        durations.append((time.perf_counter() - left) * 1e3)
    return durations
