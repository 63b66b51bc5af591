"""Has the tasks registered with Gymnasium whenever it is imported. ``relod_gymnasium.pth`` imports this at each start.

It is installed beside the packages, on its own: it takes no time, and it does not import ``services``, which a program
that is started in another checkout must find there.
"""

import sys

TYPE_CHECKING = False
"""As type checkers know it; importing ``typing`` for it would take longer than all the rest."""

if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.abc import Loader
    from importlib.machinery import ModuleSpec
    from types import ModuleType


def register_on_import() -> None:
    """Register the tasks as soon as someone imports Gymnasium."""
    if "gymnasium" in sys.modules:
        _register()
    elif not any(type(finder).__name__ == _GymnasiumFinder.__name__ for finder in sys.meta_path):
        # Python may read its start-up files twice.
        sys.meta_path.insert(0, _GymnasiumFinder())


def _register() -> None:
    from services.robot_bridge.gymnasium_ids import register_tasks

    register_tasks()


class _GymnasiumFinder:
    """Finds Gymnasium as Python does, and has the tasks registered once it has been imported."""

    def find_spec(
        self, name: str, path: "Sequence[str] | None" = None, target: "ModuleType | None" = None
    ) -> "ModuleSpec | None":
        if name != "gymnasium":
            return None
        from functools import partial
        from importlib.machinery import PathFinder

        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            # The loader itself stays: others ask it for the package's files.
            spec.loader.exec_module = partial(self._execute_and_register, spec.loader)  # type: ignore[method-assign]
        return spec

    def _execute_and_register(self, loader: "Loader", module: "ModuleType") -> None:
        # Only now: who looks for a module does not always import it.
        del loader.exec_module
        if self in sys.meta_path:
            sys.meta_path.remove(self)
        loader.exec_module(module)
        _register()
