"""The Panda's published kinematics, and the bag in front of it."""

import math

import mujoco
import numpy as np
import pytest

from services.robot_bridge.robots.franka import Franka, franka_limits
from services.robot_bridge.robots.franka_scene import TOOL, WRIST_CAMERA, BeanBag, FrankaScene

POSTURE = [0.0, 0.13, 0.02, -2.1, 0.03, 2.1, 0.8]
PUBLISHED = [
    # a m, alpha rad, d m, of each joint and of the flange: Franka Control Interface documentation, Craig's convention
    (0, 0, 0.333),
    (0, -np.pi / 2, 0),
    (0, np.pi / 2, 0.316),
    (0.0825, np.pi / 2, 0),
    (-0.0825, -np.pi / 2, 0.384),
    (0, np.pi / 2, 0),
    (0.088, np.pi / 2, 0),
    (0, 0, 0.107),
]


@pytest.fixture
def scene():
    return FrankaScene(BeanBag(radius=0.05, height=0.04), 43.3)


def show(scene, angles):
    scene.data.qpos[:] = angles
    mujoco.mj_kinematics(scene.model, scene.data)
    mujoco.mj_camlight(scene.model, scene.data)


def published_flange(angles):
    """(4, 4) pose of the flange: the product of the table's transformations."""
    pose = np.eye(4)
    for theta, (a, alpha, d) in zip([*angles, 0.0], PUBLISHED, strict=True):
        c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        pose = pose @ np.array(
            [[c, -s, 0, a], [s * ca, c * ca, -sa, -d * sa], [s * sa, c * sa, ca, d * ca], [0, 0, 0, 1]]
        )
    return pose


@pytest.mark.parametrize(
    ("angles", "position"),
    [
        # All links upright, but for the last, which hangs: .333 + .316 + .384 - .107, and .088 forward.
        ([0, 0, 0, 0, 0, 0, 0], [0.088, 0, 0.926]),
        # The forearm level, .0825 above the elbow: .0825 + .384 + .088 forward, .333 + .316 + .0825 - .107 up.
        ([0, 0, 0, -math.pi / 2, 0, math.pi / 2, 0.3], [0.5545, 0, 0.6245]),
        # The same, turned to the left.
        ([math.pi / 2, 0, 0, -math.pi / 2, 0, math.pi / 2, -0.4], [0, 0.5545, 0.6245]),
    ],
)
def test_the_flange_is_where_it_is_by_hand(scene, angles, position):
    show(scene, angles)
    np.testing.assert_allclose(scene.data.site(TOOL).xpos, position, atol=1e-9)
    np.testing.assert_allclose(scene.data.site(TOOL).xmat.reshape(3, 3)[:, 2], [0, 0, -1], atol=1e-9)


def test_the_flange_is_where_the_published_table_puts_it(scene):
    # The tool is turned against the flange by -45 degrees, as the manufacturer's hand.
    half = math.sqrt(0.5)
    turn = np.array([[half, half, 0], [-half, half, 0], [0, 0, 1]])
    for angles in np.random.default_rng(0).uniform(-np.pi, np.pi, (20, 7)):
        show(scene, angles)
        pose = published_flange(angles)
        np.testing.assert_allclose(scene.data.site(TOOL).xpos, pose[:3, 3], atol=1e-9)
        np.testing.assert_allclose(scene.data.site(TOOL).xmat.reshape(3, 3), pose[:3, :3] @ turn, atol=1e-9)


def test_the_webcam_looks_down_where_the_tool_points_and_its_picture_is_upright(scene):
    show(scene, [0, 0, 0, -math.pi / 2, 0, math.pi / 2, math.pi / 4])
    camera = scene.data.cam(WRIST_CAMERA)
    # The tool points down: .05 in front of the flange and .02 below it; the picture's top is away from the arm.
    np.testing.assert_allclose(camera.xpos, [0.5545 + 0.05, 0, 0.6245 - 0.02], atol=1e-9)
    right, up, back = camera.xmat.reshape(3, 3).T
    np.testing.assert_allclose(back, [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(up, [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(right, [0, -1, 0], atol=1e-9)


def test_the_bag_lies_on_the_table_where_it_was_put(scene):
    scene.put_bag(np.array([0.55, -0.05]))
    show(scene, POSTURE)
    bag, table = scene.data.geom("bag"), scene.data.geom("table")
    np.testing.assert_allclose(bag.xpos[:2], [0.55, -0.05])
    half_height = scene.model.geom("bag").size[2]
    assert bag.xpos[2] + half_height == pytest.approx(0.04)
    assert bag.xpos[2] - half_height < table.xpos[2] + scene.model.geom("table").size[2] == 0
    np.testing.assert_allclose(scene.model.geom("bag").size[:2], 0.05)


def test_the_robot_feels_seven_angles_and_seven_velocities_and_no_joint_turns_too_fast(scene):
    robot = Franka(scene, franka_limits(5.0, np.full(3, -9.0), np.full(3, 9.0)), max_speed=0.2)
    robot.place(np.array([0.6, 0.0]), np.array(POSTURE))
    np.testing.assert_array_equal(robot.sense(), [*POSTURE, *[0] * 7])
    robot.command(np.array([0.1, -0.2, 1.0, -0.04, 0.1, -0.3, 0.0]))
    robot.advance(8_000_000)
    # Clipped to .2 rad/s; the fastest lead with 5 rad/s^2: .04 rad/s in 8 ms, a fifth of the way.
    np.testing.assert_allclose(robot.sense()[7:], [0.02, -0.04, 0.04, -0.008, 0.02, -0.04, 0], atol=1e-12)
    robot.advance(32_000_000)
    np.testing.assert_allclose(robot.sense()[7:], [0.1, -0.2, 0.2, -0.04, 0.1, -0.2, 0], atol=1e-12)


def test_no_joint_turns_beyond_what_the_mechanics_allow(scene):
    robot = Franka(scene, franka_limits(5.0, np.full(3, -9.0), np.full(3, 9.0)), max_speed=2.0)
    # The elbow turns back at -.2 rad. Too late: at 5 rad/s^2 it is there at 1.7 rad/s, and needs .3 rad to stop.
    robot.place(np.array([0.6, 0.0]), np.array([0, 0.13, 0.02, -0.5, 0.03, 2.1, 0.8]))
    robot.command(np.array([0, 0, 0, 2.0, 0, 0, 0]))
    elbow = []
    for _ in range(75):
        robot.advance(8_000_000)
        elbow.append(robot.sense()[3])
    assert max(elbow) == -0.0698
    assert elbow[-1] < -0.0698
