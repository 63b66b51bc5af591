"""A Create 2 with a webcam in a wooden arena with two green papers (thesis 4.3.2)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from services.robot_bridge.mujoco_without_opengl import mujoco
from services.robot_bridge.robots.arena import FRONT_CAMERA, Arena, Look, scene_xml
from services.robot_bridge.robots.differential_drive import Chassis, DifferentialDrive
from services.robot_bridge.robots.wheeled_robot import Battery, WheeledRobot

PACKET_PERIOD_NS = 15_000_000
"""Between two packets of the sensors (Open Interface specification, "Stream")."""
TRACK = 0.235
"""m, between the wheels (Open Interface specification, "Drive")."""
RADIUS = 0.17
"""m, of the round body."""
STRONGEST_SIGNAL = 4095.0
"""Of a wall sensor (Open Interface specification, "Light Bump Signal")."""
WALL_SENSORS = np.radians([65.0, 38.0, 12.0, -12.0, -38.0, -65.0])
"""rad, where the six wall sensors on the bumper look, from left to right."""
SIGNAL_RANGE = 0.035
"""m, over which a wall sensor's signal falls to 37 %: at 10 cm it is about 6 %."""
CAMERA_FORWARD = 0.05
"""m, of the webcam in front of the wheels' axis."""
DOCK_WIDTH = 0.16
LOOK = Look(
    floor=".66 .65 .62",
    floor_tile=".61 .60 .57",
    wall=".72 .60 .45",
    room_camera='pos="1.05 -2.05 2.2" xyaxes=".89 .456 0 -.319 .623 .714" fovy="42"',
)


@dataclass(frozen=True)
class Papers:
    """The two green squares in the middle of the short walls."""

    size: float
    """m, of their sides."""
    height: float
    """m, of their middles above the floor."""


class Create(WheeledRobot):
    """The robot, its webcam and its arena."""

    def __init__(
        self, arena: Arena, papers: Papers, *, lag: float, battery: Battery, camera_height: float, field_of_view: float
    ) -> None:
        """Args:
        arena: in which it drives.
        papers: on its short walls.
        lag: of the wheels, s.
        battery: of the robot.
        camera_height: of the webcam above the floor, m.
        field_of_view: of the webcam, degrees, from its picture's top to its bottom.
        """
        model = mujoco.MjModel.from_xml_string(create_scene_xml(arena, papers, camera_height, field_of_view))
        data = mujoco.MjData(model)
        drive = DifferentialDrive(model, data, Chassis(TRACK, RADIUS, lag), arena)
        at_dock = np.array([0.0, arena.width / 2, math.pi / 2])
        super().__init__(model, data, drive, battery, at_dock)

    def sense(self) -> np.ndarray:
        """Return the six wall sensors' signals, 0 (no wall in sight) to 4095 (at the wall), from left to right."""
        x, y, heading = self.drive.pose
        distances = self.drive.arena.distances(x, y, heading + WALL_SENSORS) - RADIUS
        return STRONGEST_SIGNAL * np.exp(-np.maximum(distances, 0.0) / SIGNAL_RANGE)


def create_scene_xml(arena: Arena, papers: Papers, camera_height: float, field_of_view: float) -> str:
    """Return the scene as MJCF."""
    at_wall = arena.length / 2 - 0.002
    size = f".0015 {papers.size / 2} {papers.size / 2}"
    targets = "\n".join(
        f'<geom name="{name} paper" type="box" pos="{x} 0 {papers.height}" size="{size}" material="paper"/>'
        for name, x in (("east", at_wall), ("west", -at_wall))
    )
    dock = arena.width / 2
    targets += f"""
      <geom type="box" pos="0 {dock - 0.008} .045" size="{DOCK_WIDTH / 2} .008 .045" material="dark"/>
      <geom type="box" pos="0 {dock - 0.040} .004" size="{DOCK_WIDTH / 2} .040 .004" material="dark"/>
      <geom type="cylinder" pos="0 {dock - 0.016} .075" size=".012 .002" zaxis="0 1 0" material="light"/>
    """
    mast = camera_height - 0.02
    robot = f"""
      <geom type="cylinder" pos="0 0 .048" size="{RADIUS} .034" material="dark"/>
      <geom type="cylinder" pos="0 0 .083" size="{RADIUS - 0.012} .003" material="light"/>
      <geom type="cylinder" pos="0 0 .087" size=".048 .002" material="grey"/>
      <geom type="cylinder" pos="0 {TRACK / 2} .036" size=".036 .011" zaxis="0 1 0" material="tyre"/>
      <geom type="cylinder" pos="0 {-TRACK / 2} .036" size=".036 .011" zaxis="0 1 0" material="tyre"/>
      <geom type="box" pos="-.075 0 .106" size=".050 .040 .016" material="board"/>
      <geom type="box" pos="-.075 0 .126" size=".030 .030 .006" material="grey"/>
      <geom type="cylinder" fromto=".018 0 .085 .018 0 {mast}" size=".007" material="grey"/>
      <geom type="box" pos=".028 0 {camera_height}" size=".014 .045 .014" material="dark"/>
      <geom type="cylinder" pos=".043 0 {camera_height}" size=".009 .002" zaxis="1 0 0" material="grey"/>
      <camera name="{FRONT_CAMERA}" pos="{CAMERA_FORWARD} 0 {camera_height}" xyaxes="0 -1 0 0 0 1"
        fovy="{field_of_view}"/>
    """
    materials = """
    <material name="paper" rgba=".10 .66 .20 1" emission=".25" specular="0"/>
    <material name="tyre" rgba=".10 .10 .11 1" specular="0"/>
    <material name="board" rgba=".16 .20 .28 1" specular=".2"/>
    """
    return scene_xml("create_reacher", arena, LOOK, targets=targets, materials=materials, robot=robot)
