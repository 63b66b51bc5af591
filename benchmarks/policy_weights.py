"""A policy on its way from learner to actor: its bytes, and the time to make them and to act on them.

The baseline pickles what most code pushes: the state dictionaries of encoder, actor and both critics. On each side
the learner serialises in one process and the actor applies in another, as they do in a run; only ours have their
allocators tuned, as they do in a run.
"""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.comparison import Comparison, RowPlan, Side
from benchmarks.scene import thesis_config, thesis_task, trained_parameters
from benchmarks.side import Prepared, repeated
from benchmarks.side_process import SideProcess
from benchmarks.table import Budget

CALLS = 20
_TRAINED = "actor.2.weight"
"""The layer that would be zero before any learning."""
_MODULES = ("encoder", "actor", "critics")


def comparisons() -> list[Comparison]:
    """Bytes and time, of a policy with camera."""
    ours, plain = "benchmarks.policy_weights:our_learner", "benchmarks.policy_weights:plain_learner"
    return [
        Comparison(
            sides={"ours": Side(ours, {"what": "bytes"}), "plain": Side(plain, {"what": "bytes"})},
            plans=(RowPlan("policy_bytes", Budget("<=", 0.35), "ours", "plain"),),
            rounds=1,
        ),
        Comparison(
            sides={"ours": Side(ours, {"what": "time"}), "plain": Side(plain, {"what": "time"})},
            plans=(RowPlan("policy_serialise_and_apply_ms", Budget(">=", 20.0), "ours", "plain"),),
            rounds=15,
        ),
    ]


def our_learner(resources: ExitStack, *, what: str) -> Prepared:
    """The message that the learner pushes."""
    from common.algorithms.sac import SAC
    from common.cpu_tuning import tune_process

    tune_process(threads=1)
    spec, config = thesis_task(camera=True), thesis_config()
    algorithm = SAC(spec, config, seed=0, precision="float32")
    algorithm.load_state_dict(_trained(algorithm.state_dict()))
    return _with_actor(
        resources,
        "benchmarks.policy_weights:our_actor",
        lambda: algorithm.encoded_policy(1, config.weights_dtype),
        what,
    )


def our_actor(resources: ExitStack, *, path: str) -> Prepared:
    """The policy that the actor makes of the message."""
    import torch

    from common.codec import decode
    from common.cpu_tuning import keep_freed_memory
    from common.messages import PolicyWeights
    from common.policies import Policy, policy_from_weights

    keep_freed_memory()
    torch.set_num_threads(1)
    spec, payload = thesis_task(camera=True), Path(path).read_bytes()

    def apply() -> Policy:
        return policy_from_weights(spec, decode(payload, PolicyWeights, spec.dimensions))

    chosen = apply().act(_observation(spec), np.random.default_rng(0), deterministic=True)
    return Prepared(repeated(apply, CALLS), chosen.action.tolist())


def plain_learner(resources: ExitStack, *, what: str) -> Prepared:
    """Pickled state dictionaries."""
    import torch

    torch.set_num_threads(1)
    learner = _plain_networks(seed=0)
    return _with_actor(
        resources,
        "benchmarks.policy_weights:plain_actor",
        lambda: pickle.dumps({name: getattr(learner, name).state_dict() for name in _MODULES}),
        what,
    )


def plain_actor(resources: ExitStack, *, path: str) -> Prepared:
    """Networks that the pickled ones are loaded into."""
    import torch

    from tests.reference.plain_policy import PlainPolicy

    torch.set_num_threads(1)
    spec, config, payload = thesis_task(camera=True), thesis_config(), Path(path).read_bytes()
    actor = _plain_networks(seed=1)

    def apply() -> None:
        for name, values in pickle.loads(payload).items():
            getattr(actor, name).load_state_dict(values)

    apply()
    parameters = {name: parameter.detach().numpy() for name, parameter in actor.named_parameters().items()}
    parameters["log_std_bounds"] = np.array([config.log_std_low, config.log_std_high])
    policy = PlainPolicy(spec, parameters, config.encoder_strides, config.hidden_size)
    action, _ = policy.act(_observation(spec), deterministic=True)
    return Prepared(repeated(apply, CALLS), action.tolist())


def _with_actor(resources: ExitStack, function: str, serialise: Callable[[], bytes], what: str) -> Prepared:
    """Measure this process's ``serialise`` and what the other process, ``function``, does with the bytes."""
    path = Path(resources.enter_context(tempfile.TemporaryDirectory())) / "policy"
    path.write_bytes(serialise())
    actor = resources.enter_context(SideProcess(function, {"path": str(path)}))
    actor.wait_until_ready()
    if what == "bytes":
        return Prepared(lambda: [float(len(serialise()))], actor.result)
    here = repeated(serialise, CALLS)

    def measure() -> list[float]:
        return [there + back for there, back in zip(here(), actor.measure(), strict=True)]

    measure()
    return Prepared(measure, actor.result)


def _plain_networks(seed: int) -> Any:
    import torch

    from common.algorithms.sac import SAC
    from tests.reference.plain_sac import PlainSAC

    spec, config = thesis_task(camera=True), thesis_config()
    state = SAC(spec, config, seed=seed, precision="float32").state_dict()
    return PlainSAC(spec, config, _trained(state) if seed == 0 else state, None, torch.float32)


def _trained(state: dict[str, Any]) -> dict[str, Any]:
    return {**state, _TRAINED: trained_parameters(thesis_task(camera=True), thesis_config())[_TRAINED]}


def _observation(spec: Any) -> Any:
    from tests.reference.tasks import make_observation

    return make_observation(spec, np.random.default_rng(2))
