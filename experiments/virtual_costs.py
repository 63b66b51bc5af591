"""How long an action and an update take in virtual time.

Of a computer that ``--host-budget`` names, its file says it: an update takes as long as the action cycles that it may
have one in. Of this one, it is measured, once: the results are kept in the user's cache folder, because a run that is
to be the same every time cannot measure its own times. Each run's record has them, in ``config/actor.toml``
(``min_inference_s``) and ``config/learner.toml`` (``min_update_s``); ``--set`` gives them to a run elsewhere.
"""

from __future__ import annotations

import fcntl
import json
import math
import os
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from common.algorithms import load_algorithm
from common.algorithms.presets import resolve_config, setting_names
from common.frame_ring import crop_shape
from common.messages import TaskSpec
from common.minibatch import Minibatch
from common.pending_actions import observed_spec
from common.policies import Observation, initial_policy
from common.record import write_atomically
from common.topics import ACTOR, LEARNER, ROBOT_BRIDGE
from deploy.hosts import Host
from services.robot_bridge.tasks import load_task

_CALLS = 20
"""Measured calls; the fastest counts: nothing else computed meanwhile."""
_WARM_UP_CALLS = 3


@dataclass(frozen=True)
class ComputingTimes:
    """What one computer takes for one algorithm on one task."""

    inference_s: float
    """From an observation to its action, seconds."""
    update_s: float
    """One update, seconds."""


def with_computing_times(configurations: Mapping[str, Any], host: Host | None) -> dict[str, Any]:
    """Return the configurations with the times that are not set in them.

    Args:
        configurations: service -> configuration.
        host: the learner's computer; None: this one.
    """
    actor, learner = configurations[ACTOR], configurations[LEARNER]
    inference_s, update_s = actor.actor.min_inference_s, learner.learner.min_update_s
    if not (inference_s and update_s):
        spec = _task_spec(configurations)
        # How often a computer updates is said of algorithms that replay experience; the others' are measured here.
        if host and not update_s and "replay_ratio" in setting_names(learner.algorithm.name):
            update_s = spec.action_cycle_time_s / host.updates_per_step
        if not (inference_s and update_s):
            measured = _measured_once(spec, learner)
            inference_s, update_s = inference_s or measured.inference_s, update_s or measured.update_s
    return {
        **configurations,
        ACTOR: replace(actor, actor=replace(actor.actor, min_inference_s=inference_s)),
        LEARNER: replace(learner, learner=replace(learner.learner, min_update_s=update_s)),
    }


def measure(spec: TaskSpec, learner: Any) -> ComputingTimes:
    """Measure this computer.

    Args:
        spec: the task.
        learner: the learner's configuration.
    """
    from common.cpu_tuning import tune_process

    settings, name = learner.learner, learner.algorithm.name
    tune_process(settings.threads or None)
    config = resolve_config(
        name, learner.algorithm.preset or spec.algorithm_presets.get(name, ""), learner.algorithm.overrides
    )
    spec = observed_spec(spec, config.pending_actions)
    rng = np.random.default_rng(0)
    policy = initial_policy(spec, config.hidden_size, config.encoder_strides, 0, zero_initialised_head=False)
    observation = _observation(spec, rng)
    algorithm = load_algorithm(name)(spec, config, seed=0, device=settings.device, precision=settings.precision)
    # An on-policy algorithm learns from a whole rollout at once.
    minibatch = _minibatch(spec, rng, getattr(config, "rollout_length", config.batch_size))
    return ComputingTimes(
        inference_s=_fastest_s(lambda: policy.act(observation, rng)),
        update_s=_fastest_s(lambda: algorithm.update(minibatch)),
    )


def _measured_once(spec: TaskSpec, learner: Any) -> ComputingTimes:
    """Measure, or return what an earlier call has measured on this computer, also one that is measuring now."""
    path, key = _cache_path(), _key(spec, learner)
    if times := _known_times(path).get(key):
        return times
    path.parent.mkdir(parents=True, exist_ok=True)
    # Who comes meanwhile waits: two measurements would be two results, and each would disturb the other.
    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        known = _known_times(path)
        if key not in known:
            known[key] = measure(spec, learner)
            table = {name: asdict(times) for name, times in known.items()}
            write_atomically(path, json.dumps(table, indent=1, sort_keys=True) + "\n")
        return known[key]


def _known_times(path: Path) -> dict[str, ComputingTimes]:
    """What has been measured so far; what cannot be understood of it is left out, and measured again."""
    try:
        table = dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):  # There is none yet, or none that can be used.
        return {}
    names = {field.name for field in fields(ComputingTimes)}
    return {
        key: ComputingTimes(**times)
        for key, times in table.items()
        if isinstance(times, dict) and times.keys() == names and all(map(_is_duration, times.values()))
    }


def _is_duration(value: object) -> bool:
    return isinstance(value, float) and math.isfinite(value) and value > 0


def _cache_path() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "relod" / "computing_times.json"


def _key(spec: TaskSpec, learner: Any) -> str:
    """What the times depend on."""
    settings, algorithm = learner.learner, learner.algorithm
    facts = (
        platform.node(),
        spec.task,
        spec.preset,
        *(algorithm.name, algorithm.preset, sorted(algorithm.overrides.items())),
        *(settings.device, settings.threads, settings.precision),
    )
    return " ".join(str(fact) for fact in facts)


def _task_spec(configurations: Mapping[str, Any]) -> TaskSpec:
    bridge = configurations[ROBOT_BRIDGE]
    task = load_task(
        bridge.task.name,
        bridge.task.preset,
        bridge.task.overrides,
        bridge.tasks.rows,
        pacing="realtime",
        rng=np.random.default_rng(0),
    )
    try:
        return task.spec
    finally:
        task.close()


def _observation(spec: TaskSpec, rng: np.random.Generator) -> Observation:
    size = spec.dimensions
    frames = rng.integers(0, 256, (size.S, size.H, size.W, size.C), np.uint8) if spec.has_camera else None
    return Observation(frames, np.zeros(size.P, np.float32), np.zeros(size.A, np.float32))


def _minibatch(spec: TaskSpec, rng: np.random.Generator, rows: int) -> Minibatch:
    size = spec.dimensions

    def frames() -> Any:
        if not spec.has_camera:
            return None
        height, width = crop_shape(spec)
        return rng.integers(0, 256, (rows, height, width, size.S * size.C), np.uint8)

    def vectors(length: int) -> Any:
        return rng.uniform(-1.0, 1.0, (rows, length)).astype(np.float32)

    values = {
        "rows": np.arange(rows),
        "frames": frames(),
        "proprioception": vectors(size.P),
        "previous_action": vectors(size.A),
        "action": vectors(size.A),
        "chosen_action": vectors(size.A),
        "log_probability": -np.ones(rows, np.float32),
        "reward": -np.ones(rows, np.float32),
        "terminated": np.zeros(rows, np.float32),
        "next_frames": frames(),
        "next_proprioception": vectors(size.P),
    }
    return Minibatch(**{field.name: values[field.name] for field in fields(Minibatch)})


def _fastest_s(work: Callable[[], object]) -> float:
    for _ in range(_WARM_UP_CALLS):
        work()
    durations = []
    for _ in range(_CALLS):
        begun_s = time.perf_counter()
        work()
        durations.append(time.perf_counter() - begun_s)
    return min(durations)
