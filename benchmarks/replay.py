"""Replay: how long a minibatch takes, from drawing its transitions to cropped images, and what a transition costs."""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.comparison import Comparison, RowPlan, Side
from benchmarks.scene import recorded_experience, thesis_task
from benchmarks.side import Prepared, repeated
from benchmarks.table import Budget
from common.messages import Experience, TaskSpec
from common.minibatch import Minibatch

BATCH_SIZE = 256
TRANSITIONS = 3000
"""Half a gigabyte of stored stacks, 130 MB in the ring: far more than any cache holds, in both."""
CHECKED = 64
"""Transitions that both sides must agree on."""


def comparisons() -> list[Comparison]:
    """Time and memory; one camera frame with each step."""
    return [
        Comparison(
            sides={"ours": Side("benchmarks.replay:ours", tolerance=1e-6), "plain": Side("benchmarks.replay:plain")},
            plans=(RowPlan("sample_and_crop_256_ms", Budget(">=", 15.0), "ours", "plain"),),
            rounds=9,
        ),
        Comparison(
            sides={"ours": Side("benchmarks.replay:our_bytes"), "plain": Side("benchmarks.replay:plain_bytes")},
            plans=(RowPlan("replay_bytes_per_transition", Budget("<=", 0.2), "ours", "plain"),),
            rounds=1,
        ),
    ]


def ours(resources: ExitStack) -> Prepared:
    """Replay's sampler and the learner's gather, in a learner's process."""
    from common.cpu_tuning import tune_process

    tune_process(threads=1)
    from common.frame_ring import RingReader, crop_shape, draw_crop_offset, drop_overtaken
    from services.replay.sampler import TransitionSampler

    spec = thesis_task(camera=True)
    path = fill_ring(resources, spec, TRANSITIONS)
    reader = RingReader(path)
    resources.callback(reader.close)
    rng = np.random.default_rng(0)
    sampler, shape = TransitionSampler(rng), crop_shape(spec)

    def sample() -> Minibatch:
        rows = sampler.sample(reader, BATCH_SIZE)
        assert rows is not None
        minibatch = drop_overtaken(reader.gather(rows, shape, draw_crop_offset(spec, rng)))
        assert minibatch is not None
        return minibatch

    first, end = reader.live_rows()
    rows = np.arange(first + 1, end)
    rows = rows[reader.valid_pairs(rows)][:CHECKED]
    checked = reader.gather(rows, shape, (3, 5)).minibatch
    assert checked.frames is not None
    assert checked.next_frames is not None
    sample()
    return Prepared(
        repeated(sample, 20),
        _fingerprint(checked.frames / 255, checked.next_frames / 255, checked.action, checked.next_proprioception),
    )


def plain(resources: ExitStack) -> Prepared:
    """The stacked float path: both stacks gathered, made floats, cropped."""
    import torch

    from common.frame_ring import crop_shape

    torch.set_num_threads(1)
    spec, rng = thesis_task(camera=True), np.random.default_rng(0)
    replay = fill_plain_replay(spec, TRANSITIONS)
    height, width = crop_shape(spec)
    images, next_images, _, _, action, _, _, next_proprioception = replay.gather(
        np.arange(CHECKED), 3, 5, height, width
    )
    result = _fingerprint(
        images.permute(0, 2, 3, 1).numpy(), next_images.permute(0, 2, 3, 1).numpy(), action, next_proprioception
    )
    replay.sample(rng, BATCH_SIZE, height, width)
    return Prepared(repeated(lambda: replay.sample(rng, BATCH_SIZE, height, width), 3), result)


def our_bytes(resources: ExitStack) -> Prepared:
    """The ring's file, for a camera that brings one frame a step, per transition it holds when it is full."""
    from common.frame_ring import RingReader

    spec = thesis_task(camera=True)
    path = fill_ring(resources, spec, TRANSITIONS // 2, wrapped=True)
    reader = RingReader(path)
    resources.callback(reader.close)
    first, end = reader.live_rows()
    transitions = int(reader.valid_pairs(np.arange(first + 1, end)).sum())
    return Prepared(lambda: [path.stat().st_size / transitions])


def plain_bytes(resources: ExitStack) -> Prepared:
    """Both stacks of every transition."""
    replay = fill_plain_replay(thesis_task(camera=True), TRANSITIONS // 2)
    return Prepared(lambda: [replay.bytes / replay.count])


def fill_ring(resources: ExitStack, spec: TaskSpec, transitions: int, wrapped: bool = False) -> Path:
    """Return a ring's file that holds ``transitions``; if ``wrapped``, the last of half as many again."""
    from common.frame_ring import RING_FILE, RingWriter

    path = Path(resources.enter_context(tempfile.TemporaryDirectory())) / RING_FILE
    experiences = list(islice(recorded_experience(spec), _rows(transitions)))
    ring = RingWriter.create_or_reopen(path, spec, len(experiences), frames_per_row=1.0)
    for experience in experiences:
        ring.append(experience)
    if wrapped:
        for experience in islice(recorded_experience(spec), len(experiences), len(experiences) * 3 // 2):
            ring.append(experience)
    ring.close()
    return path


def fill_plain_replay(spec: TaskSpec, transitions: int) -> Any:
    """Return a :class:`PlainReplay` that holds the same transitions."""
    from common.frame_stack import FrameStack
    from tests.reference.plain_replay import PlainReplay

    replay = PlainReplay(spec, transitions)
    stacks: FrameStack[Any] = FrameStack(spec.frame_stack)
    before: tuple[Any, Experience] | None = None
    for experience in islice(recorded_experience(spec), _rows(transitions)):
        step = experience.time_step
        stack = stacks.add(step, step.frame_ids, list(step.pixels))
        assert stack is not None
        if before is not None and not step.is_first:
            replay.add(before[0], before[1].time_step, stack.frames, step)
        before = stack.frames, experience
    assert replay.count == transitions
    return replay


def _rows(transitions: int) -> int:
    """TimeSteps that make so many transitions: an attempt's first one ends none."""
    from benchmarks.scene import ATTEMPT_STEPS

    attempts = -(-transitions // ATTEMPT_STEPS)
    return transitions + attempts


def _fingerprint(*arrays: Any) -> list[float]:
    """A few hundred of their numbers, from everywhere."""
    flat = [np.asarray(array).reshape(-1) for array in arrays]
    return [float(value) for values in flat for value in values[:: max(1, len(values) // 199)]]
