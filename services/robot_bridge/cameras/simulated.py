"""A camera in a MuJoCo scene, with the defects of a real one: latency, noise and a room whose light changes."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from common.errors import ConfigError
from common.messages import UInt8Array
from services.robot_bridge.cameras.base import Camera, CameraFrame
from services.robot_bridge.mujoco_without_opengl import mujoco
from services.robot_bridge.rendering import OffscreenCamera, Window

BUFFERED_FRAMES = 8
"""So many are kept for whoever takes them late. A quarter of a second at 30 Hz: more than any stack needs."""
LIGHT_PERIOD_NS = 10_000_000_000
"""In which a changing light goes from dark to bright and back."""


@dataclass(frozen=True)
class CameraDefects:
    """What a real camera does to a picture; all zero: nothing."""

    latency_ns: int = 0
    """Time from the capture of a frame until it can be taken."""
    noise: float = 0.0
    """Standard deviation, grey levels of 255, of each pixel and channel by itself."""
    lighting_change: float = 0.0
    """Largest change of the room's light, as a share of it; what shines by itself, as a monitor, stays."""


class SimulatedCamera(Camera):
    """Draws what one of a model's cameras sees when it is told to.

    It belongs to a simulated robot: no configuration names it. Whoever drives the world captures, perhaps in a thread
    of its own; one other thread may take. Neither waits for the other.
    """

    def __init__(
        self, model: mujoco.MjModel, name: str, *, height: int, width: int, defects: CameraDefects | None = None
    ) -> None:
        """Args:
        model: the scene.
        name: of the camera in it.
        height: of a frame, pixels.
        width: of a frame, pixels.
        defects: of the camera; None: it has none.

        Raises:
            ConfigError: the scene has no camera of this name.
        """
        names = [model.camera(number).name for number in range(model.ncam)]
        if name not in names:
            raise ConfigError(f"camera {name!r}: expected one of the scene's: {', '.join(names) or 'it has none'}")
        self._model, self._name = model, name
        self._window = Window(0, 0, height, width, height, width)
        self._defects = defects or CameraDefects()
        self._drawing: OffscreenCamera | None = None
        self._shown: tuple[bytes, UInt8Array] | None = None
        """The scene drawn last, and its picture without noise."""
        self._next_id = 0
        self._newest_capture_ns = 0
        self._dropped = 0
        self._under_way: deque[tuple[int, CameraFrame]] = deque()
        """Captured frames that cannot be taken yet, each with the time from which it can."""
        # One side appends, the other one pops: a deque needs no lock for that.
        self._ready: deque[CameraFrame] = deque(maxlen=BUFFERED_FRAMES)
        lights = model.light_diffuse, model.vis.headlight.diffuse, model.vis.headlight.ambient
        self._lights = [(light, light.copy()) for light in lights]
        self.begin(np.random.default_rng(0))

    # ------------------------------------------------------------------ whoever drives the world

    def open(self) -> None:
        """Load OpenGL, which takes a large part of a second the first time; else the first frame does.

        Raises:
            ServiceError: nothing can be drawn here.
        """
        if self._drawing is None:
            self._drawing = OffscreenCamera(self._model, self._window, self._name)

    def begin(self, rng: np.random.Generator) -> None:
        """Forget all frames; noise and light follow from ``rng`` from now on."""
        self._under_way.clear()
        self._ready.clear()
        self._rng = rng
        self._light_phase = rng.uniform(0.0, 2 * math.pi)
        self._light_began_ns: int | None = None
        """When the first frame since then was captured: an attempt's light must not depend on when it begins."""

    def capture(self, data: mujoco.MjData, capture_ns: int, *, at_once: bool = False) -> None:
        """Take a picture of the present state.

        Args:
            data: the state; positions of bodies and geometries in it are those of now.
            capture_ns: now.
            at_once: the frame can be taken now, whatever the latency: someone has waited for it.
        """
        picture = self._picture(data, capture_ns)
        picture.flags.writeable = False
        frame = CameraFrame(picture, self._next_id, capture_ns)
        self._next_id += 1
        self._newest_capture_ns = capture_ns
        self._under_way.append((capture_ns if at_once else capture_ns + self._defects.latency_ns, frame))
        self.release(capture_ns)

    def miss(self, frames: int) -> None:
        """Lose ``frames``: nobody could take them any more, so they are not drawn."""
        self._next_id += frames
        self._dropped += frames

    def release(self, now_ns: int) -> None:
        """Hand over what is ready by ``now_ns``."""
        while self._under_way and self._under_way[0][0] <= now_ns:
            self._dropped += len(self._ready) == BUFFERED_FRAMES
            self._ready.append(self._under_way.popleft()[1])

    @property
    def frames(self) -> int:
        """Frames, ever; those that were missed count."""
        return self._next_id

    @property
    def release_ns(self) -> int | None:
        """When the next frame can be taken; None if no frame is under way."""
        return self._under_way[0][0] if self._under_way else None

    def close(self) -> None:
        drawing, self._drawing = self._drawing, None
        if drawing is not None:
            drawing.close()

    # ------------------------------------------------------------------ whoever looks

    @property
    def newest_capture_ns(self) -> int:
        return self._newest_capture_ns

    @property
    def dropped(self) -> int:
        return self._dropped

    @property
    def lost(self) -> str | None:
        """None: what does not exist cannot be unplugged."""
        return None

    @property
    def losses(self) -> int:
        return 0

    def take(self) -> list[CameraFrame]:
        taken = []
        for _ in range(BUFFERED_FRAMES):
            try:
                taken.append(self._ready.popleft())
            except IndexError:
                break
        return taken

    # ------------------------------------------------------------------ the picture

    def _picture(self, data: mujoco.MjData, capture_ns: int) -> UInt8Array:
        self.open()  # Not before: a world that nobody looks at needs no OpenGL.
        assert self._drawing is not None
        mujoco.mj_camlight(self._model, data)
        brightness = self._set_lights(capture_ns)
        scene = b"".join(
            array.tobytes() for array in (data.geom_xpos, data.geom_xmat, data.cam_xpos, data.cam_xmat, brightness)
        )
        if self._shown is None or self._shown[0] != scene:  # A scene in which nothing has moved looks the same.
            self._shown = scene, self._drawing.picture(data)
        picture = self._shown[1]
        return self._with_noise(picture) if self._defects.noise else picture

    def _set_lights(self, now_ns: int) -> np.float64:
        change = self._defects.lighting_change
        if self._light_began_ns is None:
            self._light_began_ns = now_ns
        passed_ns = (now_ns - self._light_began_ns) % LIGHT_PERIOD_NS
        angle = 2 * math.pi * passed_ns / LIGHT_PERIOD_NS + self._light_phase
        brightness = np.float64(1.0 + change * math.sin(angle))
        if change:
            for light, undisturbed in self._lights:
                light[:] = undisturbed * brightness
        return brightness

    def _with_noise(self, picture: UInt8Array) -> UInt8Array:
        noise = self._rng.standard_normal(picture.shape, np.float32)
        noise *= np.float32(self._defects.noise)
        noise += picture
        np.clip(np.rint(noise, out=noise), 0, 255, out=noise)
        return noise.astype(np.uint8)
