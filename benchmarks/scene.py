"""What the benchmarks have in common: a task of the thesis's size and data for it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np

from common.algorithms.sac_config import SAC_PRESETS, SACConfig
from common.messages import ActionSource, Experience, Float32Array, TaskSpec, TimeStep, UInt8Array
from common.policies.weights import initial_parameters

ACTIONS, PROPRIOCEPTION = 5, 10
"""Of UR5-VisualReacher (thesis 4.3.1): joint velocities; joint angles and velocities."""
HEIGHT, WIDTH, STACK = 90, 160, 3
ATTEMPT_STEPS = 150
"""Action cycles in an attempt: 6 s of 40 ms."""
BRIDGE = 1
"""Incarnation of the bridge whose TimeSteps these are."""


def thesis_task(camera: bool) -> TaskSpec:
    """Return a task of UR5-VisualReacher's sizes, with its camera or without."""
    shape = (HEIGHT, WIDTH, 3) if camera else (0, 0, 0)
    return TaskSpec(
        task="benchmark",
        preset="thesis",
        pacing="realtime",
        algorithm_presets={"sac": "ur5"},
        action_low=np.full(ACTIONS, -0.7, np.float32),
        action_high=np.full(ACTIONS, 0.7, np.float32),
        proprioception_low=np.full(PROPRIOCEPTION, -3.0, np.float32),
        proprioception_high=np.full(PROPRIOCEPTION, 3.0, np.float32),
        frame_shape=np.array(shape, np.int64),
        frame_stack=STACK if camera else 0,
        crop_margin=np.array([HEIGHT // 10, WIDTH // 10] if camera else [0, 0], np.int64),
        action_cycle_time_s=0.04,
        world_seconds_per_cycle=0.04,
        time_limit_steps=ATTEMPT_STEPS,
        reset_steps=70,
        has_goal=True,
    )


def thesis_config(**changes: Any) -> SACConfig:
    """Return the algorithm's settings of that task: networks 1024 wide."""
    return replace(SAC_PRESETS["ur5"], **changes)


def trained_parameters(spec: TaskSpec, config: SACConfig) -> dict[str, Float32Array]:
    """Return a policy's parameters whose last layer is not zero, so that what it computes shows in its actions."""
    rng = np.random.default_rng(0)
    parameters = initial_parameters(spec, config.hidden_size, config.encoder_strides, rng)
    last = parameters["actor.2.weight"]
    parameters["actor.2.weight"] = rng.normal(0.0, 0.05, last.shape).astype(np.float32)
    return parameters


def recorded_experience(spec: TaskSpec, seed: int = 0) -> Iterator[Experience]:
    """Yield experience without end: attempts of :data:`ATTEMPT_STEPS`, one new frame of noise with each TimeStep."""
    rng, sizes = np.random.default_rng(seed), spec.dimensions
    for seq in count():
        attempt, index = divmod(seq, ATTEMPT_STEPS + 1)
        frames: UInt8Array = rng.integers(0, 256, (1, sizes.H, sizes.W, sizes.C), np.uint8)
        yield Experience(
            actor_incarnation=1,
            seq=seq,
            time_step=TimeStep(
                incarnation=BRIDGE,
                seq=seq,
                episode=attempt,
                attempt=attempt,
                step_index=index,
                published_ns=40_000_000 * seq,
                frame_ids=np.array([seq], np.int64),
                frame_capture_ns=np.array([40_000_000 * seq], np.int64),
                frames=frames,
                proprioception=rng.uniform(spec.proprioception_low, spec.proprioception_high).astype(np.float32),
                action=np.zeros(sizes.A, np.float32)
                if index == 0
                else rng.uniform(spec.action_low, spec.action_high).astype(np.float32),
                action_source=ActionSource.NONE if index == 0 else ActionSource.POLICY,
                answered_seq=seq - 1 if index else -1,
                action_applied_ns=40_000_000 * seq if index else 0,
                reward=-1.0 if index else 0.0,
                terminated=False,
                truncated=index == ATTEMPT_STEPS,
                steps=seq,
                acted_steps=seq,
            ),
            extras=None,
        )
