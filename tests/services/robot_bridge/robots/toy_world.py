"""A robot on a rail and a camera that draws without OpenGL, for tests of what drives them."""

from __future__ import annotations

import mujoco
import numpy as np

from services.robot_bridge.cameras.simulated import CameraDefects, SimulatedCamera
from services.robot_bridge.robots.base import SimulatedRobot
from services.robot_bridge.robots.sensed_world import Rates, SensedWorld

RATES = Rates(sensors_ns=8_000_000, camera_hz=30)
RAIL = """
<mujoco>
  <worldbody>
    <camera name="eye" pos="0 0 2"/>
    <body name="cart"><joint type="slide" axis="1 0 0"/><geom size=".1" rgba="1 0 0 1"/></body>
  </worldbody>
</mujoco>
"""


class Cart(SimulatedRobot):
    """Its command is its speed, m/s; it feels where it is."""

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_string(RAIL)
        self.data = mujoco.MjData(self.model)
        self.speed, self.placed = 0.0, []
        self.offset = 0.0
        """Added to what is felt."""

    @property
    def position(self) -> float:
        return float(self.data.qpos[0])

    def place(self, goal, start) -> None:
        self.placed.append((goal.tolist(), start.tolist()))
        self.speed, self.data.qpos[0] = 0.0, start[0]
        mujoco.mj_kinematics(self.model, self.data)

    def command(self, action) -> None:
        self.speed = float(action[0])

    def stop(self) -> None:
        self.speed = 0.0

    def advance(self, duration_ns) -> None:
        self.data.qpos[0] += self.speed * duration_ns * 1e-9
        mujoco.mj_kinematics(self.model, self.data)

    def sense(self) -> np.ndarray:
        return np.array([self.position + self.offset])


class Sketch(SimulatedCamera):
    """Draws a frame of 2x3 grey pixels whose level is the position in cm, modulo 256."""

    def __init__(self, model, **defects) -> None:
        super().__init__(model, "eye", height=2, width=3, defects=CameraDefects(**defects))
        self.on_capture = lambda: None
        """What happens while a frame is drawn."""
        self.on_open = lambda: None
        """What happens while it is opened."""
        self.closed = 0

    def open(self) -> None:
        self.on_open()

    def close(self) -> None:
        self.closed += 1

    def _picture(self, data, capture_ns):
        self.on_capture()
        return np.full((2, 3, 3), round(data.qpos[0] * 100) % 256, np.uint8)


def toy_world(sensor_noise=0.0, **defects) -> SensedWorld:
    """A cart at 0 and its camera."""
    cart = Cart()
    cart.place(np.zeros(1), np.zeros(1))
    return SensedWorld(cart, Sketch(cart.model, **defects), RATES, sensor_noise)
