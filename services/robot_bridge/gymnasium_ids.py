"""The ids under which Gymnasium knows the tasks, and how it comes to know them.

``pyproject.toml`` names :func:`register_tasks` as the distribution's entry point in the group ``gymnasium.envs``.
Gymnasium calls what stands there only before its version 1.0; since then it registers nothing that was not imported.
So the distribution also has a start-up file (``deploy/bootstrap/relod_gymnasium.py``), which calls it once Gymnasium is
imported: ``gymnasium.make("relod/DotReacher-v0")`` needs no import of ours.
"""

from __future__ import annotations

from services.robot_bridge.tasks import TASKS

NAMESPACE = "relod"
VERSION = 0
"""Raised where a change makes results incomparable with those before."""
NOT_FOR_LEARNING = frozenset({"noise_frames"})
"""Tasks of the table that get no id."""


def gymnasium_id(task: str) -> str:
    """Return the id of a task: ``relod/DotReacher-v0`` for ``dot_reacher``."""
    name = "".join(part.capitalize() for part in task.split("_"))
    return f"{NAMESPACE}/{name}-v{VERSION}"


def tasks_by_id() -> dict[str, str]:
    """Return id -> task id of every task that there is something to learn in."""
    return {gymnasium_id(task): task for task in TASKS if task not in NOT_FOR_LEARNING}


def register_tasks() -> None:
    """Make all ids known to Gymnasium; those it knows already stay. No task is imported."""
    from gymnasium.envs.registration import register, registry

    for identifier, task in tasks_by_id().items():
        if identifier not in registry:
            register(identifier, "services.robot_bridge.gymnasium_env:TaskEnv", kwargs={"task": task})
