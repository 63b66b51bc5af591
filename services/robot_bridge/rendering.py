"""Pictures of MuJoCo scenes without a display, in about a millisecond on a processor.

OpenGL is loaded with the first camera: who renders nothing needs none. The backend is EGL, or else OSMesa; the
environment variable MUJOCO_GL (``egl``, ``osmesa``) decides for one.
"""

from __future__ import annotations

import atexit
import functools
import importlib
import importlib.util
import os
import sys
import weakref
from dataclasses import dataclass
from typing import Any

import numpy as np

from common.errors import ServiceError
from common.messages import UInt8Array
from services.robot_bridge.mujoco_without_opengl import mujoco

BACKENDS = {"egl": "libegl1 and libgl1-mesa-dri", "osmesa": "libosmesa6"}
"""MuJoCo's OpenGL backends that need no display, in order of preference -> the system packages they need."""
MOST_GEOMETRIES = 200
"""Room for a scene's geometries; MuJoCo's default of 10 000 costs time with each picture."""
COSTLY_EFFECTS = (
    mujoco.mjtRndFlag.mjRND_SHADOW,
    mujoco.mjtRndFlag.mjRND_REFLECTION,
    mujoco.mjtRndFlag.mjRND_SKYBOX,
    mujoco.mjtRndFlag.mjRND_HAZE,
)


@dataclass(frozen=True)
class Window:
    """The part of a camera's picture that is rendered, in pixels."""

    top: int
    left: int
    height: int
    width: int
    picture_height: int = 240
    """Of the whole picture; dm_control's default."""
    picture_width: int = 320


class OffscreenCamera:
    """Renders a window of what a camera sees; belongs to the thread that makes it.

    Without shadows, reflections, sky and multisampling, and only the pixels of the window: 20 to 50 times faster than
    the whole picture with all effects. The model's visual settings are changed accordingly.
    """

    def __init__(self, model: mujoco.MjModel, window: Window, camera: str | None = None) -> None:
        """Open a camera of ``model`` by its name; None is the free camera, which shows the whole model."""
        self._model = model
        self._mjr_context: mujoco.MjrContext | None = None
        self._gl_context: Any = None
        model.vis.quality.shadowsize = 0
        model.vis.quality.offsamples = 0
        model.vis.global_.offheight, model.vis.global_.offwidth = window.height, window.width
        # The window is the whole frame buffer. The picture around it is clipped before anything is drawn.
        bottom = window.picture_height - window.top - window.height
        self._picture = mujoco.MjrRect(-window.left, -bottom, window.picture_width, window.picture_height)
        self._window = mujoco.MjrRect(0, 0, window.width, window.height)
        self._flipped = np.empty((window.height, window.width, 3), np.uint8)
        self._options = mujoco.MjvOption()
        self._scene = mujoco.MjvScene(model=model, maxgeom=MOST_GEOMETRIES)
        for effect in COSTLY_EFFECTS:
            self._scene.flags[effect] = 0
        self._camera = mujoco.MjvCamera()
        if camera is None:
            mujoco.mjv_defaultFreeCamera(model, self._camera)
        else:
            self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
            self._camera.fixedcamid = model.camera(camera).id
        self._gl_context = gl_context_class()(window.width, window.height)
        self._gl_context.make_current()
        self._mjr_context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._mjr_context)
        _open_cameras.add(self)

    def picture(self, data: mujoco.MjData) -> UInt8Array:
        """Return the picture of the present state, (height, width, 3) RGB; it is the caller's."""
        self._gl_context.make_current()  # Another camera may have been used in the meantime.
        mujoco.mjv_updateScene(
            self._model, data, self._options, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene
        )
        mujoco.mjr_render(self._picture, self._scene, self._mjr_context)
        mujoco.mjr_readPixels(self._flipped, None, self._window, self._mjr_context)
        return self._flipped[::-1].copy()  # OpenGL's rows run upwards.

    def close(self) -> None:
        """Give the OpenGL context back."""
        gl_context, self._gl_context = self._gl_context, None
        if gl_context is None:
            return
        if self._mjr_context is not None:
            # What is freed are numbers, which mean something else in another camera's context.
            gl_context.make_current()
            self._mjr_context.free()
            self._mjr_context = None
        gl_context.free()

    def __del__(self) -> None:
        self.close()


_open_cameras: weakref.WeakSet[OffscreenCamera] = weakref.WeakSet()


@functools.cache
def gl_context_class() -> type:
    """Return the class of the first OpenGL backend that works here: ``GLContext`` of :mod:`mujoco.egl` or its like.

    Raises:
        ServiceError: none works; the message names the packages to install.
    """
    wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
    if wanted in ("disable", "disabled", "off", "false", "0"):
        raise ServiceError(f"this task has a camera, but MUJOCO_GL={wanted} forbids OpenGL: unset it, or set egl")
    _load_other_llvm_first()
    os.environ.setdefault("LP_NUM_THREADS", "0")  # Mesa's threads cost more than such small pictures gain from them.
    candidates = [wanted] if wanted in BACKENDS else list(BACKENDS)
    failures = []
    for name in candidates:
        try:
            context_class = importlib.import_module(f"mujoco.{name}").GLContext
            context_class(1, 1).free()
        except Exception as error:  # What a missing library raises differs from one to the next.
            failures.append(f"{name}: {error}")
            _forget_opengl(name)
        else:
            os.environ["MUJOCO_GL"] = name  # MuJoCo looks for OpenGL's functions where this says.
            # Registered after the backend's own, it runs before: with the display, its contexts are gone.
            atexit.register(_close_cameras)
            return context_class
    packages = ", or ".join(BACKENDS[name] for name in candidates)
    raise ServiceError(
        f"this task has a camera, and no OpenGL backend works here ({'; '.join(failures)}): "
        f"on Debian and Ubuntu, install {packages}"
    )


def _close_cameras() -> None:
    for camera in list(_open_cameras):
        camera.close()


def _forget_opengl(name: str) -> None:
    """PyOpenGL chooses its platform for good when it is imported; let the next backend choose again."""
    for module in [m for m in sys.modules if m == f"mujoco.{name}" or m.partition(".")[0] == "OpenGL"]:
        del sys.modules[module]
    if os.environ.get("PYOPENGL_PLATFORM") == name:
        del os.environ["PYOPENGL_PLATFORM"]


def _load_other_llvm_first() -> None:
    """Load triton, if it is there, before Mesa.

    Both bring an LLVM. Mesa's is visible to every library that is loaded after it, and triton, which torch's optimisers
    load, then ends the process by a segmentation fault. Loaded first, triton keeps to its own.
    """
    # Where someone else has imported mujoco with MUJOCO_GL=osmesa, Mesa is there already and triton must not follow.
    if importlib.util.find_spec("triton") and "mujoco.osmesa" not in sys.modules:
        importlib.import_module("triton")
