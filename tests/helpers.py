"""Messages with sensible contents, outputs that cannot be used, and waiting for what another thread brings about."""

from __future__ import annotations

import contextlib
import itertools
import os
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, TextIO

import numpy as np

from common.messages import ActionSource, Experience, PolicyExtras, TaskSpec, TimeStep
from common.run_settings import RunSettings
from tests.reference import tasks

TIMEOUT_S = 30.0
"""How long a test waits for another thread before it fails; never how long it takes."""
_PORTS = itertools.islice(itertools.cycle(range(20_000, 32_000)), 7 * os.getpid() % 12_000, None)
"""Below those that the system gives to connections: one of them could take the port in between."""


def make_spec(camera: bool = True, **changes: Any) -> TaskSpec:
    """Return a task with 2 actions, 5 proprioceptions and a camera of 6 x 8 x 3, 4 frames stacked: all sizes differ."""
    spec = tasks.make_spec((6, 8, 3) if camera else None, frame_stack=4, action_size=2, proprioception_size=5)
    return replace(spec, **changes)


def make_time_step(seq: int = 1, spec: TaskSpec | None = None, **changes: Any) -> TimeStep:
    """Return TimeStep ``seq`` of an attempt that began at 0, with one new frame whose pixels are its id."""
    sizes = (spec or make_spec()).dimensions
    ids = [seq] if sizes.S else []
    first = seq == 0
    step = TimeStep(
        incarnation=1,
        seq=seq,
        episode=0,
        attempt=0,
        step_index=seq,
        published_ns=1_000_000 * seq,
        frame_ids=np.array(ids, np.int64),
        frame_capture_ns=np.array([1_000_000 * i for i in ids], np.int64),
        frames=np.full((len(ids), sizes.H, sizes.W, sizes.C), seq % 256, np.uint8),
        proprioception=np.full(sizes.P, seq, np.float32),
        action=np.full(sizes.A, 0.0 if first else 0.5, np.float32),
        action_source=ActionSource.NONE if first else ActionSource.POLICY,
        answered_seq=-1 if first else seq - 1,
        action_applied_ns=0 if first else 1_000_000 * seq - 500_000,
        reward=0.0 if first else -1.0,
        terminated=False,
        truncated=False,
        steps=seq,
        acted_steps=seq,
    )
    return replace(step, **changes)


def make_experience(
    seq: int = 1, spec: TaskSpec | None = None, time_step: TimeStep | None = None, **changes: Any
) -> Experience:
    """Return Experience ``seq`` with TimeStep ``seq``, or the one given; extras where an action led into it."""
    step = time_step or make_time_step(seq, spec)
    extras = None if step.is_first else PolicyExtras(step.action * 2, log_probability=-1.5, policy_version=7)
    return replace(Experience(actor_incarnation=2, seq=seq, time_step=step, extras=extras), **changes)


def make_run(directory: object = "unused", run: str = "test", robot: str = "robot0", seed: int = 0) -> RunSettings:
    """Return the settings of a run."""
    return RunSettings(id=run, directory=str(directory), robot=robot, seed=seed)


def free_port() -> int:
    """Return a TCP port that nobody listens on at 127.0.0.1, each only once."""
    for port in _PORTS:
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(("127.0.0.1", port))
            return port
    raise AssertionError("there is no free port")


def eventually(holds: Callable[[], object], what: str = "it") -> None:
    """Wait until ``holds()``, which another thread brings about; fail if it never does."""
    deadline = time.monotonic() + TIMEOUT_S
    while not holds():
        assert time.monotonic() < deadline, f"{what} never came about"
        time.sleep(0.002)


@contextlib.contextmanager
def unusable_output(what: str) -> Iterator[TextIO]:
    """An output, written line by line, whose device is ``full`` or whose reader has ``closed`` it."""
    if what == "full":
        descriptor = os.open("/dev/full", os.O_WRONLY)
    else:
        reading, descriptor = os.pipe()
        os.close(reading)
    with os.fdopen(descriptor, "w", buffering=1, encoding="utf-8") as output:
        yield output
