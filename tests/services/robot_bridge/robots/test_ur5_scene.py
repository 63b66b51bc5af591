"""The UR5's published kinematics, and what stands in front of it."""

import mujoco
import numpy as np
import pytest

from services.robot_bridge.robots.ur5 import Ur5, ur5_limits
from services.robot_bridge.robots.ur5_scene import TOOL, WRIST_CAMERA, Monitor, Ur5Scene

MONITOR = Monitor(
    distance=0.78, x=-0.05, z=0.5, width=0.53, height=0.298125, target_radius=7 / 160, target_margin=0.125
)
POSTURE = [1.5707, -2.0, 2.1, -3.0415, -1.5707, 3.1415]
PUBLISHED = [
    # a m, alpha rad, d m: Universal Robots, "DH parameters for calculations of kinematics and dynamics", UR5
    (0, np.pi / 2, 0.089159),
    (-0.425, 0, 0),
    (-0.39225, 0, 0),
    (0, np.pi / 2, 0.10915),
    (0, -np.pi / 2, 0.09465),
    (0, 0, 0.0823),
]


@pytest.fixture
def scene():
    return Ur5Scene(MONITOR, 43.3)


def show(scene, angles):
    scene.data.qpos[:] = angles
    mujoco.mj_kinematics(scene.model, scene.data)
    mujoco.mj_camlight(scene.model, scene.data)


def published_tool(angles):
    """(4, 4) pose of the tool: the product of the table's transformations, in a base that is turned by half a turn."""
    pose = np.diag([-1.0, -1.0, 1.0, 1.0])
    for theta, (a, alpha, d) in zip(angles, PUBLISHED, strict=True):
        c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        pose = pose @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
    return pose


def test_the_tool_is_where_it_was_measured_for_the_start_posture(scene):
    show(scene, POSTURE)
    np.testing.assert_allclose(scene.data.site(TOOL).xpos, [-0.109, 0.313, 0.513], atol=5e-4)


def test_the_tool_is_where_the_published_table_puts_it(scene):
    for angles in np.random.default_rng(0).uniform(-np.pi, np.pi, (20, 6)):
        show(scene, angles)
        pose = published_tool(angles)
        np.testing.assert_allclose(scene.data.site(TOOL).xpos, pose[:3, 3], atol=1e-9)
        np.testing.assert_allclose(scene.data.site(TOOL).xmat.reshape(3, 3), pose[:3, :3], atol=1e-9)


def test_the_stretched_arm_reaches_as_far_as_its_links_are_long(scene):
    show(scene, np.zeros(6))
    # Along x: the two tubes; along y: d4 and d6; up: d1 less d5.
    np.testing.assert_allclose(
        scene.data.site(TOOL).xpos, [0.425 + 0.39225, 0.10915 + 0.0823, 0.089159 - 0.09465], atol=1e-9
    )


def test_the_webcam_looks_where_the_tool_points_and_stands_in_front_of_it(scene):
    show(scene, POSTURE)
    tool, camera = published_tool(POSTURE), scene.data.cam(WRIST_CAMERA)
    np.testing.assert_allclose(-camera.xmat.reshape(3, 3)[:, 2], tool[:3, 2], atol=1e-9)
    np.testing.assert_allclose(camera.xpos, tool[:3, 3] + 0.03 * tool[:3, 2], atol=1e-9)
    up = camera.xmat.reshape(3, 3)[:, 1]
    assert up[2] > 0.9  # in the start posture, the picture is upright


def test_the_target_keeps_its_distance_from_the_monitors_edges(scene):
    # 27/160 of 0.53 m: 0.0894 m from the edges to the middle of the target.
    np.testing.assert_allclose(MONITOR.target_range(), [0.265 - 0.0894375, 0.1490625 - 0.0894375])


def test_the_target_is_shown_where_it_was_put(scene):
    scene.show_target(np.array([0.1, -0.05]))
    show(scene, POSTURE)
    target, screen = scene.data.geom("target"), scene.data.geom("screen")
    np.testing.assert_allclose((target.xpos - screen.xpos)[[0, 2]], [0.1, -0.05])
    assert target.xpos[1] < screen.xpos[1]  # in front of the screen
    assert scene.model.geom("target").size[0] == pytest.approx(0.0231875)
    np.testing.assert_allclose(np.abs(target.xmat.reshape(3, 3)[:, 2]), [0, 1, 0], atol=1e-12)


def test_the_robot_feels_five_angles_and_five_velocities(scene):
    robot = Ur5(scene, ur5_limits(1.4, np.full(3, -9.0), np.full(3, 9.0)))
    robot.place(np.zeros(2), np.array(POSTURE))
    np.testing.assert_array_equal(robot.sense(), [*POSTURE[:5], *[0] * 5])
    robot.command(np.array([0.1, -0.2, 0.3, -0.4, 0.5]))
    robot.advance(8_000_000)
    # The fifth leads with 1.4 rad/s^2.
    np.testing.assert_allclose(robot.sense()[5:], np.array([0.1, -0.2, 0.3, -0.4, 0.5]) / 0.5 * 0.0112)
