"""The table of tasks. A new task is one file and one line here, or a ``[tasks]`` row in the bridge's configuration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from common.config import build_section
from common.errors import ConfigError
from services.robot_bridge.class_table import extended, load_class
from services.robot_bridge.tasks.base import Outcome, SensorReading, Task

TASKS = {
    "dot_reacher": "services.robot_bridge.tasks.dot_reacher:DotReacher",
    "visual_dot_reacher": "services.robot_bridge.tasks.visual_dot_reacher:VisualDotReacher",
    "reacher_easy": "services.robot_bridge.tasks.reacher:ReacherEasy",
    "reacher_easy_visual": "services.robot_bridge.tasks.reacher:ReacherEasyVisual",
    "reacher_hard": "services.robot_bridge.tasks.reacher:ReacherHard",
    "reacher_hard_visual": "services.robot_bridge.tasks.reacher:ReacherHardVisual",
    "reacher_extreme": "services.robot_bridge.tasks.reacher:ReacherExtreme",
    "reacher_extreme_visual": "services.robot_bridge.tasks.reacher:ReacherExtremeVisual",
    "ball_in_cup": "services.robot_bridge.tasks.ball_in_cup:BallInCup",
    "ball_in_cup_visual": "services.robot_bridge.tasks.ball_in_cup:BallInCupVisual",
    "ur5_visual_reacher": "services.robot_bridge.tasks.ur5_visual_reacher:Ur5VisualReacher",
    "ur5_visual_reacher_min_time": "services.robot_bridge.tasks.ur5_visual_reacher:Ur5VisualReacherMinTime",
    "franka_visual_reacher": "services.robot_bridge.tasks.franka_visual_reacher:FrankaVisualReacher",
    "create_reacher": "services.robot_bridge.tasks.create_reacher:CreateReacher",
    "vector_charger_detector": "services.robot_bridge.tasks.vector_charger_detector:VectorChargerDetector",
    "noise_frames": "services.robot_bridge.tasks.noise_frames:NoiseFrames",
}
"""Task id -> ``module:Class``; imported only when chosen, so that a robot's driver burdens no one else."""

__all__ = ["TASKS", "Outcome", "SensorReading", "Task", "load_task", "task_table"]


def task_table(rows: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the table of tasks with more rows, ``[tasks]`` of the bridge's configuration.

    Raises:
        ConfigError: a row's name is taken.
    """
    return extended(TASKS, rows, "task")


def load_task(
    name: str,
    preset: str = "",
    overrides: Mapping[str, Any] | None = None,
    rows: Mapping[str, Any] | None = None,
    *,
    pacing: str = "lockstep",
    rng: np.random.Generator,
) -> Task:
    """Build task ``name``.

    Args:
        name: task id.
        preset: one of the task's presets; empty takes its default.
        overrides: settings that win over the preset's.
        rows: more rows for the table.
        pacing: ``realtime`` or ``lockstep``, told to others through the TaskSpec.
        rng: all of the task's randomness.

    Raises:
        ConfigError: unknown task, preset or setting, a value out of range, or a row that leads to no task.
    """
    task_class = load_class(Task, name, task_table(rows), "task")
    preset = preset or next(iter(task_class.PRESETS))
    if preset not in task_class.PRESETS:
        raise ConfigError(f"[task] preset = {preset!r}: task {name} has the presets {', '.join(task_class.PRESETS)}")
    values = {**task_class.PRESETS[preset], **(overrides or {})}
    where = f"[task] {name}"
    settings: Any = build_section(task_class.SETTINGS, values, where)
    try:
        return task_class(settings, name=name, preset=preset, pacing=pacing, rng=rng)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error
