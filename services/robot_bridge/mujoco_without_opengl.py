"""MuJoCo, imported without the OpenGL backend that the environment variable MUJOCO_GL names.

Importing mujoco loads that backend at once. A task without camera would then fail for want of a library that it does
not use, and one with a camera before :mod:`services.robot_bridge.rendering` can say which. ``mujoco.Renderer``, which
nothing here uses, does not know MUJOCO_GL afterwards unless mujoco was imported before.
"""

from __future__ import annotations

import os

_backend = os.environ.pop("MUJOCO_GL", None)
try:
    import mujoco
finally:
    if _backend is not None:
        os.environ["MUJOCO_GL"] = _backend

__all__ = ["mujoco"]
