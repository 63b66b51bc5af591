"""A Franka Emika Panda on a table, a webcam at its flange, and a bean bag in front of it: a MuJoCo model.

World frame: metres, z up, the table in front of the arm along x, the origin in the middle of the arm's foot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from services.robot_bridge.mujoco_without_opengl import mujoco
from services.robot_bridge.robots.base import ROOM_CAMERA
from services.robot_bridge.robots.table_room import (
    MATERIALS,
    TABLE_HALF_WIDTH,
    VISUALS,
    Point,
    Shape,
    shapes_xml,
    table_xml,
)

QUARTER = math.pi / 2
PANDA_DH = (
    (0.0, 0.0, 0.333),
    (0.0, -QUARTER, 0.0),
    (0.0, QUARTER, 0.316),
    (0.0825, QUARTER, 0.0),
    (-0.0825, -QUARTER, 0.384),
    (0.0, QUARTER, 0.0),
    (0.088, QUARTER, 0.0),
)
"""(a m, alpha rad, d m) of each joint in Craig's convention: a and alpha lead from the joint before to this one's axis,
d along it ("Denavit-Hartenberg parameters", Franka Control Interface documentation)."""
FLANGE = 0.107
"""m, from the last joint's frame along its axis."""
JOINTS = len(PANDA_DH)
TOOL, WRIST_CAMERA = "tool", "wrist"
TOOL_TURN = -math.pi / 4
"""rad, about the flange's axis: so is the manufacturer's hand mounted, and here the webcam in place of it."""
CAMERA_PLACE: Point = (0.05, 0.0, 0.02)
"""m, of the webcam in the tool's frame: x away from the arm in the start postures, z where the tool points."""
TABLE_X = 0.35
"""m, of the table's middle."""
FOOT_RADIUS = 0.078
"""m."""

_FOOT_ROUND: tuple[Shape, ...] = (
    ("white", 0.062, (0, 0, 0.062), (0, 0, 0.080)),
    ("white", 0.052, (-0.09, 0, 0.052), (0, 0, 0.060)),
)
_FOOT_FLAT: tuple[Shape, ...] = (
    ("dark", FOOT_RADIUS, (0, 0, 0), (0, 0, 0.012)),
    ("white", 0.062, (0, 0, 0.080), (0, 0, 0.141)),
)
# For each link, shapes in the frame of its joint, whose axis is z: round ones, and flat ones that cap them.
_ROUND: tuple[tuple[Shape, ...], ...] = (
    (("white", 0.058, (0, 0, -0.180), (0, 0, -0.010)), ("white", 0.056, (0, -0.010, 0), (0, 0.010, 0))),
    (("white", 0.054, (0, 0, 0), (0, -0.190, 0)),),
    (("white", 0.054, (0, 0, -0.110), (0, 0, -0.060)), ("white", 0.050, (0, 0, -0.060), (0.0825, 0, 0))),
    (("white", 0.050, (0, 0, 0), (-0.0825, 0.075, 0)), ("white", 0.050, (-0.0825, 0.075, 0), (-0.0825, 0.110, 0))),
    (("white", 0.050, (0, 0, -0.245), (0, 0, -0.200)), ("white", 0.043, (0, 0.020, -0.190), (0, 0.045, -0.010))),
    (("white", 0.046, (0, 0, 0), (0.088, 0, 0)),),
    (),
)
_FLAT: tuple[tuple[Shape, ...], ...] = (
    (("grey", 0.0595, (0, 0, -0.192), (0, 0, -0.180)),),
    (
        ("white", 0.056, (0, 0, -0.070), (0, 0, 0.070)),
        ("grey", 0.050, (0, 0, -0.078), (0, 0, 0.078)),
        ("grey", 0.0555, (0, -0.200, 0), (0, -0.188, 0)),
    ),
    (),
    (
        ("white", 0.052, (0, 0, -0.062), (0, 0, 0.062)),
        ("grey", 0.046, (0, 0, -0.070), (0, 0, 0.070)),
        ("grey", 0.0515, (-0.0825, 0.112, 0), (-0.0825, 0.124, 0)),
    ),
    (),
    (("white", 0.048, (0, 0, -0.055), (0, 0, 0.055)), ("grey", 0.042, (0, 0, -0.063), (0, 0, 0.063))),
    (
        ("white", 0.045, (0, 0, -0.050), (0, 0, 0.070)),
        ("grey", 0.046, (0, 0, 0.070), (0, 0, 0.080)),
        ("dark", 0.032, (0, 0, 0.080), (0, 0, FLANGE)),
    ),
)


@dataclass(frozen=True)
class BeanBag:
    """A round red bag that lies on the table."""

    radius: float
    """m."""
    height: float
    """m, of its top above the table."""

    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and highest (2,) m, x and y of its middle: it lies on the table, before the arm's foot."""
        free = TABLE_HALF_WIDTH - self.radius
        return np.array([FOOT_RADIUS + self.radius, -free]), np.array([TABLE_X + free, free])


class FrankaScene:
    """The model and its state."""

    def __init__(self, bag: BeanBag, field_of_view: float) -> None:
        """Args:
        bag: on the table.
        field_of_view: of the webcam, degrees, from its picture's top to its bottom.
        """
        self.model = mujoco.MjModel.from_xml_string(scene_xml(bag, field_of_view))
        self.data = mujoco.MjData(self.model)
        self._bag = self.model.geom("bag").pos

    def put_bag(self, position: np.ndarray) -> None:
        """Let the bag lie at ``position`` (2,) m: x, y of its middle."""
        self._bag[:2] = position


def scene_xml(bag: BeanBag, field_of_view: float) -> str:
    """Return the scene as MJCF."""
    # The bag is an ellipsoid whose lower quarter is below the table's top: it lies flat.
    half_height = bag.height * 2 / 3
    return f"""
<mujoco model="franka_visual_reacher">
  {VISUALS}
  <visual>
    <quality numslices="24" numstacks="8"/>
  </visual>
  <statistic center=".3 0 .3" extent="1.5"/>
  <asset>
    {MATERIALS}
    <material name="white" rgba=".90 .91 .92 1" specular=".3" shininess=".5"/>
    <material name="grey" rgba=".52 .54 .57 1" specular=".2"/>
    <material name="bag" rgba=".75 .02 .12 1" emission=".3" specular="0"/>
  </asset>
  <worldbody>
    <light directional="true" pos="1.66 -.98 3" dir="-.45 .35 -1" diffuse=".42 .42 .40" specular=".2 .2 .2"/>
    <camera name="{ROOM_CAMERA}" pos="1.65 -1.15 .95" xyaxes=".657 .754 0 -.270 .235 .934" fovy="36"/>
    {table_xml(TABLE_X, 0)}
    <geom name="wall" type="box" size="4 .02 1.6" pos="0 2.2 .86" material="wall"/>
    <geom name="side wall" type="box" size=".02 4 1.6" pos="-2.2 0 .86" material="wall"/>
    <geom name="bag" type="ellipsoid" size="{bag.radius} {bag.radius} {half_height}" pos=".6 0 {half_height / 2}"
      material="bag"/>
    {shapes_xml(_FOOT_ROUND, "capsule")}
    {shapes_xml(_FOOT_FLAT)}
    {_arm_xml(field_of_view)}
  </worldbody>
</mujoco>
"""


def _arm_xml(field_of_view: float) -> str:
    """The links inside of each other, each turned and moved from the one before as the table says."""
    x, y, z = CAMERA_PLACE
    # The webcam looks where the tool points, with its picture's top along the tool's x axis.
    inside = f"""
      <body name="flange" pos="0 0 {FLANGE}" euler="0 0 {TOOL_TURN}">
        <site name="{TOOL}" size=".004" group="4"/>
        <camera name="{WRIST_CAMERA}" pos="{x} {y} {z}" xyaxes="0 1 0 1 0 0" fovy="{field_of_view}"/>
        <geom type="box" size=".030 .020 .003" pos=".025 0 .003" material="dark"/>
        <geom type="box" size=".013 .045 .011" pos="{x} {y} {z - 0.017}" material="black"/>
        <geom type="cylinder" size=".010 .003" pos="{x} {y} {z - 0.004}" material="dark"/>
      </body>
    """
    for number, (a, alpha, d) in reversed(list(enumerate(PANDA_DH))):
        place = f"{a} {-d * math.sin(alpha)} {d * math.cos(alpha)}"
        inside = f"""
          <body name="link {number + 1}" pos="{place}" euler="{alpha} 0 0">
            <joint name="joint {number + 1}" axis="0 0 1"/>
            {shapes_xml(_ROUND[number], "capsule")}
            {shapes_xml(_FLAT[number])}
            {inside}
          </body>
        """
    return inside
