"""SAC updates of the thesis's networks: what a learner does back to back."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.comparison import Comparison, RowPlan, Side
from benchmarks.scene import thesis_config, thesis_task
from benchmarks.side import Prepared, repeated
from benchmarks.table import Budget
from common.cpu_tuning import has_bfloat16

_TOLERANCE = {"fp32": 1e-3, "bf16": 2e-2}
"""Of the losses of one update."""
_PRECISIONS = {"fp32": "float32", "bf16": "bfloat16"}


def comparisons() -> list[Comparison]:
    """Updates with camera at two batch sizes, and without."""
    return [
        _comparison("visual_update_64", camera=True, batch_size=64, limits={"bf16": 2.5, "fp32": 1.5}, calls=4),
        _comparison("visual_update_256", camera=True, batch_size=256, limits={"bf16": 2.5, "fp32": 1.5}, calls=1),
        _comparison("state_update_256", camera=False, batch_size=256, limits={"bf16": 1.9, "fp32": 1.15}, calls=4),
    ]


def _comparison(name: str, *, camera: bool, batch_size: int, limits: dict[str, float], calls: int) -> Comparison:
    precisions = ["bf16", "fp32"] if has_bfloat16() else ["fp32"]
    options = {"camera": camera, "batch_size": batch_size, "calls": calls}
    sides = {
        precision: Side(
            "benchmarks.updates:ours", {**options, "precision": _PRECISIONS[precision]}, _TOLERANCE[precision]
        )
        for precision in precisions
    }
    return Comparison(
        sides={**sides, "plain": Side("benchmarks.updates:plain", options)},
        plans=tuple(
            RowPlan(f"{name}_{precision}_ms", Budget(">=", limits[precision]), precision, "plain")
            for precision in precisions
        ),
        rounds=9,
    )


def ours(resources: ExitStack, *, camera: bool, batch_size: int, calls: int, precision: Any) -> Prepared:
    """The learner's algorithm in the learner's process."""
    from common.cpu_tuning import tune_process

    tune_process(threads=1)
    from common.algorithms.sac import SAC

    spec, config = thesis_task(camera), thesis_config(batch_size=batch_size)
    algorithm = SAC(spec, config, seed=0, precision=precision, noise=_same_noise())
    minibatches = _minibatches(spec, batch_size)
    algorithm.update(minibatches[0])
    metrics = algorithm.metrics()
    return _prepared(algorithm.update, minibatches, calls, [metrics["critic_loss"], metrics["actor_loss"]])


def plain(resources: ExitStack, *, camera: bool, batch_size: int, calls: int) -> Prepared:
    """The reference: eager fp32, default allocator, contiguous NCHW images, separate critics."""
    import torch

    from common.algorithms.sac import SAC
    from tests.reference.plain_sac import PlainSAC

    class UnobservedPlainSAC(PlainSAC):  # type: ignore[misc]
        """Without the copies of all gradients that only the tests look at."""

        def _gradients(self, *prefixes: str) -> dict[str, Any]:
            return {}

    torch.set_num_threads(1)
    spec, config = thesis_task(camera), thesis_config(batch_size=batch_size)
    state = SAC(spec, config, seed=0, precision="float32").state_dict()
    algorithm = UnobservedPlainSAC(spec, config, state, _same_noise(), torch.float32)
    minibatches = _minibatches(spec, batch_size)
    if camera:
        # Its own replay would store its images as it wants them: the transposition is not held against it.
        minibatches = [
            replace(m, frames=_stored_nchw(m.frames), next_frames=_stored_nchw(m.next_frames)) for m in minibatches
        ]
    algorithm.update(minibatches[0])
    losses = algorithm.losses
    return _prepared(algorithm.update, minibatches, calls, [losses["critic_loss"], losses["actor_loss"]])


def _prepared(update: Any, minibatches: list[Any], calls: int, losses: list[float]) -> Prepared:
    turn = [0]

    def call() -> None:
        turn[0] += 1
        update(minibatches[turn[0] % len(minibatches)])

    call()  # the second allocation of everything: afterwards both allocators are in their steady state
    return Prepared(repeated(call, calls), losses)


def _minibatches(spec: Any, batch_size: int) -> list[Any]:
    from tests.reference.tasks import make_minibatch

    rng = np.random.default_rng(1)
    return [make_minibatch(spec, rng, batch_size) for _ in range(2)]


def _stored_nchw(frames: Any) -> Any:
    """Return the same (B, h, w, S * C) with its bytes in the order of (B, S * C, h, w)."""
    return np.ascontiguousarray(frames.transpose(0, 3, 1, 2)).transpose(0, 2, 3, 1)


def _same_noise() -> Any:
    import torch

    rng = np.random.default_rng(7)
    return lambda rows, columns: torch.from_numpy(rng.standard_normal((rows, columns), np.float32))
