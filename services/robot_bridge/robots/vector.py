"""A Vector, the small home robot, in an arena with its charger, which bears a black marker (thesis 8.1.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from services.robot_bridge.mujoco_without_opengl import mujoco
from services.robot_bridge.robots.arena import FRONT_CAMERA, Arena, Look, scene_xml
from services.robot_bridge.robots.differential_drive import Chassis, DifferentialDrive
from services.robot_bridge.robots.wheeled_robot import MILLIMETRE, Battery, WheeledRobot

STATE_PERIOD_NS = 60_000_000
"""Between two messages of the robot's state (thesis 8.1.3)."""
IMAGES_HZ = 5
"""One every 200 ms (thesis 8.1.3)."""
TRACK = 0.048
"""m, between the treads."""
RADIUS = 0.045
"""m, from the middle between the treads to the front."""
LONGEST_PROXIMITY = 400.0
"""mm: the proximity sensor sees no farther."""
TIPS_FROM = 0.05
"""m/s: slower than this the shovel at its front does not climb a wall."""
CAMERA_FORWARD, CAMERA_HEIGHT = 0.02, 0.045
"""m, of the camera in the robot's face, in front of the middle between the treads and above the floor."""
_AXIS_HEIGHT = 0.03
"""m, of the axis about which it turns over."""
LOOK = Look(
    floor=".72 .72 .70",
    floor_tile=".68 .68 .66",
    wall=".80 .72 .60",
    room_camera='pos="-.60 -.54 .66" xyaxes=".660 -.751 0 .512 .450 .732" fovy="42"',
)


@dataclass(frozen=True)
class Marker:
    """The black symbol on the charger, which stands at the middle of the short wall at x > 0."""

    width: float
    """m."""
    height: float
    """m."""
    above_floor: float = 0.01
    """m, of its lower edge."""


class Vector(WheeledRobot):
    """The robot and its arena."""

    def __init__(
        self, arena: Arena, marker: Marker, *, lag: float, battery: Battery, tips_after: float, field_of_view: float
    ) -> None:
        """Args:
        arena: in which it drives.
        marker: on the charger.
        lag: of the wheels, s.
        battery: of the robot.
        tips_after: s of driving against a wall, without a break, after which it lies on its back.
        field_of_view: of the camera, degrees, from its picture's top to its bottom.
        """
        model = mujoco.MjModel.from_xml_string(vector_scene_xml(arena, marker, field_of_view))
        data = mujoco.MjData(model)
        chassis = Chassis(TRACK, RADIUS, lag, tips_after, TIPS_FROM)
        off_charger = np.array([arena.length / 2 - 3 * RADIUS, 0.0, math.pi])
        super().__init__(model, data, DifferentialDrive(model, data, chassis, arena), battery, off_charger)

    def sense(self) -> np.ndarray:
        """Return what lies how far ahead, mm, and the speeds of the left and the right wheel, mm/s."""
        x, y, heading = self.drive.pose
        ahead = self.drive.arena.distances(x, y, np.array([heading])) - RADIUS
        proximity = np.clip(ahead / MILLIMETRE, 0.0, LONGEST_PROXIMITY)
        return np.concatenate([proximity, self.drive.wheel_speeds / MILLIMETRE])


def vector_scene_xml(arena: Arena, marker: Marker, field_of_view: float) -> str:
    """Return the scene as MJCF."""
    wall = arena.length / 2
    middle = marker.above_floor + marker.height / 2
    plate_width, plate_height = marker.width / 2 + 0.025, (marker.above_floor + marker.height + 0.015) / 2
    targets = f"""
      <geom type="box" pos="{wall - 0.003} 0 {plate_height}" size=".003 {plate_width} {plate_height}" material="light"/>
      <geom name="marker" type="box" pos="{wall - 0.007} 0 {middle}" size=".001 {marker.width / 2} {marker.height / 2}"
        material="marker"/>
    """
    robot = f"""
      <joint name="roll" axis="1 0 0" pos="0 0 {_AXIS_HEIGHT}"/>
      <geom type="box" pos="-.012 0 .024" size=".030 .016 .014" material="grey"/>
      <geom type="box" pos="-.014 0 .041" size=".022 .014 .005" material="light"/>
      <geom type="box" pos="-.004 .022 .014" size=".030 .005 .010" material="tread"/>
      <geom type="box" pos="-.004 -.022 .014" size=".030 .005 .010" material="tread"/>
      <geom type="cylinder" pos="-.034 .022 .014" size=".010 .0052" zaxis="0 1 0" material="tread"/>
      <geom type="cylinder" pos="-.034 -.022 .014" size=".010 .0052" zaxis="0 1 0" material="tread"/>
      <geom type="cylinder" pos=".026 .022 .014" size=".010 .0052" zaxis="0 1 0" material="tread"/>
      <geom type="cylinder" pos=".026 -.022 .014" size=".010 .0052" zaxis="0 1 0" material="tread"/>
      <geom type="box" pos=".006 0 .046" size=".011 .016 .012" material="grey"/>
      <geom type="box" pos=".0172 0 .048" size=".0006 .013 .009" material="face"/>
      <geom type="box" pos=".0180 .005 .051" size=".0004 .0025 .003" material="eye"/>
      <geom type="box" pos=".0180 -.005 .051" size=".0004 .0025 .003" material="eye"/>
      <geom type="box" pos=".043 0 .010" size=".002 .028 .008" material="tread"/>
      <camera name="{FRONT_CAMERA}" pos="{CAMERA_FORWARD} 0 {CAMERA_HEIGHT}" xyaxes="0 -1 0 0 0 1"
        fovy="{field_of_view}"/>
    """
    materials = """
    <material name="marker" rgba=".03 .03 .03 1" specular="0"/>
    <material name="tread" rgba=".14 .14 .15 1" specular="0"/>
    <material name="face" rgba=".06 .07 .09 1" specular=".3"/>
    <material name="eye" rgba=".20 .85 .75 1" emission=".8" specular="0"/>
    """
    return scene_xml("vector_charger_detector", arena, LOOK, targets=targets, materials=materials, robot=robot)
