"""A simulated robot with a camera: how many steps a second, image included."""

from __future__ import annotations

import time
from contextlib import ExitStack

import numpy as np

from benchmarks.comparison import Comparison, RowPlan, Side
from benchmarks.side import Prepared, UnavailableError
from benchmarks.table import Budget

TASK = "reacher_easy_visual"
STEPS = 500


def comparisons() -> list[Comparison]:
    """An absolute budget: the thesis's studies need hundreds of thousands of steps."""
    return [
        Comparison(
            sides={"ours": Side("benchmarks.rendering:ours")},
            plans=(RowPlan("reacher_step_and_render_per_s", Budget(">=", 500.0, "/s"), "ours"),),
            rounds=5,
        )
    ]


def ours(resources: ExitStack) -> Prepared:
    """The task as the bridge uses it in lockstep: command, physics, image, outcome; resets where they fall."""
    from common.errors import RelodError

    try:
        return _prepared(resources)
    except RelodError as error:
        if "OpenGL" in str(error):
            raise UnavailableError(str(error)) from error
        raise


def _prepared(resources: ExitStack) -> Prepared:
    from services.robot_bridge.tasks import load_task

    rng = np.random.default_rng(0)
    task = load_task(TASK, pacing="lockstep", rng=rng)
    resources.callback(task.close)
    spec = task.spec
    cycle_ns = round(spec.action_cycle_time_s * 1e9)
    now_ns, steps = 0, 0
    task.advance_to(now_ns)
    task.begin_episode()
    task.read()

    def advance() -> None:
        nonlocal now_ns, steps
        task.command(rng.uniform(spec.action_low, spec.action_high).astype(np.float32))
        now_ns += cycle_ns
        steps += 1
        task.advance_to(now_ns)
        reading = task.read()
        if len(reading.frames) != 1:
            raise RuntimeError(f"expected one new frame a step, got {len(reading.frames)}")
        if task.outcome().terminated:
            task.begin_episode()
            steps = 0
        elif steps == spec.time_limit_steps:
            task.begin_attempt()
            steps = 0

    def measure() -> list[float]:
        begun = time.process_time()  # of all threads: see benchmarks.side.repeated
        for _ in range(STEPS):
            advance()
        return [STEPS / (time.process_time() - begun)]

    measure()
    return Prepared(measure)
