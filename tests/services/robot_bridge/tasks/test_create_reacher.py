"""Create-Reacher: what is seen and felt, when a paper is reached, where attempts begin."""

import math

import numpy as np
import pytest

from common.errors import ConfigError
from services.robot_bridge.target_detection import colour_mask, largest_blob, share
from services.robot_bridge.tasks.create_reacher import TARGET
from tests.services.robot_bridge.opengl import skip_without_opengl
from tests.services.robot_bridge.tasks.wheeled import (
    begun,
    build,
    put,
    share_of_others,
)

NAME = "create_reacher"
CYCLE_NS = 45_000_000


@pytest.fixture(autouse=True)
def opengl():
    skip_without_opengl()


def test_the_task_is_that_of_the_thesis():
    spec = build(NAME).spec
    np.testing.assert_array_equal(spec.action_high, [300.0, 300.0])
    np.testing.assert_array_equal(spec.action_low, [-300.0, -300.0])
    assert spec.frame_shape.tolist() == [120, 160, 3]
    assert (spec.frame_stack, spec.crop_margin.tolist()) == (3, [12, 16])
    assert (spec.action_cycle_time_s, spec.world_seconds_per_cycle) == (0.045, 0.045)
    assert (spec.time_limit_steps, spec.reset_steps, spec.has_goal) == (333, 65, True)
    assert spec.algorithm_presets == {"sac": "create", "ppo": "create"}
    np.testing.assert_array_equal(spec.proprioception_low, [0.0] * 6)
    np.testing.assert_array_equal(spec.proprioception_high, [4095.0] * 6)


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"arena_width": 0.5}, r"arena_width = 0.5: expected at least 0.68 m"),
        ({"paper_height": 0.1}, "paper_size = 0.3, paper_height = 0.1: expected papers that fit"),
        ({"paper_size": 1.0}, "paper_size = 1.0, paper_height = 0.28: expected papers that fit"),
        ({"max_speed": 0.0}, "max_speed = 0.0: expected"),
        ({"threshold": 1.0}, "threshold = 1.0: expected a value from 0.0 to 0.99"),
        ({"battery_threshold": 1.5}, "battery_threshold = 1.5: expected"),
        ({"field_of_view": math.nan}, "field_of_view = nan: expected a finite number"),
    ],
)
def test_a_wrong_setting_is_named(settings, match):
    with pytest.raises(ConfigError, match=match):
        build(NAME, **settings)


def test_packets_come_at_66_hz_and_frames_at_30():
    task = begun(NAME)
    before = task.counters()
    for cycle in range(1, 31):
        task.advance_to(cycle * 100_000_000)
    after = task.counters()
    assert after["sensor_packets"] - before["sensor_packets"] == 200  # every 15 ms
    assert after["camera_frames"] - before["camera_frames"] == 90


# ---------------------------------------------------------------------- papers


@pytest.mark.parametrize("side", [1, -1])
def test_a_paper_is_seen_at_its_size_in_the_image(side):
    # 1 m before the lens: 120 pixels over 2 m tan(27.5 deg), so 0.3 m are 34.6 pixels; 6.2 % of the image.
    frame = put(begun(NAME), side * 0.0465, 0.0, 0.0 if side > 0 else math.pi)
    blob = largest_blob(colour_mask(frame, TARGET))
    assert blob.box[2:] == pytest.approx((34.6, 34.6), abs=1.1)
    assert blob.share == pytest.approx(0.0623, abs=0.003)
    assert blob.centre == pytest.approx((0.0, 0.0), abs=0.02)


def test_the_goal_is_reached_before_a_paper_and_nowhere_else():
    task = begun(NAME)
    # 12 % of the image: 0.3 / sqrt(0.12 * 1.3333) / (2 tan(27.5 deg)) = 0.72 m before the lens.
    for x, y, heading, reached in ((0.38, 0, 0, True), (0.28, 0, 0, False), (0.38, 0, math.pi, False)):
        put(task, x, y, heading)
        assert task.outcome().terminated is reached
        assert task.outcome().reward == -1.0
    put(task, 0.0, 0.53, math.pi / 2)  # at the charger
    assert not task.outcome().terminated


def test_more_than_the_threshold_has_to_be_green():
    task = build(NAME)
    frame = np.zeros((120, 160, 3), np.uint8)
    for pixels, reached in ((0, False), (2304, False), (2305, True), (19200, True)):  # 12 % are 2304
        frame.reshape(-1, 3)[:pixels] = (20, 180, 60)
        assert task._judge(frame, np.zeros(6, np.float32)).terminated is reached


@pytest.mark.parametrize(("settings", "most"), [({}, 0.0), ({"lighting_change": 0.2, "camera_noise": 4.0}, 0.005)])
def test_nothing_but_the_papers_has_their_colour(settings, most):
    assert share_of_others(begun(NAME, **settings), "paper", TARGET, 120) <= most


@pytest.mark.parametrize("disturbed", [{"lighting_change": 0.5}, {"camera_noise": 4.0}])
def test_papers_stay_visible_in_changing_light_and_noise(disturbed):
    expected = share(colour_mask(put(begun(NAME), 0.2, 0.1, 0.1), TARGET))
    task = begun(NAME, **disturbed)
    for _ in range(5):
        assert share(colour_mask(put(task, 0.2, 0.1, 0.1), TARGET)) == pytest.approx(expected, rel=0.05)


# ---------------------------------------------------------------------- attempts


def test_an_attempt_begins_where_the_reset_has_driven_to_from_where_the_last_one_ended():
    task = begun(NAME)
    places = []
    for attempt in range(1, 30):
        robot = task.robot
        before = robot.drive.pose
        (task.begin_episode if attempt % 3 == 0 else task.begin_attempt)()
        after = robot.drive.pose
        # Back by 0.3 m/s for 1.5 s at most, forward for 0.6 s.
        assert math.hypot(*(after - before)[:2]) < 0.63
        np.testing.assert_array_equal(robot.drive.wheel_speeds, 0)
        places.append(after)
    places = np.array(places)
    assert np.ptp(places[:, 0]) > 0.8
    assert np.ptp(places[:, 2] % (2 * math.pi)) > 4


def test_a_worn_battery_is_charged_between_attempts():
    task = begun(NAME, battery_life=3.0)
    task.advance_to(2_000_000_000)
    task.begin_attempt()
    assert task.counters()["recharges"] == 0
    task.advance_to(2_700_000_000)
    task.begin_attempt()
    assert task.counters()["recharges"] == 1
    assert math.hypot(*(task.robot.drive.pose[:2] - [0.0, 0.53])) < 0.63
