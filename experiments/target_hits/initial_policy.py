"""The policy before any learning: tanh of N(0, 1), scaled to the action bounds (guideline 1, thesis 7.3)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from common.messages import Float32Array, TaskSpec

_DRAWN_AT_ONCE = 1024


def initial_actions(spec: TaskSpec, rng: np.random.Generator) -> Iterator[Float32Array]:
    """Yield actions (A,), physical units, without end.

    A zero-initialised last layer gives mean 0 and standard deviation 1 whatever the observation, so nothing has to be
    observed. Drawn in blocks: one draw at a time would cost more than many a task's step.
    """
    centre = (spec.action_high.astype(np.float64) + spec.action_low) / 2
    half_width = (spec.action_high.astype(np.float64) - spec.action_low) / 2
    while True:
        squashed = np.tanh(rng.standard_normal((_DRAWN_AT_ONCE, len(centre))))
        yield from (centre + half_width * squashed).astype(np.float32)
