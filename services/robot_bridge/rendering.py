"""Pictures of MuJoCo scenes without a display, in about a millisecond on a processor.

OpenGL is loaded with the first camera: who renders nothing needs none. The backend is EGL, or else OSMesa; the
environment variable MUJOCO_GL (``egl``, ``osmesa``) decides for one.

A context can be in use by one thread at a time. It is therefore in use while a picture is drawn, and given back after
it (5 microseconds): cameras may go from thread to thread, and threads may end.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import importlib
import importlib.util
import os
import sys
import threading
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from common.errors import ServiceError
from common.messages import UInt8Array
from services.robot_bridge.mujoco_without_opengl import mujoco

BACKENDS = {"egl": "libegl1 and libgl1-mesa-dri", "osmesa": "libosmesa6"}
"""MuJoCo's OpenGL backends that need no display, in order of preference -> the system packages they need."""
_ANY_BACKEND = ("", "enable", "enabled", "on", "true", "1")
"""Values of MUJOCO_GL, as MuJoCo has them: whichever works."""
_NO_BACKEND = ("disable", "disabled", "off", "false", "0")
MOST_GEOMETRIES = 200
"""Room for a scene's geometries; MuJoCo's default of 10 000 costs time with each picture."""
SHADOW_MAP, SAMPLES, SLICES, STACKS = 2048, 4, 48, 24
"""Where effects are wanted: resolution of shadows, samples a pixel, faces around a round shape and along it."""
COSTLY_EFFECTS = (
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
    """Renders a window of what a camera sees; for any thread, one at a time.

    Without shadows, reflections, sky and multisampling, and only the pixels of the window: 20 to 50 times faster than
    the whole picture with all effects. The model's visual settings are changed accordingly.
    """

    def __init__(
        self, model: mujoco.MjModel, window: Window, camera: str | None = None, *, effects: bool = False
    ) -> None:
        """Args:
        model: what there is to see.
        window: that is drawn.
        camera: the camera's name; None is the free camera, which shows the whole model.
        effects: draw shadows, smooth edges and round shapes: slow, for people to look at.
        """
        self._model = model
        self._mjr_context: mujoco.MjrContext | None = None
        self._gl_context: Any = None
        quality = model.vis.quality
        quality.shadowsize, quality.offsamples = (SHADOW_MAP, SAMPLES) if effects else (0, 0)
        slices_stacks = quality.numslices, quality.numstacks
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
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = effects
        self._camera = mujoco.MjvCamera()
        if camera is None:
            mujoco.mjv_defaultFreeCamera(model, self._camera)
        else:
            self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
            self._camera.fixedcamid = model.camera(camera).id
        context_class = gl_context_class()
        with _opening:
            self._gl_context = context_class(window.width, window.height)
            with _in_use(self._gl_context):
                if effects:
                    quality.numslices, quality.numstacks = SLICES, STACKS
                self._mjr_context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
                quality.numslices, quality.numstacks = slices_stacks
                mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._mjr_context)
            _open_cameras.add(self)

    def picture(self, data: mujoco.MjData) -> UInt8Array:
        """Return the picture of the present state, (height, width, 3) RGB; it is the caller's."""
        mujoco.mjv_updateScene(
            self._model, data, self._options, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene
        )
        with _in_use(self._gl_context):
            mujoco.mjr_render(self._picture, self._scene, self._mjr_context)
            mujoco.mjr_readPixels(self._flipped, None, self._window, self._mjr_context)
        return self._flipped[::-1].copy()  # OpenGL's rows run upwards.

    def close(self) -> None:
        """Give the OpenGL context back."""
        gl_context, self._gl_context = self._gl_context, None
        if gl_context is None:
            return
        with _in_use(gl_context):
            if self._mjr_context is not None:
                # What is freed are numbers, which mean something else in another camera's context.
                self._mjr_context.free()
                self._mjr_context = None
            gl_context.free()

    def __del__(self) -> None:
        self.close()


_open_cameras: weakref.WeakSet[OffscreenCamera] = weakref.WeakSet()
_opening = threading.RLock()
"""Held while OpenGL is loaded or a context made: the backends' first calls are not made for two threads."""


class _ContextsInUse(threading.local):
    """Of this thread, innermost last: garbage may be collected, and a camera with it, while another one draws."""

    def __init__(self) -> None:
        self.contexts: list[Any] = []


_of_this_thread = _ContextsInUse()


@contextlib.contextmanager
def _in_use(gl_context: Any) -> Iterator[None]:
    """Have a context in use in this thread; afterwards that which was before, or none."""
    contexts = _of_this_thread.contexts
    gl_context.make_current()
    contexts.append(gl_context)
    try:
        yield
    finally:
        contexts.pop()
        if contexts:
            contexts[-1].make_current()
        else:
            _give_back(sys.modules[type(gl_context).__module__])


def _give_back(backend: Any) -> None:
    """Have no context of a backend, :mod:`mujoco.egl` or :mod:`mujoco.osmesa`, in use in this thread."""
    if backend.__name__ == "mujoco.egl":
        egl = backend.EGL
        egl.eglMakeCurrent(backend.EGL_DISPLAY, egl.EGL_NO_SURFACE, egl.EGL_NO_SURFACE, egl.EGL_NO_CONTEXT)
    else:
        backend.osmesa.OSMesaMakeCurrent(None, None, backend.GL.GL_FLOAT, 0, 0)


def gl_context_class() -> type:
    """Return the class of the first OpenGL backend that works here: ``GLContext`` of :mod:`mujoco.egl` or its like.

    Raises:
        ServiceError: none works, and the message names the packages to install; or MUJOCO_GL is none of its values.
    """
    with _opening:
        return _load_backend()


@functools.cache
def _load_backend() -> type:
    wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
    if wanted in _NO_BACKEND:
        raise ServiceError(f"this task has a camera, but MUJOCO_GL={wanted} forbids OpenGL: unset it, or set egl")
    if wanted not in (*BACKENDS, *_ANY_BACKEND):
        raise ServiceError(
            f"this task has a camera, and MUJOCO_GL={wanted} is no backend that draws without a display: expected "
            f"{' or '.join(BACKENDS)}; unset it, and the first of them that works is taken"
        )
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
    if wanted in BACKENDS:
        raise ServiceError(
            f"this task has a camera, and the OpenGL backend that MUJOCO_GL names does not work here "
            f"({'; '.join(failures)}): on Debian and Ubuntu, install {packages}, or unset MUJOCO_GL, and the first of "
            f"{', '.join(BACKENDS)} that works is taken"
        )
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
