"""A UR5 at a table, a webcam at its tool, and a monitor that shows a coloured target: a MuJoCo model.

World frame: metres, z up, the monitor in front of the arm along y, the origin in the middle of the arm's foot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from services.robot_bridge.mujoco_without_opengl import mujoco
from services.robot_bridge.robots.base import ROOM_CAMERA
from services.robot_bridge.robots.table_room import MATERIALS, VISUALS, shapes_xml, table_xml

QUARTER = math.pi / 2
UR5_DH = (
    (0.0, QUARTER, 0.089159),
    (-0.425, 0.0, 0.0),
    (-0.39225, 0.0, 0.0),
    (0.0, QUARTER, 0.10915),
    (0.0, -QUARTER, 0.09465),
    (0.0, 0.0, 0.0823),
)
"""(a m, alpha rad, d m) of each joint, as Universal Robots publishes them ("DH parameters for calculations of
kinematics and dynamics"). The base stands turned by half a turn about z."""
JOINTS = len(UR5_DH)
TOOL, WRIST_CAMERA = "tool", "wrist"
CAMERA_OFFSET = 0.03
"""m, of the webcam in front of the tool's flange."""

_UPPER, _FORE = 0.1358, 0.0162
"""m, along their joints' axes, by which the arm's tubes stand beside each other; together with the wrist they are the
d of joint 4."""
# For each link, shapes in the frame whose z axis is its joint's: material, radius, from, to.
_LINKS = (
    (
        ("dark", 0.073, (0, 0, 0), (0, 0, 0.032)),
        ("metal", 0.060, (0, 0, 0.032), (0, 0, 0.150)),
        ("metal", 0.057, (0, -0.075, 0.089159), (0, 0.064, 0.089159)),
        ("blue", 0.054, (0, 0.064, 0.089159), (0, 0.072, 0.089159)),
    ),
    (
        ("metal", 0.060, (0, 0, 0.075), (0, 0, 0.196)),
        ("blue", 0.057, (0, 0, 0.196), (0, 0, 0.206)),
        ("metal", 0.045, (0, 0, _UPPER), (-0.425, 0, _UPPER)),
        ("metal", 0.056, (-0.425, 0, 0.078), (-0.425, 0, 0.190)),
        ("blue", 0.053, (-0.425, 0, 0.190), (-0.425, 0, 0.199)),
    ),
    (
        ("metal", 0.055, (0, 0, -0.042), (0, 0, 0.074)),
        ("blue", 0.052, (0, 0, -0.051), (0, 0, -0.042)),
        ("metal", 0.038, (0, 0, _FORE), (-0.39225, 0, _FORE)),
        ("metal", 0.043, (-0.39225, 0, -0.035), (-0.39225, 0, 0.062)),
        ("blue", 0.040, (-0.39225, 0, -0.043), (-0.39225, 0, -0.035)),
    ),
    (
        ("metal", 0.041, (0, 0, 0.064), (0, 0, 0.150)),
        ("blue", 0.039, (0, 0, 0.150), (0, 0, 0.158)),
        ("metal", 0.041, (0, -0.048, 0.10915), (0, 0.030, 0.10915)),
    ),
    (
        ("metal", 0.041, (0, 0, 0.050), (0, 0, 0.137)),
        ("blue", 0.039, (0, 0, 0.137), (0, 0, 0.145)),
        ("metal", 0.041, (0, -0.030, 0.09465), (0, 0.043, 0.09465)),
    ),
    (
        ("metal", 0.038, (0, 0, 0.040), (0, 0, 0.072)),
        ("dark", 0.032, (0, 0, 0.072), (0, 0, 0.0823)),
    ),
)


@dataclass(frozen=True)
class Monitor:
    """A monitor that stands upright, facing the arm, and the disc it shows."""

    distance: float
    """m, along y."""
    x: float
    """m, of its middle."""
    z: float
    """m, of its middle."""
    width: float
    """m, of the picture."""
    height: float
    """m, of the picture."""
    target_radius: float
    """As a share of the width."""
    target_margin: float
    """Least distance of the target from the picture's edges, as a share of the width."""

    def target_range(self) -> np.ndarray:
        """(2,) m: the target's middle lies within plus or minus this of the picture's, across and up."""
        free = (self.target_radius + self.target_margin) * self.width
        return np.array([self.width / 2 - free, self.height / 2 - free])


class Ur5Scene:
    """The model and its state."""

    def __init__(self, monitor: Monitor, field_of_view: float) -> None:
        """Args:
        monitor: in front of the arm.
        field_of_view: of the webcam, degrees, from its picture's top to its bottom.
        """
        self.model = mujoco.MjModel.from_xml_string(scene_xml(monitor, field_of_view))
        self.data = mujoco.MjData(self.model)
        self._target = self.model.geom("target").pos

    def show_target(self, position: np.ndarray) -> None:
        """Show the target at ``position`` (2,) m from the picture's middle, across (along x) and up."""
        self._target[0], self._target[2] = position


def scene_xml(monitor: Monitor, field_of_view: float) -> str:
    """Return the scene as MJCF."""
    half_width, half_height = monitor.width / 2, monitor.height / 2
    radius = monitor.target_radius * monitor.width
    # An equal margin of frame all around; the stand reaches down to the table.
    stand = monitor.z / 2
    return f"""
<mujoco model="ur5_visual_reacher">
  {VISUALS}
  <statistic center="0 .3 .3" extent="1.5"/>
  <asset>
    {MATERIALS}
    <material name="metal" rgba=".76 .78 .80 1" specular=".4" shininess=".6"/>
    <material name="blue" rgba=".30 .60 .82 1" specular=".2"/>
    <material name="screen" rgba="1 1 1 1" emission="1" specular="0"/>
    <material name="target" rgba=".90 .05 .05 1" emission="1" specular="0"/>
  </asset>
  <worldbody>
    <light directional="true" pos="1 -1 3" dir="-.35 .45 -1" diffuse=".42 .42 .40" specular=".2 .2 .2"/>
    <camera name="{ROOM_CAMERA}" pos="1.75 -.95 1.2" xyaxes=".638 .770 0 -.305 .253 .918" fovy="40"/>
    {table_xml(0, 0.55)}
    <geom name="wall" type="box" size="4 .02 2.5" pos="0 {monitor.distance + 0.62} 1.76" material="wall"/>
    <geom name="side wall" type="box" size=".02 4 2.5" pos="-2.2 0 1.76" material="wall"/>
    <body name="monitor" pos="{monitor.x} {monitor.distance} {monitor.z}">
      <geom type="box" size="{half_width + 0.012} .014 {half_height + 0.012}" pos="0 .0195 0" material="black"/>
      <geom type="box" size=".035 .012 {stand / 2 + 0.05}" pos="0 .04 {-1.5 * stand + 0.05}" material="dark"/>
      <geom type="box" size=".12 .08 .006" pos="0 .04 {0.006 - monitor.z}" material="dark"/>
      <geom name="screen" type="box" size="{half_width} .001 {half_height}" pos="0 .0045 0" material="screen"/>
      <geom name="target" type="cylinder" size="{radius} .0008" pos="0 .0022 0" zaxis="0 1 0" material="target"/>
    </body>
    <body name="base" euler="0 0 {math.pi}">
      <geom type="cylinder" size=".078 .004" pos="0 0 .004" material="dark"/>
      {_arm_xml(field_of_view)}
    </body>
  </worldbody>
</mujoco>
"""


def _arm_xml(field_of_view: float) -> str:
    """The links inside of each other, each turned and moved from the one before as the table says."""
    # The webcam looks where the tool points, with its picture's top along the tool's y axis.
    inside = f"""
      <site name="{TOOL}" size=".004" group="4"/>
      <camera name="{WRIST_CAMERA}" pos="0 0 {CAMERA_OFFSET}" xyaxes="-1 0 0 0 1 0" fovy="{field_of_view}"/>
      <geom type="box" size=".045 .013 .011" pos="0 0 {CAMERA_OFFSET - 0.017}" material="black"/>
      <geom type="cylinder" size=".010 .003" pos="0 0 {CAMERA_OFFSET - 0.004}" material="dark"/>
    """
    for number, ((a, alpha, d), shapes) in reversed(list(enumerate(zip(UR5_DH, _LINKS, strict=True)))):
        frame = "tool frame" if number == JOINTS - 1 else f"frame {number + 1}"
        # The body's own frame is that of the joint before, whose z is this joint's axis.
        inside = f"""
          <body name="link {number + 1}">
            <joint name="joint {number + 1}" axis="0 0 1"/>
            {shapes_xml(shapes)}
            <body name="{frame}" pos="{a} 0 {d}" euler="{alpha} 0 0">{inside}</body>
          </body>
        """
    return inside
