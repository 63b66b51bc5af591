"""The room in which an arm stands on a table: what all scenes with an arm have in common, as parts of MJCF.

Made of a few plain shapes, which render many times faster than meshes.
"""

from __future__ import annotations

from collections.abc import Iterable

Point = tuple[float, float, float]
"""m."""
Shape = tuple[str, float, Point, Point]
"""Material, radius and the two ends of its axis, m."""
VISUALS = """
  <compiler angle="radian"/>
  <option gravity="0 0 0"/>
  <visual>
    <headlight ambient=".42 .42 .42" diffuse=".28 .28 .28" specular="0 0 0"/>
    <map znear=".004" zfar="12" shadowclip="2"/>
    <quality numslices="24" numstacks="2"/>
  </visual>
  <default>
    <geom contype="0" conaffinity="0"/>
  </default>
"""
MATERIALS = """
    <texture name="floor" type="2d" builtin="checker" width="64" height="64" rgb1=".40 .42 .45" rgb2=".36 .38 .41"/>
    <material name="floor" texture="floor" texrepeat="6 6" texuniform="true" specular="0"/>
    <material name="wall" rgba=".80 .81 .79 1" specular="0"/>
    <material name="table" rgba=".66 .55 .42 1" specular="0"/>
    <material name="leg" rgba=".30 .31 .33 1" specular="0"/>
    <material name="dark" rgba=".16 .17 .18 1" specular=".2"/>
    <material name="black" rgba=".05 .05 .06 1" specular="0"/>
"""
TABLE_HALF_WIDTH = 0.75
"""m."""


def table_xml(x: float, y: float, half_width: float = TABLE_HALF_WIDTH) -> str:
    """Return a floor and a square table on it, its top at height 0 and its middle at (x, y), metres."""
    legs = "\n".join(
        f'<geom type="box" size=".03 .03 .35" pos="{x + across} {y + along} -.39" material="leg"/>'
        for across in (0.06 - half_width, half_width - 0.06)
        for along in (0.06 - half_width, half_width - 0.06)
    )
    return f"""
    <geom name="floor" type="plane" size="4 4 .1" pos="0 0 -.74" material="floor"/>
    <geom name="table" type="box" size="{half_width} {half_width} .02" pos="{x} {y} -.02" material="table"/>
    {legs}
    """


def shapes_xml(shapes: Iterable[Shape], kind: str = "cylinder") -> str:
    """Return shapes as geometries, all of one kind: ``cylinder`` or ``capsule``."""
    return "\n".join(
        f'<geom type="{kind}" size="{radius}" fromto="{_text(start)} {_text(end)}" material="{material}"/>'
        for material, radius, start, end in shapes
    )


def _text(point: Point) -> str:
    return " ".join(str(coordinate) for coordinate in point)
