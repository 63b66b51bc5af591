"""Vector-ChargerDetector: slow images, the marker, falls."""

import math

import numpy as np
import pytest

from common.errors import ConfigError
from services.robot_bridge.target_detection import colour_mask, largest_blob
from services.robot_bridge.tasks.vector_charger_detector import TARGET
from tests.services.robot_bridge.opengl import skip_without_opengl
from tests.services.robot_bridge.tasks.wheeled import begun, build, put, share_of_others

NAME = "vector_charger_detector"
CYCLE_NS = 100_000_000


@pytest.fixture(autouse=True)
def opengl():
    skip_without_opengl()


def test_the_task_is_that_of_the_thesis():
    spec = build(NAME).spec
    np.testing.assert_array_equal(spec.action_high, [160.0, 160.0])
    np.testing.assert_array_equal(spec.action_low, [-160.0, -160.0])
    assert spec.frame_shape.tolist() == [120, 160, 3]
    assert spec.frame_stack == 4
    assert (spec.action_cycle_time_s, spec.world_seconds_per_cycle) == (0.1, 0.1)
    assert (spec.time_limit_steps, spec.reset_steps, spec.has_goal) == (300, 20, True)
    assert spec.algorithm_presets == {"sac": "vector", "ppo": "vector"}
    np.testing.assert_array_equal(spec.proprioception_low, [0.0, -160.0, -160.0])
    np.testing.assert_array_equal(spec.proprioception_high, [400.0, 160.0, 160.0])


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"arena_length": 0.15}, r"arena_length = 0.15: expected at least 0.18 m"),
        ({"marker_width": 0.5}, "marker_width = 0.5, marker_height = 0.08: expected a marker that fits"),
        ({"marker_height": 0.16}, "marker_width = 0.12, marker_height = 0.16: expected a marker that fits"),
        ({"centred_within": 0.6}, "centred_within = 0.6: expected"),
        ({"tips_after": 0.0}, "tips_after = 0.0: expected"),
    ],
)
def test_a_wrong_setting_is_named(settings, match):
    with pytest.raises(ConfigError, match=match):
        build(NAME, **settings)


def test_every_other_cycle_brings_an_image_and_the_state_comes_every_60_ms():
    task = begun(NAME)
    task.read()
    before, brought = task.counters(), []
    for cycle in range(1, 31):
        task.advance_to(cycle * CYCLE_NS)
        brought.append(len(task.read().frame_ids))
    after = task.counters()
    assert brought == [0, 1] * 15
    assert after["sensor_packets"] - before["sensor_packets"] == 50
    assert after["camera_frames"] - before["camera_frames"] == 15


# ---------------------------------------------------------------------- the charger


def test_the_marker_is_seen_at_its_size_in_the_image():
    # 20 cm before the lens: 120 pixels over 0.4 m tan(25 deg), 643 a metre; 0.12 m are 77.2 pixels, 0.08 m 51.5.
    blob = largest_blob(colour_mask(put(begun(NAME), 0.3 - 0.008 - 0.2 - 0.02, 0.0, 0.0), TARGET))
    assert blob.box[2:] == pytest.approx((77.2, 51.5), abs=1.2)
    assert blob.centre[0] == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize(
    ("pose", "reached"),
    [
        ((0.13, 0.0, 0.0), True),  # 125 mm from the front to the wall
        ((0.11, 0.0, 0.0), False),  # 145 mm
        ((0.13, 0.0, 0.35), False),  # the marker is at the image's right edge
        ((0.13, 0.0, math.pi), False),
        ((0.255, 0.0, 0.0), True),  # at the charger: all is black
        ((0.255, 0.15, 0.0), False),  # beside it
        ((0.0, 0.18, math.pi / 2), False),  # at another wall
    ],
)
def test_the_goal_is_to_be_near_and_to_see_the_marker_in_the_middle(pose, reached):
    task = begun(NAME)
    put(task, *pose)
    assert task.outcome().terminated is reached
    assert task.outcome().reward == -1.0


def test_each_condition_counts_and_their_bounds_belong_to_the_goal():
    task = build(NAME)

    def judged(columns, first, proximity):
        frame = np.full((120, 160, 3), 200, np.uint8)
        frame[:, first : first + columns] = 10
        return task._judge(frame, np.array([proximity, 0, 0], np.float32)).terminated

    # 22 % of the width are 35.2 columns; the middle of columns 62 to 97 is that of the image.
    assert judged(36, 62, 130.0)
    assert not judged(35, 62, 130.0)
    assert not judged(36, 62, 130.5)
    # The middle may be 32 columns from the image's.
    assert judged(36, 62 + 32, 130.0)
    assert not judged(36, 62 + 33, 130.0)
    assert judged(36, 62 - 32, 130.0)
    assert not judged(36, 62 - 33, 130.0)
    assert judged(160, 0, 0.0)


@pytest.mark.parametrize(("settings", "most"), [({}, 0.0), ({"lighting_change": 0.2, "camera_noise": 4.0}, 0.005)])
def test_nothing_but_the_marker_is_as_dark(settings, most):
    assert share_of_others(begun(NAME, **settings), "marker", TARGET, 120) <= most


# ---------------------------------------------------------------------- attempts


def test_who_drives_against_a_wall_falls_on_its_back_until_the_reset():
    task = begun(NAME, tips_after=1.0)
    put(task, 0.0, 0.18, math.pi / 2)
    task.command(task.spec.action_high)
    start_ns = task._world._now_ns
    for cycle in range(1, 16):
        task.advance_to(start_ns + cycle * CYCLE_NS)
    assert task.robot.drive.on_its_back
    task.begin_attempt()
    assert not task.robot.drive.on_its_back
    assert task.counters()["recoveries"] == 1


def test_the_initial_policy_does_not_fall():
    task = begun(NAME)
    rng = np.random.default_rng(0)
    robot = task.robot
    robot.drive.place(np.array([0.255, 0.1, 0.0]))
    for _ in range(2000):
        robot.command(np.tanh(rng.standard_normal(2)) * 160)
        robot.advance(CYCLE_NS)
        assert not robot.drive.on_its_back


def test_an_attempt_begins_behind_where_the_last_one_ended():
    task = begun(NAME)
    drive, headings = task.robot.drive, []
    for _ in range(20):
        drive.place(np.array([0.0, 0.0, 0.0]))
        task.begin_attempt()
        # Back by 0.1 m/s for 1 to 2 s, less the lag's 8 mm; then a turn on the spot.
        assert -0.2 < drive.pose[0] < -0.09
        assert abs(drive.pose[1]) < 0.01
        headings.append(drive.pose[2] % (2 * math.pi))
    assert np.ptp(headings) > 4
