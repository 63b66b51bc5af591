"""Minibatches of 44 MB from replay to learner: rows of the mapped ring, against messages over Zenoh TCP.

Ours is the services' own code in two processes, credit and all. The baseline sends the same minibatches as arrays,
each camera frame once, in messages of at most 16 MB, over bare Zenoh. A minibatch is there when the learner has it
stacked and cropped: 256 transitions whose stacks hold 1024 different frames.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from itertools import count, islice
from pathlib import Path

import numpy as np

from benchmarks import plain_zenoh
from benchmarks.comparison import Comparison, RowPlan, Side
from benchmarks.mesh import PORTS, first_service, run_in_background, second_service
from benchmarks.replay import TRANSITIONS, fill_ring
from benchmarks.scene import recorded_experience, thesis_config, thesis_task
from benchmarks.side import Prepared
from benchmarks.side_process import SideProcess
from benchmarks.table import Budget
from common.minibatch import Minibatch
from deploy.ports import reserved_ports

BATCH_SIZE = 256
MESSAGE_BYTES = 100_000_000
PREFETCH = 3
"""Minibatches asked for ahead of need, on both sides: one in use, one being gathered, one asked for. With fewer each
gather waits for its row numbers; a learner, whose updates take longer than either, does not notice."""
FIRST_S, NEXT_S = 20.0, 30.0
"""Longest time that the first minibatch, and each later one, may take."""


def comparisons() -> list[Comparison]:
    """Time from one minibatch to the next while the learner does nothing but take them."""
    return [
        Comparison(
            sides={
                "ring": Side("benchmarks.minibatches:learner"),
                "messages": Side("benchmarks.minibatches:receiver"),
            },
            plans=(RowPlan("minibatch_44_mb_ms", Budget(">=", 10.0), "ring", "messages"),),
            rounds=5,
        )
    ]


# ------------------------------------------------------------------ ours


def learner(resources: ExitStack) -> Prepared:
    """The learner's end, opposite :func:`replay`; the first experience of a new bridge earns all updates."""
    from common import topics
    from common.codec import encode
    from common.cpu_tuning import tune_process
    from common.frame_ring import RING_FILE
    from services.learner.minibatches import MappedMinibatches

    tune_process(threads=1)
    spec = thesis_task(camera=True)
    ring = fill_ring(resources, spec, TRANSITIONS)
    ports = list(resources.enter_context(reserved_ports(PORTS)))
    service = first_service(resources, topics.LEARNER, ports)
    options = {"directory": str(ring.parent), "ports": ports}
    resources.enter_context(SideProcess("benchmarks.minibatches:replay", options)).wait_until_ready()
    source = MappedMinibatches(service, spec, PREFETCH, ring.parent / RING_FILE)
    source.start()
    resources.callback(source.stop)

    # Replay gives minibatches for new experience only: two TimeSteps of a newer bridge, by a newer actor.
    publisher = service.transport.publisher(topics.EXPERIENCE)
    deadline_s, first = time.monotonic() + FIRST_S, None
    while first is None:
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"no minibatch within {FIRST_S:g} s; dropped: {source.dropped}")
        for experience in islice(recorded_experience(spec), 2):
            step = replace(experience.time_step, incarnation=service.incarnation)
            publisher.put(encode(replace(experience, actor_incarnation=service.incarnation, time_step=step)))
        first = source.get(0.5)

    def take() -> Minibatch:
        deadline_s = time.monotonic() + NEXT_S
        while (minibatch := source.get(1.0)) is None:
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"no minibatch within {NEXT_S:g} s; dropped: {source.dropped}")
        return minibatch

    return Prepared(lambda: _period_ms(take, 30), _size(first))


def replay(resources: ExitStack, *, directory: str, ports: list[int]) -> Prepared:
    """Replay's service on a ring that is full, with updates enough for everyone."""
    from common import topics
    from services.replay.config import ReplaySettings
    from services.replay.replay import Replay

    spec = thesis_task(camera=True)
    rows = _capacity(Path(directory))
    config = thesis_config(batch_size=BATCH_SIZE, min_size_to_sample=1, replay_capacity=rows, replay_ratio=1e6)
    service = second_service(resources, topics.REPLAY, ports, Path(directory))
    running = Replay(service, spec, config, ReplaySettings(max_surplus=1e6, frames_per_row=1.0))
    run_in_background(resources, service, running.run)
    return Prepared(lambda: [])


# ------------------------------------------------------------------ the baseline


def receiver(resources: ExitStack) -> Prepared:
    """A learner that asks for messages, ahead of need, and makes minibatches of them on a thread of its own."""
    from common.codec import decode
    from common.cpu_tuning import tune_process
    from common.frame_ring import crop_shape, draw_crop_offset, minibatch_from_arrays
    from common.messages import ArrayMinibatch

    tune_process(threads=1)
    spec, rng = thesis_task(camera=True), np.random.default_rng(0)
    ring = fill_ring(resources, spec, TRANSITIONS)
    port = resources.enter_context(reserved_ports(1))[0]
    session = plain_zenoh.open_session(resources, listen=port)
    payloads: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    ready: queue.SimpleQueue[Minibatch] = queue.SimpleQueue()
    plain_zenoh.subscriber(session, "bench/minibatch", payloads.put)
    asking = plain_zenoh.waiting_publisher(session, "bench/ask")

    def assemble() -> None:
        while True:
            parts = [decode(payloads.get(), ArrayMinibatch, spec.dimensions)]
            while len(parts) < parts[0].parts:
                parts.append(decode(payloads.get(), ArrayMinibatch, spec.dimensions))
            ready.put(minibatch_from_arrays(parts, crop_shape(spec), draw_crop_offset(spec, rng)))

    def take() -> Minibatch:
        minibatch = ready.get(timeout=NEXT_S)
        asking.put(b"one more")
        return minibatch

    threading.Thread(target=assemble, daemon=True).start()
    options = {"ring": str(ring), "port": port}
    resources.enter_context(SideProcess("benchmarks.minibatches:sender", options)).wait_until_ready()
    plain_zenoh.wait_until_heard(asking)
    for _ in range(PREFETCH):
        asking.put(b"one more")
    return Prepared(lambda: _period_ms(take, 6), _size(take()))


def sender(resources: ExitStack, *, ring: str, port: int) -> Prepared:
    """A replay that answers each request with a minibatch's messages."""
    from common.codec import encode
    from common.frame_ring import RingReader, array_minibatch
    from services.replay.sampler import TransitionSampler

    reader = RingReader(ring)
    resources.callback(reader.close)
    sampler = TransitionSampler(np.random.default_rng(0))
    session = plain_zenoh.open_session(resources, connect=port)
    publisher = plain_zenoh.waiting_publisher(session, "bench/minibatch")
    asked: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    plain_zenoh.subscriber(session, "bench/ask", asked.put)

    def answer() -> None:
        for ordinal in count():
            asked.get()
            rows = sampler.sample(reader, BATCH_SIZE)
            assert rows is not None
            for part in array_minibatch(reader, rows, 0, ordinal, max_bytes=MESSAGE_BYTES):
                publisher.put(encode(part))

    threading.Thread(target=answer, daemon=True).start()
    return Prepared(lambda: [])


# ------------------------------------------------------------------ both


def _period_ms(take: Callable[[], Minibatch], number: int) -> list[float]:
    for _ in range(PREFETCH):  # they were waiting
        take()
    begun = time.perf_counter()
    for _ in range(number):
        take()
    return [(time.perf_counter() - begun) / number * 1e3]


def _size(minibatch: Minibatch) -> list[float]:
    """Transitions and bytes of images: what both sides must agree on."""
    sizes = [float(len(minibatch.reward))]
    for frames in (minibatch.frames, minibatch.next_frames):
        assert isinstance(frames, np.ndarray)
        sizes.append(float(frames.nbytes))
    return sizes


def _capacity(directory: Path) -> int:
    from common.frame_ring import RING_FILE, RingReader

    reader = RingReader(directory / RING_FILE)
    rows = reader.layout.capacity_rows
    reader.close()
    return rows
