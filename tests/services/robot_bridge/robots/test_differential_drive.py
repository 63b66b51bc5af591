"""A robot on two wheels goes where its wheels take it, stops at walls, and turns over where it climbs them."""

import math

import mujoco
import numpy as np
import pytest

from services.robot_bridge.robots.arena import Arena
from services.robot_bridge.robots.differential_drive import PERIOD_NS, Chassis, DifferentialDrive, Leg

MS = 1_000_000
MODEL = """
<mujoco>
  <worldbody>
    <body name="robot">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><joint axis="0 0 1"/><joint axis="1 0 0"/>
      <geom size=".1"/>
    </body>
  </worldbody>
</mujoco>
"""
AT_WALL = np.array([0.9, 0.0, 0.0])


def build(lag=0.0, **chassis):
    """A round robot of 10 cm radius, its wheels 20 cm apart, in an arena of 2 m x 1 m."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    return DifferentialDrive(model, mujoco.MjData(model), Chassis(0.2, 0.1, lag, **chassis), Arena(2.0, 1.0, 0.3))


def driven(drive, left, right, duration_ms):
    drive.command(left, right)
    drive.advance(duration_ms * MS)
    return drive.pose


def test_equal_speeds_go_straight_on():
    drive = build()
    np.testing.assert_allclose(driven(drive, 0.3, 0.3, 1000), [0.3, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(driven(drive, -0.1, -0.1, 1000), [0.2, 0.0, 0.0], atol=1e-12)


def test_opposite_speeds_turn_on_the_spot():
    # The rims of 10 cm radius at 0.1 m/s: 1 rad/s.
    np.testing.assert_allclose(driven(build(), -0.1, 0.1, 1000), [0.0, 0.0, 1.0], atol=1e-12)


def test_a_faster_right_wheel_drives_an_arc_to_the_left():
    # 0.2 m/s and 1 rad/s: a circle of 0.2 m radius.
    np.testing.assert_allclose(driven(build(), 0.1, 0.3, 1000), [0.168294, 0.091940, 1.0], rtol=1e-4)


def test_the_model_shows_where_the_robot_is():
    drive = build()
    driven(drive, 0.1, 0.3, 503)
    np.testing.assert_allclose(drive._data.qpos, [*drive.pose, 0.0])
    np.testing.assert_allclose(drive._data.body("robot").xpos[:2], drive.pose[:2])


def test_wheels_follow_with_a_lag():
    drive = build(lag=0.1)
    driven(drive, 0.3, -0.3, 100)
    # 1 - 1/e of it after the lag's time.
    np.testing.assert_allclose(drive.wheel_speeds, [0.189636, -0.189636], rtol=1e-5)


def test_the_portions_in_which_time_comes_change_nothing():
    whole, parts = build(lag=0.1), build(lag=0.1)
    portions = np.random.default_rng(0).integers(1, 12 * MS, 200)
    for drive in (whole, parts):
        drive.command(0.3, 0.25)
    for portion in portions:
        parts.advance(int(portion))
    whole.advance(int(portions.sum()))
    np.testing.assert_array_equal(parts.pose, whole.pose)
    np.testing.assert_array_equal(parts.wheel_speeds, whole.wheel_speeds)


def test_within_a_period_everything_changes_evenly():
    drive = build()
    drive.command(0.3, 0.3)
    places = []
    for _ in range(5):
        drive.advance(PERIOD_NS // 5)
        places.append(drive.pose[0])
    np.testing.assert_allclose(places, [0.0003, 0.0006, 0.0009, 0.0012, 0.0015], rtol=1e-9)


def test_a_command_counts_from_the_next_period_on():
    drive = build()
    drive.advance(2 * MS)
    driven(drive, 0.3, 0.3, 3)
    assert drive.pose[0] == 0
    drive.advance(5 * MS)
    assert drive.pose[0] == pytest.approx(0.0015)


def test_a_stopped_robot_brakes_and_rests_until_the_next_command():
    drive = build()
    driven(drive, 0.3, -0.3, 100)
    driven(drive, 0.3, 0.3, 500)
    before = drive.pose[0]
    drive.stop()
    drive.advance(40 * MS)
    # 7.5 m/s^2 take .0375 m/s in each of 8 periods: (7 + 6 + ... + 1) * .0375 m/s * 5 ms.
    heading = drive.pose[2]
    assert (drive.pose[0] - before) / math.cos(heading) == pytest.approx(0.00525)
    np.testing.assert_array_equal(drive.wheel_speeds, 0)
    at_rest = drive.pose
    drive.advance(10_000 * MS)
    np.testing.assert_array_equal(drive.pose, at_rest)


def test_a_wall_stops_the_robot_and_it_slides_along():
    drive = build()
    np.testing.assert_allclose(driven(drive, 0.5, 0.5, 3000), AT_WALL)
    drive.place(np.array([0.9, 0.0, math.pi / 4]))
    np.testing.assert_allclose(driven(drive, 0.2, 0.2, 1000), [0.9, 0.2 / math.sqrt(2), math.pi / 4])
    np.testing.assert_allclose(driven(drive, 0.2, 0.2, 3000), [0.9, 0.4, math.pi / 4])


def test_nobody_can_put_it_into_a_wall():
    drive = build()
    drive.place(np.array([5.0, -5.0, 1.0]))
    np.testing.assert_array_equal(drive.pose, [0.9, -0.4, 1.0])


def test_a_manoeuvre_leads_where_its_commands_lead_and_ends_at_rest():
    legs = [Leg(-0.1, 0.1, 0.5), Leg(0.3, 0.3, 1.0), Leg(0.1, -0.2, 0.25)]
    at_once, driving = build(lag=0.1), build(lag=0.1)
    at_once.drive(legs)
    for leg in legs:
        driven(driving, leg.left, leg.right, round(leg.duration * 1000))
    np.testing.assert_allclose(at_once.pose, driving.pose, atol=1e-12)
    np.testing.assert_array_equal(at_once.wheel_speeds, 0)
    before = at_once.pose
    at_once.advance(1000 * MS)
    np.testing.assert_array_equal(at_once.pose, before)


# ---------------------------------------------------------------------- turning over


def climber(pose=AT_WALL):
    drive = build(tips_after=0.5, tips_from=0.05)
    drive.place(pose)
    return drive


def test_who_drives_against_a_wall_for_too_long_turns_over_and_stays_there():
    drive = climber()
    driven(drive, 0.1, 0.1, 495)
    assert not drive.on_its_back
    drive.advance(20 * MS)
    assert drive.on_its_back
    assert drive._data.qpos[3] == math.pi
    np.testing.assert_array_equal(driven(drive, -0.3, -0.3, 1000), AT_WALL)
    np.testing.assert_allclose(drive.wheel_speeds, -0.3)  # in the air
    drive.place(drive.pose)
    assert not drive.on_its_back
    assert drive._data.qpos[3] == 0
    assert driven(drive, -0.3, -0.3, 1000)[0] == pytest.approx(0.6)


def test_who_lets_go_of_the_wall_in_between_does_not_turn_over():
    drive = climber()
    for _ in range(5):
        driven(drive, 0.1, 0.1, 400)
        driven(drive, -0.1, -0.1, 50)
        driven(drive, 0.1, 0.1, 50)
    assert not drive.on_its_back


@pytest.mark.parametrize(("pose", "speed"), [(AT_WALL, 0.04), (AT_WALL, -0.3), ([0.9, 0.0, math.pi], -0.3)])
def test_who_is_slow_or_drives_backwards_does_not_turn_over(pose, speed):
    drive = climber(np.array(pose))
    driven(drive, speed, speed, 5000)
    assert not drive.on_its_back
