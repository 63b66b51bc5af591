"""A simulated robot with a camera: how many steps a second, image included."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack

import numpy as np

from benchmarks.comparison import Comparison, RowPlan, Side
from benchmarks.side import Prepared, UnavailableError, repeated
from benchmarks.table import Budget

REACHER = "reacher_easy_visual"
ROBOTS = {
    "ur5": "ur5_visual_reacher_min_time",
    "franka": "franka_visual_reacher",
    "create": "create_reacher",
    "vector": "vector_charger_detector",
}
"""Name in the rows -> task."""
STEPS = 500
PICTURES = 200


def comparisons() -> list[Comparison]:
    """Absolute budgets: the thesis's studies need hundreds of thousands of steps, a real-time camera 30 pictures/s."""
    return [
        Comparison(
            sides={"ours": Side("benchmarks.rendering:steps", {"task": REACHER})},
            plans=(RowPlan("reacher_step_and_render_per_s", Budget(">=", 500.0, "/s"), "ours"),),
            rounds=5,
        ),
        *(
            Comparison(
                sides={"ours": Side("benchmarks.rendering:steps", {"task": task})},
                plans=(RowPlan(f"{robot}_step_and_render_per_s", Budget(">=", 300.0, "/s"), "ours"),),
                rounds=5,
            )
            for robot, task in ROBOTS.items()
        ),
        *(
            Comparison(
                sides={"ours": Side("benchmarks.rendering:picture", {"robot": robot})},
                plans=(RowPlan(f"{robot}_picture_p50_ms", Budget("<=", 3.0, "ms"), "ours"),),
                rounds=5,
            )
            for robot in ROBOTS
        ),
    ]


def steps(resources: ExitStack, task: str) -> Prepared:
    """The task as the bridge uses it in lockstep: command, physics, image, outcome; resets where they fall."""
    return _or_unavailable(lambda: _prepared(resources, task))


def picture(resources: ExitStack, robot: str) -> Prepared:
    """One picture of a robot's camera, from the scene's state to its pixels."""
    return _or_unavailable(lambda: _prepared_picture(resources, robot))


def _or_unavailable(prepare: Callable[[], Prepared]) -> Prepared:
    from common.errors import RelodError

    try:
        return prepare()
    except RelodError as error:
        if "OpenGL" in str(error):
            raise UnavailableError(str(error)) from error
        raise


def _prepared_picture(resources: ExitStack, robot: str) -> Prepared:
    from services.robot_bridge.mujoco_without_opengl import mujoco
    from services.robot_bridge.rendering import OffscreenCamera, Window
    from services.robot_bridge.tasks import load_task
    from services.robot_bridge.tasks.robot_task import RobotTask

    task = load_task(ROBOTS[robot], pacing="lockstep", rng=np.random.default_rng(0))
    assert isinstance(task, RobotTask)
    resources.callback(task.close)
    view, data = task.VIEW, task.robot.data
    mujoco.mj_camlight(task.robot.model, data)
    window = Window(0, 0, view.height, view.width, view.height, view.width)
    camera = OffscreenCamera(task.robot.model, window, view.camera)
    resources.callback(camera.close)
    return Prepared(repeated(lambda: camera.picture(data), PICTURES))


def _prepared(resources: ExitStack, name: str) -> Prepared:
    from services.robot_bridge.tasks import load_task

    rng = np.random.default_rng(0)
    task = load_task(name, pacing="lockstep", rng=rng)
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
        if len(reading.frames) > 2:
            raise RuntimeError(f"expected at most two new frames a step, got {len(reading.frames)}")
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
