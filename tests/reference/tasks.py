"""Small tasks and random minibatches for tests of policies and algorithms."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from common.messages import TaskSpec
from common.minibatch import Minibatch


def make_spec(frame_shape=None, frame_stack=3, crop_margin=(1, 1), action_size=2, proprioception_size=3):
    """Return a TaskSpec with uneven bounds; without camera if ``frame_shape`` is None."""
    camera = frame_shape is not None
    return TaskSpec(
        task="test_task",
        preset="demo",
        pacing="lockstep",
        algorithm_presets={"sac": "dot_reacher"},
        action_low=np.linspace(-2.0, -1.0, action_size, dtype=np.float32),
        action_high=np.linspace(1.0, 4.0, action_size, dtype=np.float32),
        proprioception_low=np.linspace(-3.0, -1.0, proprioception_size, dtype=np.float32),
        proprioception_high=np.linspace(2.0, 1.0, proprioception_size, dtype=np.float32),
        frame_shape=np.array(frame_shape if camera else (0, 0, 0), np.int64),
        frame_stack=frame_stack if camera else 0,
        crop_margin=np.array(crop_margin if camera else (0, 0), np.int64),
        action_cycle_time_s=0.04,
        world_seconds_per_cycle=0.2,
        time_limit_steps=50,
        reset_steps=10,
        has_goal=True,
    )


def make_minibatch(spec, rng, batch_size=16):
    """Return random transitions of the task, some of them terminal."""
    sizes = spec.dimensions
    top, left = spec.crop_margin
    shape = (batch_size, sizes.H - 2 * top, sizes.W - 2 * left, sizes.S * sizes.C)

    def uniform(low, high):
        return rng.uniform(low, high, (batch_size, len(low))).astype(np.float32)

    def frames():
        return rng.integers(0, 256, shape, dtype=np.uint8) if spec.has_camera else None

    return Minibatch(
        rows=2 * np.arange(batch_size),
        frames=frames(),
        proprioception=uniform(spec.proprioception_low, spec.proprioception_high),
        previous_action=uniform(spec.action_low, spec.action_high),
        action=uniform(spec.action_low, spec.action_high),
        chosen_action=uniform(spec.action_low, spec.action_high),
        log_probability=rng.normal(-1.4, 0.5, batch_size).astype(np.float32),
        reward=rng.uniform(-2.0, 0.0, batch_size).astype(np.float32),
        terminated=(rng.random(batch_size) < 0.3).astype(np.float32),
        next_frames=frames(),
        next_proprioception=uniform(spec.proprioception_low, spec.proprioception_high),
    )


def make_rollout(spec, rng, length=40):
    """Return a rollout: attempts of 1 to 7 transitions that end at the goal or without, the last one going on.

    Where one transition follows another, its observation is the other's next one.
    """
    minibatch = make_minibatch(spec, rng, length)
    arrays = {f.name: getattr(minibatch, f.name) for f in fields(minibatch)}
    arrays["terminated"] = np.zeros(length, np.float32)
    row = end = 0
    for t in range(length):
        if t == end:
            end += int(rng.integers(1, 8))
            row += 1  # the first of an attempt is no transition
        else:
            for name, before in (
                ("proprioception", "next_proprioception"),
                ("previous_action", "action"),
                ("frames", "next_frames"),
            ):
                if arrays[name] is not None:
                    arrays[name][t] = arrays[before][t - 1]
        row += 1
        arrays["rows"][t] = row
        if t == end - 1:
            arrays["terminated"][t] = rng.integers(2)
    return Minibatch(**arrays)


def make_observation(spec, rng):
    """Return a random observation of the task."""
    sizes = spec.dimensions
    from common.policies import Observation

    return Observation(
        frames=rng.integers(0, 256, (sizes.S, sizes.H, sizes.W, sizes.C), dtype=np.uint8) if spec.has_camera else None,
        proprioception=rng.uniform(spec.proprioception_low, spec.proprioception_high).astype(np.float32),
        previous_action=rng.uniform(spec.action_low, spec.action_high).astype(np.float32),
    )
