"""A walled rectangle in a room, in which robots on two wheels drive: a MuJoCo model of a few plain shapes.

World frame: metres, z up, the origin on the floor in the arena's middle, x along its length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from services.robot_bridge.robots.base import ROOM_CAMERA

FRONT_CAMERA = "front"
_WALL_THICKNESS = 0.02


@dataclass(frozen=True)
class Arena:
    """The walls' inner sides."""

    length: float
    """m, along x."""
    width: float
    """m, along y."""
    wall_height: float
    """m."""

    def distances(self, x: float, y: float, directions: np.ndarray) -> np.ndarray:
        """Return how far it is (n,) m from a place in the arena to the walls in ``directions`` (n,) rad."""
        return np.minimum(_along(np.cos(directions), self.length / 2, x), _along(np.sin(directions), self.width / 2, y))


def _along(component: np.ndarray, wall: float, place: float) -> np.ndarray:
    """How far it is to the walls at plus and minus ``wall`` along an axis, given the direction's component there."""
    speed = np.maximum(np.abs(component), 1e-9)
    return (wall - place * np.sign(component)) / speed


@dataclass(frozen=True)
class Look:
    """What an arena looks like, besides its sizes. Colours are red, green and blue, 0 to 1."""

    floor: str
    """Of the floor inside."""
    floor_tile: str
    """Of its other tiles."""
    wall: str
    """Of the walls' inner sides."""
    room_camera: str
    """MJCF attributes of the camera that shows the whole arena."""


def scene_xml(name: str, arena: Arena, look: Look, *, targets: str, materials: str, robot: str) -> str:
    """Return the scene as MJCF; its joints are the robot's x, y and yaw; the robot may have one more.

    Args:
        name: of the model.
        arena: its sizes.
        look: its colours.
        targets: what is in the arena besides the robot, as MJCF.
        materials: more materials than the arena's, as MJCF.
        robot: the robot's shapes and cameras, as MJCF; its frame's x points forward, its origin is on the floor.
    """
    half_length, half_width, half_height = arena.length / 2, arena.width / 2, arena.wall_height / 2
    size = max(arena.length, arena.width)
    middle = _WALL_THICKNESS / 2
    walls = "\n".join(
        f'<geom type="box" pos="{x} {y} {half_height}" size="{sx} {sy} {half_height}" material="{material}"/>'
        for x, y, sx, sy, material in (
            (half_length + middle, 0, middle, half_width, "wall"),
            (-half_length - middle, 0, middle, half_width, "wall"),
            (0, half_width + middle, half_length + 2 * middle, middle, "wall"),
            (0, -half_width - middle, half_length + 2 * middle, middle, "wall"),
        )
    )
    # The room's walls stand far behind the arena's, in every direction in which the robot can look over them.
    far, high = 1.9 * size, 0.9 * size
    room = "\n".join(
        f'<geom type="box" pos="{x} {y} {high}" size="{sx} {sy} {high}" material="{material}"/>'
        for x, y, sx, sy, material in (
            (far, 0, 0.01, far, "room"),
            (-far, 0, 0.01, far, "room"),
            (0, far, far, 0.01, "other room"),
            (0, -far, far, 0.01, "other room"),
        )
    )
    return f"""
<mujoco model="{name}">
  <compiler angle="radian"/>
  <option gravity="0 0 0"/>
  <statistic center="0 0 0" extent="{size}"/>
  <visual>
    <headlight ambient=".42 .42 .42" diffuse=".28 .28 .28" specular="0 0 0"/>
    <map znear="{0.004 / size}" zfar="8" shadowclip="3"/>
    <quality numslices="32" numstacks="2"/>
  </visual>
  <default>
    <geom contype="0" conaffinity="0"/>
  </default>
  <asset>
    <texture name="floor" type="2d" builtin="checker" width="64" height="64" rgb1="{look.floor}"
      rgb2="{look.floor_tile}"/>
    <material name="floor" texture="floor" texrepeat="{6 / size} {6 / size}" texuniform="true" specular="0"/>
    <material name="ground" rgba=".47 .47 .48 1" specular="0"/>
    <material name="wall" rgba="{look.wall} 1" specular="0"/>
    <material name="room" rgba=".80 .81 .79 1" specular="0"/>
    <material name="other room" rgba=".72 .74 .76 1" specular="0"/>
    <material name="dark" rgba=".22 .23 .25 1" specular=".2"/>
    <material name="grey" rgba=".52 .54 .56 1" specular=".2"/>
    <material name="light" rgba=".86 .87 .86 1" specular=".2"/>
    {materials}
  </asset>
  <worldbody>
    <light directional="true" pos="{0.45 * size} {-0.45 * size} {1.4 * size}" dir="-.35 .45 -1"
      diffuse=".42 .42 .40" specular=".2 .2 .2"/>
    <camera name="{ROOM_CAMERA}" {look.room_camera}/>
    <geom type="plane" size="{far} {far} .1" pos="0 0 {-0.002 * size}" material="ground"/>
    <geom type="plane" size="{half_length} {half_width} .1" material="floor"/>
    {walls}
    {room}
    {targets}
    <body name="robot">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="y" type="slide" axis="0 1 0"/>
      <joint name="yaw" axis="0 0 1"/>
      {robot}
    </body>
  </worldbody>
</mujoco>
"""
