"""Create and Vector: what they feel, and how they come to the start of an attempt."""

import math

import numpy as np
import pytest

from services.robot_bridge.robots.arena import Arena
from services.robot_bridge.robots.create import Create, Papers
from services.robot_bridge.robots.differential_drive import Leg
from services.robot_bridge.robots.vector import Marker, Vector
from services.robot_bridge.robots.wheeled_robot import STAYS, Battery, start

SECOND = 1_000_000_000
NO_GOAL = np.zeros(0)
AHEAD = np.array([0.3, 0.1, 0.0])


def create(life=100.0):
    arena, papers = Arena(2.2, 1.4, 0.6), Papers(0.3, 0.28)
    return Create(arena, papers, lag=0.0, battery=Battery(life, 0.25), camera_height=0.28, field_of_view=55.0)


def vector(life=100.0):
    arena, marker = Arena(0.6, 0.45, 0.16), Marker(0.12, 0.08)
    return Vector(arena, marker, lag=0.0, battery=Battery(life, 0.25), tips_after=1.0, field_of_view=50.0)


def placed(robot, pose, *legs):
    robot.place(NO_GOAL, start(np.array(pose), legs))
    return robot


# ---------------------------------------------------------------------- senses


def test_wall_sensors_fall_off_with_the_distance_from_the_rim_to_the_wall():
    # The wall is 24 cm from the middle; rays at 12, 38 and 65 degrees reach it after .2454, .3046 and .5679 m, and
    # start at the rim, 17 cm out: 4095 exp(-(.2454 - .17) / .035) and so on.
    right = [475.48, 87.60, 0.04732]
    np.testing.assert_allclose(placed(create(), [0.86, 0.0, 0.0]).sense(), [*right[::-1], *right], rtol=1e-3)


def test_the_left_sensors_look_to_the_left():
    # At the arena's left long wall, driving along it.
    signals = placed(create(), [0.0, 0.53, 0.0]).sense()
    assert signals[0] > signals[1] > signals[2] > signals[5]
    assert signals[0] > 2000


def test_no_signal_is_stronger_than_the_strongest():
    for heading in np.linspace(0, 2 * math.pi, 50):
        signals = placed(create(), [0.93, 0.53, heading]).sense()
        assert (signals >= 0).all()
        assert (signals <= 4095).all()


@pytest.mark.parametrize(("heading", "proximity"), [(0.0, 155.0), (math.pi, 355.0), (math.pi / 2, 180.0)])
def test_proximity_is_the_way_from_the_front_to_the_wall_in_mm(heading, proximity):
    sensed = placed(vector(), [0.1, 0.0, heading]).sense()
    np.testing.assert_allclose(sensed, [proximity, 0.0, 0.0], atol=1e-9)


def test_proximity_sees_no_farther_than_400_mm():
    assert placed(vector(), [-0.25, 0.0, 0.0]).sense()[0] == 400.0


def test_wheels_turn_as_commanded_left_and_right_in_mm_a_second():
    robot = placed(vector(), [-0.2, 0.0, 0.0])
    robot.command(np.array([50.0, 80.0]))
    robot.advance(SECOND)
    np.testing.assert_allclose(robot.sense()[1:], [50.0, 80.0])
    assert robot.drive.pose[2] == pytest.approx(0.03 / 0.048)
    robot.stop()
    robot.advance(SECOND)
    np.testing.assert_array_equal(robot.sense()[1:], 0.0)


# ---------------------------------------------------------------------- starts


def test_a_start_is_driven_to_from_where_someone_has_put_the_robot_or_from_where_it_is():
    robot = placed(create(), AHEAD, Leg(-0.3, -0.3, 1.0))
    np.testing.assert_allclose(robot.drive.pose, [0.0, 0.1, 0.0], atol=1e-12)
    placed(robot, STAYS, Leg(0.3, 0.3, 0.5))
    np.testing.assert_allclose(robot.drive.pose, [0.15, 0.1, 0.0], atol=1e-12)
    np.testing.assert_array_equal(robot.drive.wheel_speeds, 0)


@pytest.mark.parametrize("build", [create, vector])
def test_a_low_battery_is_recharged_by_a_reset_and_by_nothing_else(build):
    robot = placed(build(life=10.0), [-0.1, 0.1, 0.0])
    robot.advance(7 * SECOND)
    placed(robot, STAYS)
    assert robot.charge == pytest.approx(0.3)
    assert robot.counters()["recharges"] == 0
    robot.advance(SECOND)
    placed(robot, STAYS)
    assert (robot.charge, robot.counters()["recharges"]) == (1.0, 1)
    assert math.hypot(*(robot.drive.pose[:2] - [-0.1, 0.1])) > 0.2  # at its charger
    robot.advance(100 * SECOND)
    assert robot.charge == 0.0


def test_a_robot_on_its_back_is_put_on_its_wheels_by_a_reset():
    robot = placed(vector(), [0.255, 0.0, 0.0])
    robot.command(np.array([100.0, 100.0]))
    robot.advance(2 * SECOND)
    assert robot.drive.on_its_back
    assert robot.data.body("robot").xmat[8] == pytest.approx(-1)  # its z points down
    placed(robot, STAYS, Leg(-0.1, -0.1, 1.0))
    assert not robot.drive.on_its_back
    assert robot.counters()["recoveries"] == 1
    np.testing.assert_allclose(robot.drive.pose, [0.155, 0.0, 0.0], atol=1e-12)
    assert robot.data.body("robot").xmat[8] == pytest.approx(1)
    placed(robot, STAYS)
    assert robot.counters()["recoveries"] == 1
