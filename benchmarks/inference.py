"""One action from one observation: what an actor does once per action cycle."""

from __future__ import annotations

from contextlib import ExitStack
from itertools import cycle

import numpy as np

from benchmarks.comparison import Comparison, RowPlan, Side
from benchmarks.scene import thesis_config, thesis_task, trained_parameters
from benchmarks.side import Prepared, repeated
from benchmarks.table import Budget

_US = 1e-6


def comparisons() -> list[Comparison]:
    """The whole way from an observation to an action and its log-probability, with camera and without."""
    return [
        _comparison("inference_state_p50_us", camera=False, limit=4.0, calls=400),
        _comparison("inference_visual_p50_us", camera=True, limit=1.7, calls=100),
    ]


def _comparison(name: str, *, camera: bool, limit: float, calls: int) -> Comparison:
    options = {"camera": camera, "calls": calls}
    return Comparison(
        sides={
            "ours": Side("benchmarks.inference:ours", options),
            "plain": Side("benchmarks.inference:plain", options),
        },
        plans=(RowPlan(name, Budget(">=", limit), "ours", "plain"),),
        rounds=15,
    )


def ours(resources: ExitStack, *, camera: bool, calls: int) -> Prepared:
    """The actor's policy, made from a message as a learner pushes it."""
    from common.policies import pack_weights, policy_from_weights
    from tests.reference.tasks import make_observation

    if camera:
        import torch

        torch.set_num_threads(1)
    spec, config = thesis_task(camera), thesis_config()
    strides = config.encoder_strides if camera else ()
    weights = pack_weights(
        trained_parameters(spec, config),
        version=1,
        updates=1,
        algorithm="sac",
        hidden_size=config.hidden_size,
        encoder_strides=strides,
        dtype="float32",
    )
    policy = policy_from_weights(spec, weights)
    rng = np.random.default_rng(1)
    observations = [make_observation(spec, rng) for _ in range(8)]
    result = [policy.act(observation, rng, deterministic=True) for observation in observations]
    turn = cycle(observations)
    measure = repeated(lambda: policy.act(next(turn), rng), calls, _US)
    measure()
    return Prepared(measure, [float(value) for chosen in result for value in chosen.action])


def plain(resources: ExitStack, *, camera: bool, calls: int) -> Prepared:
    """The reference: everything in torch, distributions and all, without gradients."""
    import torch

    from tests.reference.plain_policy import PlainPolicy
    from tests.reference.tasks import make_observation

    torch.set_num_threads(1)
    spec, config = thesis_task(camera), thesis_config()
    policy = PlainPolicy(spec, trained_parameters(spec, config), config.encoder_strides, config.hidden_size)
    rng = np.random.default_rng(1)
    observations = [make_observation(spec, rng) for _ in range(8)]
    result = [policy.act(observation, deterministic=True) for observation in observations]
    turn = cycle(observations)
    measure = repeated(lambda: policy.act(next(turn)), calls, _US)
    measure()
    return Prepared(measure, [float(value) for action, _ in result for value in action])
