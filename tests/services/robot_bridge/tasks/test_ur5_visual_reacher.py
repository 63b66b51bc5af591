"""The UR5's two tasks: what is rewarded, where attempts begin, what the arm is kept from."""

import math

import numpy as np
import pytest

from common.errors import ConfigError
from experiments.simulation import SimulatedClock
from services.robot_bridge.target_detection import centre_weights, colour_mask
from services.robot_bridge.tasks import load_task
from services.robot_bridge.tasks.ur5_visual_reacher import TARGET, dense_reward
from tests.services.robot_bridge.opengl import skip_without_opengl

CYCLE_NS = 40_000_000
POSTURE = [1.5707, -2.0, 2.1, -3.0415, -1.5707, 3.1415]
NAMES = ["ur5_visual_reacher", "ur5_visual_reacher_min_time"]
MIN_TIME = "ur5_visual_reacher_min_time"


@pytest.fixture(autouse=True)
def opengl():
    skip_without_opengl()


def build(name=MIN_TIME, seed=0, pacing="lockstep", **settings):
    return load_task(name, "", settings, pacing=pacing, rng=np.random.default_rng(seed))


def begun(name=MIN_TIME, **settings):
    task = build(name, **settings)
    task.advance_to(0)
    task.begin_episode()
    return task


def arm_of(task):
    return task._world.robot.arm


def target_mask(frame):
    """Where a frame shows the target, (H, W) bool."""
    return colour_mask(frame, TARGET)


def show_target(task, across, up):
    """Begin an attempt with the target at a place on the monitor, m from its middle."""
    task._goal = np.array([across, up])
    task.begin_attempt()
    return task.read().frames[-1]


# ---------------------------------------------------------------------- specification


@pytest.mark.parametrize(
    ("name", "speed", "limit", "reset", "has_goal"), [(MIN_TIME, 2.0, 150, 70, True), (NAMES[0], 0.7, 100, 0, False)]
)
def test_the_tasks_are_those_of_the_thesis(name, speed, limit, reset, has_goal):
    spec = build(name).spec
    np.testing.assert_array_equal(spec.action_high, np.full(5, np.float32(speed)))
    np.testing.assert_array_equal(spec.action_low, -spec.action_high)
    assert spec.frame_shape.tolist() == [90, 160, 3]
    assert (spec.frame_stack, spec.crop_margin.tolist()) == (3, [9, 16])
    assert (spec.action_cycle_time_s, spec.world_seconds_per_cycle) == (0.04, 0.04)
    assert (spec.time_limit_steps, spec.reset_steps, spec.has_goal) == (limit, reset, has_goal)
    assert spec.algorithm_presets == {"sac": "ur5", "ppo": "ur5"}
    assert len(spec.proprioception_low) == 10  # five angles, five velocities


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"posture": [0.0] * 5}, r"posture = \[0.0, 0.0, 0.0, 0.0, 0.0\]: expected 6 finite numbers"),
        ({"posture": [math.nan] * 6}, "posture = .*: expected 6 finite numbers"),
        ({"box_low": [0.0, 0.0]}, "box_low = .*: expected 3 finite numbers"),
        ({"box_low": [0.2, 0.2, 0.4]}, r"box_low = .*: expected less than box_high = .* in each axis"),
        ({"box_high": [1e308, 0.5, 0.63]}, r"box_high = .*: expected x from -2 to 2 m, .*, got 1e\+308"),
        ({"box_low": [-0.25, 0.17, -0.1]}, "box_low = .*: expected z from 0 to 2 m, above the table .*, got -0.1"),
        # By hand: .6, less the webcam's .03 before the tool and .06 to brake.
        (
            {"box_high": [0.15, 0.52, 0.63], "monitor_distance": 0.6},
            r"box_high = .*: expected y from -2 to 0.51 m, .* before the monitor at monitor_distance = 0.6, got 0.52",
        ),
        ({"threshold": 1.0}, "threshold = 1.0: expected a value from 0.0 to 0.99"),
        (
            {"target_radius": 0.2, "target_margin": 0.1},
            "target_radius = 0.2, target_margin = 0.1: expected at most 0.28",
        ),
        ({"monitor_distance": 0.5}, "monitor_distance = 0.5: expected"),
        (
            {"posture": [7.853885, *POSTURE[1:]]},
            r"posture = \[7.85.*\]: expected joint 1 from 0.8727 to 2.443 rad, got 7.853885",
        ),
        ({"posture": [*POSTURE[:5], 6.5]}, r"posture = .*: expected joint 6 from -6.283 to 6.283 rad, got 6.5"),
        # Upright. By hand: the links' d .10915 to the side and .09465 back, .089159 + .425 + .39225 + .0823 up.
        (
            {"posture": [math.pi / 2, -math.pi / 2, 0.0, -math.pi, -math.pi / 2, 0.0]},
            rf"^\[task\] {MIN_TIME}: posture = .* holds the tool at \[-0.109, -0.095, 0.989\], expected a place",
        ),
        ({"max_speed": 0.0}, "max_speed = 0.0: expected"),
        ({"camera_latency": -0.1}, "camera_latency = -0.1: expected"),
    ],
)
def test_a_wrong_setting_is_named(settings, match):
    with pytest.raises(ConfigError, match=match):
        build(**settings)


# ---------------------------------------------------------------------- beginnings


@pytest.mark.parametrize("name", NAMES)
def test_every_attempt_begins_in_the_same_posture_at_rest(name):
    task = begun(name)
    for attempt in range(3):
        np.testing.assert_allclose(task.read().proprioception, np.float32([*POSTURE[:5], *[0] * 5]))
        task.command(task.spec.action_high)
        task.advance_to((attempt + 1) * 10 * CYCLE_NS)
        task.begin_attempt()


@pytest.mark.parametrize("name", NAMES)
def test_a_new_attempt_keeps_the_target_and_a_new_episode_moves_it(name):
    task = begun(name)
    first = task.read().frames[-1]
    task.begin_attempt()
    assert np.array_equal(task.read().frames[-1], first)
    task.begin_episode()
    second = task.read().frames[-1]
    assert not np.array_equal(target_mask(second), target_mask(first))


def test_targets_are_drawn_all_over_the_monitor_and_never_at_its_edge():
    task = begun()
    places = []
    for _ in range(300):
        task.begin_episode()
        places.append(task._goal)
    np.testing.assert_allclose(np.abs(places).max(axis=0), [0.17556, 0.05963], rtol=0.03)
    assert (np.abs(places) <= [0.1755625, 0.059625]).all()


# ---------------------------------------------------------------------- what is seen


def test_the_target_is_red_on_white_and_seen_where_it_is():
    task = begun()
    middle, right, up = (show_target(task, *place) for place in ((0.0, 0.0), (0.15, 0.0), (0.0, 0.05)))
    for frame in (middle, right, up):
        mask = target_mask(frame)
        rows, columns = np.nonzero(mask)
        # A disc of 2.32 cm radius, 44 cm away, in 90 pixels over 43.3 degrees: 113 pixels per radian-tangent.
        assert 90 < mask.sum() < 180
        assert np.ptp(rows) == pytest.approx(np.ptp(columns), abs=3)
    centre = {
        name: np.argwhere(target_mask(frame)).mean(axis=0)
        for name, frame in (("middle", middle), ("right", right), ("up", up))
    }
    assert centre["right"][1] > centre["middle"][1] + 25
    assert centre["up"][0] < centre["middle"][0] - 8
    assert (middle[40:50, 120:150] > 240).all()  # the monitor is white


def test_nothing_but_the_target_has_its_colour():
    task = begun()
    task._goal = np.array([0.0, 5.0])  # far above the monitor
    rng = np.random.default_rng(0)
    task.begin_attempt()
    for cycle in range(1, 120):
        task.command(rng.uniform(task.spec.action_low, task.spec.action_high).astype(np.float32))
        task.advance_to(cycle * CYCLE_NS)
        assert not any(target_mask(frame).any() for frame in task.read().frames)


@pytest.mark.parametrize("disturbed", [{"lighting_change": 0.5}, {"camera_noise": 8.0}])
def test_the_target_stays_visible_in_changing_light_and_noise(disturbed):
    clean, task = begun(), begun(**disturbed)
    expected = target_mask(show_target(clean, 0.0, 0.0)).sum()
    for _ in range(5):
        assert target_mask(show_target(task, 0.0, 0.0)).sum() == pytest.approx(expected, rel=0.1)


def test_the_mask_takes_the_bounds_themselves_and_nothing_beyond():
    frame = np.array([[[120, 0, 0], [255, 50, 50], [119, 0, 0], [255, 51, 0], [255, 0, 51], [0, 0, 255]]], np.uint8)
    assert target_mask(frame).tolist() == [[True, True, False, False, False, False]]


# ---------------------------------------------------------------------- minimum time


def judged(task, share):
    """Outcome for a frame that is red in the given number of pixels."""
    frame = np.zeros((90, 160, 3), np.uint8)
    frame.reshape(-1, 3)[:share] = (200, 0, 0)
    return task._judge(frame, np.zeros(10, np.float32))


def test_the_goal_is_reached_where_more_than_the_threshold_is_red():
    task = build()
    # 1.5 % of 160 x 90 are 216 pixels.
    assert [judged(task, pixels).terminated for pixels in (0, 215, 216, 217, 14400)] == [False] * 3 + [True] * 2
    assert {judged(task, pixels).reward for pixels in (0, 217)} == {-1.0}


def test_the_arm_reaches_the_goal_when_it_is_driven_there():
    task = begun(box_low=[-1.0, 0.0, 0.0], box_high=[1.0, 0.69, 1.0])
    show_target(task, 0.059, 0.0)  # straight ahead of the tool
    reached = False
    for cycle in range(1, 100):
        # Shoulder down, elbow up: the tool goes forward; the first wrist joint keeps it level.
        task.command(np.array([0.0, 0.35, -0.45, 0.1, 0.0], np.float32))
        task.advance_to(cycle * CYCLE_NS)
        task.read()
        if task.outcome().terminated:
            reached = True
            break
    assert reached
    assert cycle > 10


# ---------------------------------------------------------------------- dense reward


def test_the_dense_reward_of_an_image_and_a_posture_computed_by_hand():
    mask = np.array([[False, True, False, False], [False, True, True, False], [False, False, False, True]])
    # W: rows 1/3 1 1/3, columns .25 .75 .75 .25. Seen: .75/3 + .75 + .75 + .25/3 = 11/6, of 12 pixels.
    # Posture: |pi - (1 - 2 + 3)| + |-1 - .5| = 1.1415926... + 1.5.
    reward = dense_reward(mask, centre_weights(3, 4), np.array([1.0, -2.0, 3.0, -1.0, -0.5]), 800.0, 2.0)
    assert reward == pytest.approx(800 * 11 / 72 - 2 * (math.pi - 2 + 1.5), rel=1e-6)


def test_without_a_target_only_the_posture_counts():
    task = begun("ur5_visual_reacher")
    task._goal = np.array([0.0, 5.0])
    task.begin_attempt()
    # |pi - (1.5707 - 2 + 2.1)| + |-3.0415 - 1.5707|
    assert task.outcome().reward == pytest.approx(-(math.pi - 1.6707) - 4.6122, abs=1e-5)
    assert task.outcome().terminated is False


def test_a_target_in_the_middle_is_worth_more_than_one_at_the_edge_and_none_the_least():
    task = begun("ur5_visual_reacher")
    rewards = []
    for place in ((0.059, -0.01), (0.17, 0.05), (0.0, 5.0)):
        show_target(task, *place)
        rewards.append(task.outcome().reward)
    assert rewards == sorted(rewards, reverse=True)
    assert rewards[0] > rewards[1] + 1


# ---------------------------------------------------------------------- safety


def test_the_tool_is_kept_near_its_box_whatever_the_policy_does():
    task = begun()
    low, high = np.array(task._settings.box_low), np.array(task._settings.box_high)
    rng = np.random.default_rng(0)
    farthest = 0.0
    for cycle in range(1, 400):
        if cycle % 10 == 1:
            task.command(rng.choice([-1, 1], 5).astype(np.float32) * task.spec.action_high)
        task.advance_to(cycle * CYCLE_NS)
        tool = arm_of(task).tool_position
        farthest = max(farthest, float(np.max([low - tool, tool - high])))
    assert 0 < farthest < 0.15
    assert farthest < 0.78 - 0.5 - 0.03  # the webcam never touches the monitor


# ---------------------------------------------------------------------- in real time


def test_what_the_arm_is_doing_it_goes_on_doing_while_nobody_commands():
    clock = SimulatedClock()
    task = build(pacing="realtime")
    task.start(clock)
    task.advance_to(clock.now_ns())
    task.begin_episode()
    task.command(np.array([0.2, 0, 0, 0, 0], np.float32))
    condition = clock.condition()
    with condition:
        clock.wait_until(clock.now_ns() + 1_001_000_000, condition)
    task.advance_to(clock.now_ns())
    reading = task.read()
    # 0.2 rad/s after 143 ms of acceleration: 0.2 - 0.0143 rad or so in the first second.
    assert reading.proprioception[0] - 1.5707 == pytest.approx(0.2 - 0.0143, abs=0.002)
    assert reading.proprioception[5] == np.float32(0.2)
    task.close()
    clock.end()
