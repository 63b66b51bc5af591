"""An arm's controller: how it accelerates, where it turns back, and that time may come in any portions."""

import mujoco
import numpy as np
import pytest

from services.robot_bridge.robots.velocity_arm import ArmLimits, VelocityArm

PERIOD_NS = 8_000_000
ACCELERATION = 1.4
# The tool moves on a circle of 1 m about the first two of them.
TWO_HINGES = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body><joint axis="0 0 1"/><geom size=".1"/>
      <body><joint axis="0 1 0"/><geom size=".1"/><site name="tool" pos="1 0 0"/>
        <body><joint axis="1 0 0"/><geom size=".1"/></body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
ANYWHERE = np.full(3, 10.0)


def build(box_low=-ANYWHERE, box_high=ANYWHERE, angle=10.0, mechanical_angle=7.0):
    """The third joint is not commanded."""
    model = mujoco.MjModel.from_xml_string(TWO_HINGES)
    data = mujoco.MjData(model)
    limits = ArmLimits(
        ACCELERATION,
        np.array(box_low),
        np.array(box_high),
        np.full(2, -angle),
        np.full(2, angle),
        np.full(3, -2 * mechanical_angle),
        np.full(3, mechanical_angle),
    )
    return VelocityArm(model, data, tool="tool", limits=limits, period_ns=PERIOD_NS)


def test_the_speed_changes_by_the_acceleration_each_period():
    arm = build()
    arm.command(np.array([0.7, 0.0]))
    arm.advance(PERIOD_NS)
    # 1.4 rad/s^2 in 8 ms: 0.0112 rad/s, held for 8 ms: 8.96e-5 rad.
    np.testing.assert_allclose(arm.velocities, [0.0112, 0])
    np.testing.assert_allclose(arm.angles, [8.96e-5, 0])
    arm.advance(PERIOD_NS)
    np.testing.assert_allclose(arm.velocities, [0.0224, 0])
    np.testing.assert_allclose(arm.angles, [8.96e-5 + 17.92e-5, 0])


def test_the_commanded_speed_is_reached_and_kept():
    arm = build()
    arm.command(np.array([0.7, 0.0]))
    arm.advance(63 * PERIOD_NS)  # 0.7 / 0.0112 = 62.5 periods
    np.testing.assert_array_equal(arm.velocities, [0.7, 0])
    before = arm.angles
    arm.advance(100 * PERIOD_NS)
    np.testing.assert_allclose(arm.angles - before, [0.56, 0])


def test_the_joint_with_the_largest_change_leads_and_the_others_follow_in_proportion():
    arm = build()
    arm.command(np.array([0.4, -0.8]))
    arm.advance(5 * PERIOD_NS)
    np.testing.assert_allclose(arm.velocities, [0.028, -0.056])


def test_joints_that_are_not_commanded_stand_still():
    arm = build()
    arm.place(np.array([0.0, 0.0, 0.5]))
    arm.command(np.ones(2))
    arm.advance(50 * PERIOD_NS)
    assert arm._data.qpos[2] == 0.5


@pytest.mark.parametrize("portions_ms", [[8], [1], [3, 5, 7], [40], [33, 7, 13]])
def test_the_portions_in_which_time_comes_change_nothing(portions_ms):
    whole, parts = build(), build()
    for arm in (whole, parts):
        arm.place(np.array([0.3, 0.1, 0.0]))
        arm.command(np.array([0.9, -0.4]))
    whole.advance(840_000_000)
    passed = 0
    while passed < 840:
        portion = min(portions_ms[passed % len(portions_ms)], 840 - passed)
        parts.advance(portion * 1_000_000)
        passed += portion
    np.testing.assert_array_equal(parts.angles, whole.angles)
    np.testing.assert_array_equal(parts.velocities, whole.velocities)


def test_between_two_decisions_the_joints_turn_evenly():
    arm = build()
    arm.command(np.array([0.7, 0.0]))
    arm.advance(2 * PERIOD_NS)
    before = arm.angles
    arm.advance(2_000_000)
    # Within the third period, at 3 * 0.0112 rad/s.
    np.testing.assert_allclose(arm.angles - before, [0.0336 * 0.002, 0])


def test_a_command_acts_from_the_next_decision_on_and_not_before_it_is_given():
    early, late = build(), build()
    early.advance(PERIOD_NS)
    late.advance(PERIOD_NS)
    early.command(np.ones(2))
    late.advance(1)  # the decision for this period has been taken: to rest
    late.command(np.ones(2))
    early.advance(PERIOD_NS)
    late.advance(PERIOD_NS - 1)
    np.testing.assert_array_equal(late.angles, [0, 0])
    np.testing.assert_allclose(early.angles, [8.96e-5, 8.96e-5])


def test_a_command_is_not_the_callers_array():
    arm, command = build(), np.array([0.7, 0.0])
    arm.command(command)
    command[:] = 0
    arm.advance(PERIOD_NS)
    assert arm.velocities[0] > 0


def test_a_stopped_arm_brakes_hard_and_rests():
    arm = build()
    arm.command(np.array([1.4, 0.0]))
    arm.advance(1_000_000_000)
    arm.stop()
    arm.advance(17 * PERIOD_NS)  # 10 rad/s^2: 0.08 rad/s a period
    np.testing.assert_allclose(arm.velocities, [1.4 - 17 * 0.08, 0])
    arm.advance(PERIOD_NS)
    np.testing.assert_allclose(arm.velocities, [0, 0], atol=1e-12)
    rest = arm.angles
    arm.advance(10_000_000_000)
    np.testing.assert_allclose(arm.angles, rest, atol=1e-12)


def test_outside_its_box_the_tool_is_driven_back_whatever_is_commanded():
    # The tool starts at (1, 0, 0) and moves along y with the first joint.
    arm = build(box_low=[-10, -0.2, -10], box_high=[10, 0.2, 10])
    arm.command(np.array([0.5, 0.0]))
    farthest, inside_again = 0.0, False
    for _ in range(1500):
        arm.advance(PERIOD_NS)
        farthest = max(farthest, arm.tool_position[1])
        inside_again |= farthest > 0.2 and arm.tool_in_box
    # At up to 0.5 rad/s it leaves, and brakes by 2 to 5 rad/s^2 at once: 0.0625 rad at the most, and a period's 0.004.
    assert 0.2 < farthest < 0.2 + 0.0625 + 0.004
    assert inside_again
    assert arm.tool_position[1] > 0.15  # and it does not go further back than it must


def test_an_arm_that_is_stopped_outside_rests_there():
    arm = build(box_high=[10, 0.2, 10])
    arm.place(np.array([0.5, 0.0, 0.0]))
    arm.command(np.zeros(2))
    arm.stop()
    arm.advance(1_000_000_000)
    np.testing.assert_array_equal(arm.angles, [0.5, 0])


def test_a_joint_at_its_limit_turns_back_at_the_commanded_speed():
    arm = build(angle=0.3)
    arm.command(np.array([0.5, 0.2]))
    farthest = 0.0
    for _ in range(200):
        arm.advance(PERIOD_NS)
        farthest = max(farthest, float(arm.angles[0]))
    # Turning from 0.5 rad/s takes 0.5^2 / (2 * 1.4) = 0.0893 rad beyond the limit, and a period of delay each way.
    assert 0.3 < farthest < 0.3 + 0.0893 + 2 * 0.004
    arm.command(np.array([-0.5, 0.0]))
    arm.advance(4_000_000_000)
    assert arm.angles[0] < 0.3


def test_no_joint_turns_beyond_what_the_mechanics_allow():
    arm = build(mechanical_angle=0.2)
    arm.command(np.array([1.0, 0.0]))
    arm.advance(3_000_000_000)
    np.testing.assert_allclose(arm.angles, [0.2, 0])
    np.testing.assert_array_equal(arm.velocities, [0, 0])
    arm.command(np.array([0.0, -1.0]))
    arm.advance(3_000_000_000)
    np.testing.assert_allclose(arm.angles, [0.2, -0.4])


def test_a_placed_arm_is_at_rest_and_has_forgotten_its_command():
    arm = build()
    arm.command(np.ones(2))
    arm.advance(500_000_001)
    arm.place(np.array([0.1, 0.2, 0.3]))
    arm.advance(1_000_000_000)
    np.testing.assert_array_equal(arm.angles, [0.1, 0.2])
    np.testing.assert_array_equal(arm.velocities, [0, 0])
    np.testing.assert_allclose(arm.tool_position, [np.cos(0.1) * np.cos(0.2), np.sin(0.1) * np.cos(0.2), -np.sin(0.2)])
