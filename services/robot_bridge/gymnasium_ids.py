"""The ids under which Gymnasium knows the tasks, and how it comes to know them.

``pyproject.toml`` names :func:`register_tasks` as the distribution's entry point in the group ``gymnasium.envs``.
Gymnasium calls what stands there only before its version 1.0; since then it registers nothing that was not imported.
So the distribution also has a start-up file, ``relod_gymnasium.pth``, which calls :func:`register_on_import` whenever
Python starts: ``gymnasium.make("relod/DotReacher-v0")`` needs no import of ours. Every start of Python pays for the
import of this module, which therefore imports nothing that takes time.
"""

from __future__ import annotations

import sys

TYPE_CHECKING = False
"""As type checkers know it; importing ``typing`` for it would take longer than all the rest."""

if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.abc import Loader
    from importlib.machinery import ModuleSpec
    from types import ModuleType

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
    from services.robot_bridge.tasks import TASKS

    return {gymnasium_id(task): task for task in TASKS if task not in NOT_FOR_LEARNING}


def register_tasks() -> None:
    """Make all ids known to Gymnasium; those it knows already stay. No task is imported."""
    from gymnasium.envs.registration import register, registry

    for identifier, task in tasks_by_id().items():
        if identifier not in registry:
            register(identifier, "services.robot_bridge.gymnasium_env:TaskEnv", kwargs={"task": task})


def register_on_import() -> None:
    """Register the tasks as soon as someone imports Gymnasium."""
    if "gymnasium" in sys.modules:
        register_tasks()
    elif not any(isinstance(finder, _GymnasiumFinder) for finder in sys.meta_path):
        # Python may read its start-up files twice.
        sys.meta_path.insert(0, _GymnasiumFinder())


class _GymnasiumFinder:
    """Finds Gymnasium as Python does, and has the tasks registered once it has been imported."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name != "gymnasium":
            return None
        from functools import partial
        from importlib.machinery import PathFinder

        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            # The loader itself stays: others ask it for the package's files.
            spec.loader.exec_module = partial(self._execute_and_register, spec.loader)  # type: ignore[method-assign]
        return spec

    def _execute_and_register(self, loader: Loader, module: ModuleType) -> None:
        # Only now: who looks for a module does not always import it.
        del loader.exec_module
        if self in sys.meta_path:
            sys.meta_path.remove(self)
        loader.exec_module(module)
        register_tasks()
