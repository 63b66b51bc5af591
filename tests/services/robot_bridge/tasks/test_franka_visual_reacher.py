"""The Franka's task: what is rewarded, where attempts begin, what the arm is kept from."""

import math

import numpy as np
import pytest

from common.errors import ConfigError
from services.robot_bridge.target_detection import colour_mask, share
from services.robot_bridge.tasks import load_task
from services.robot_bridge.tasks.franka_visual_reacher import TARGET
from tests.services.robot_bridge.opengl import skip_without_opengl

CYCLE_NS = 40_000_000
NAME = "franka_visual_reacher"


@pytest.fixture(autouse=True)
def opengl():
    skip_without_opengl()


def build(seed=0, pacing="lockstep", **settings):
    return load_task(NAME, "", settings, pacing=pacing, rng=np.random.default_rng(seed))


def begun(**settings):
    task = build(**settings)
    task.advance_to(0)
    task.begin_episode()
    return task


def robot_of(task):
    return task._world.robot


def target_mask(frame):
    """Where a frame shows the bag, (H, W) bool."""
    return colour_mask(frame, TARGET)


def drive(task, velocities, cycles):
    """Turn the joints for some cycles; True if the goal was reached."""
    for cycle in range(1, cycles + 1):
        task.command(np.array(velocities, np.float32))
        task.advance_to(cycle * CYCLE_NS)
        task.read()
        if task.outcome().terminated:
            return True
    return False


# Starts in one place, the webcam .33 m above the table; the bag below it.
BELOW = {
    "posture_low": [0.0, 0.13, 0.0, -2.1, 0.0, 2.23, 0.7854],
    "posture_high": [0.0, 0.13, 0.0, -2.1, 0.0, 2.23, 0.7854],
    "bag_low": [0.62, 0.0],
    "bag_high": [0.62, 0.0],
}


# ---------------------------------------------------------------------- specification


def test_the_task_is_that_of_the_thesis():
    spec = build().spec
    assert spec.action_low.shape == spec.action_high.shape == (7,)
    np.testing.assert_array_equal(spec.action_low, -spec.action_high)
    assert spec.frame_shape.tolist() == [90, 160, 3]
    assert (spec.frame_stack, spec.crop_margin.tolist()) == (3, [9, 16])
    assert (spec.action_cycle_time_s, spec.world_seconds_per_cycle) == (0.04, 0.04)
    assert (spec.time_limit_steps, spec.reset_steps, spec.has_goal) == (150, 100, True)
    assert spec.algorithm_presets == {"sac": "franka", "ppo": "franka"}
    assert len(spec.proprioception_low) == 14  # seven angles, seven velocities


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"posture_low": [0.0] * 6}, r"posture_low = .*: expected 7 finite numbers"),
        ({"posture_high": [math.nan] * 7}, "posture_high = .*: expected 7 finite numbers"),
        ({"bag_low": [0.9, 0.0]}, r"bag_low = \[0.9, 0.0\]: expected at most bag_high = .* in each axis"),
        ({"box_high": [0.7, 0.3]}, "box_high = .*: expected 3 finite numbers"),
        ({"box_low": [0.7, -0.3, 0.08]}, r"box_low = .*: expected less than box_high = .* in each axis"),
        (
            {name: [*BELOW["posture_low"][:6], 10.0] for name in ("posture_low", "posture_high")},
            r"posture_low = .*: expected joint 7 from -0.9 to 0.9 rad, got 10.0",
        ),
        (
            {"posture_high": [0.2, 0.13, 0.02, -2.0, 0.03, 3.0, 0.8]},
            r"posture_high = .*: expected joint 6 from 1.7 to 2.96 rad, got 3.0",
        ),
        # Elbow at -90 and wrist at 135 degrees. By hand: .0825 + .384 + (.088 + .107) / 2^.5 forward,
        # .333 + .316 + .0825 + (.088 - .107) / 2^.5 up.
        (
            {name: [0.0, 0.0, 0.0, -math.pi / 2, 0.0, 3 * math.pi / 4, 0.0] for name in BELOW if "posture" in name},
            rf"^\[task\] {NAME}: posture_low = .* holds the flange at \[0.604, -?0.0, 0.718\], expected a place",
        ),
        ({"box_low": [0.3, -0.3, -1.0]}, "box_low = .*: expected z from 0.04 to 2 m, above the table, got -1.0"),
        ({"box_high": [1e308, 0.3, 0.4]}, r"box_high = .*: expected x from -2 to 2 m, .*, got 1e\+308"),
        # By hand: the foot's .078 and the bag's .05; the table's .35 + .75 - .05, and .75 - .05 to each side.
        ({"bag_low": [0.1, 0.0]}, "bag_low = .*: expected x from 0.128 to 1.05 m, on the table before the arm"),
        ({"bag_high": [3.0, 0.1]}, "bag_high = .*: expected x from 0.128 to 1.05 m, .*, got 3.0"),
        ({"bag_high": [0.65, 0.8]}, "bag_high = .*: expected y from -0.7 to 0.7 m, .*, got 0.8"),
        ({"threshold": 1.0}, "threshold = 1.0: expected a value from 0.0 to 0.99"),
        ({"bag_radius": 0.0}, "bag_radius = 0.0: expected"),
        ({"max_speed": 3.0}, "max_speed = 3.0: expected"),
        ({"threshold": 1.5}, "threshold = 1.5: expected"),
    ],
)
def test_a_wrong_setting_is_named(settings, match):
    with pytest.raises(ConfigError, match=match):
        build(**settings)


# ---------------------------------------------------------------------- beginnings


def test_every_attempt_puts_arm_and_bag_elsewhere_at_rest():
    task = begun()
    settings = task._settings
    postures, bags = [], []
    for begin in (task.begin_episode, task.begin_attempt) * 20:
        begin()
        proprioception = task.read().proprioception
        postures.append(proprioception[:7])
        bags.append(robot_of(task).model.geom("bag").pos[:2].copy())
        np.testing.assert_array_equal(proprioception[7:], 0)
        assert robot_of(task).arm.tool_in_box
    for values, low, high in (
        (postures, settings.posture_low, settings.posture_high),
        (bags, settings.bag_low, settings.bag_high),
    ):
        values, low, high = np.array(values), np.float32(low), np.float32(high)
        assert ((low - 1e-6 <= values) & (values <= high + 1e-6)).all()
        varied = high > low
        # Of 40 uniform draws, less than 70 % of the range is covered once in some 10 000 times.
        assert (np.ptp(values, axis=0)[varied] > 0.7 * (high - low)[varied]).all()
        assert len({value[varied].tobytes() for value in values}) == 40


# ---------------------------------------------------------------------- what is seen


def test_the_bag_is_red_on_the_table_and_as_large_as_its_distance_says():
    task = begun(**BELOW)
    mask = target_mask(task.read().frames[-1])
    rows, columns = np.nonzero(mask)
    # 90 pixels over 43.3 degrees: 113.4 pixels per radian-tangent. The webcam's height over the widest part of the bag:
    height = robot_of(task).data.cam("wrist").xpos[2] - 0.04 / 3
    assert np.ptp(rows) + 1 == pytest.approx(113.4 * 0.1 / height, rel=0.07)
    assert np.ptp(columns) + 1 == pytest.approx(113.4 * 0.1 / height, rel=0.07)
    assert share(mask) == pytest.approx(math.pi * (113.4 * 0.05 / height) ** 2 / 14400, rel=0.1)


def test_a_bag_further_away_is_higher_in_the_picture_and_one_to_the_left_further_left():
    middle, ahead, left = (
        np.argwhere(target_mask(begun(**{**BELOW, **place}).read().frames[-1])).mean(axis=0)
        for place in (
            {},
            {"bag_low": [0.65, 0.0], "bag_high": [0.65, 0.0]},
            {"bag_low": [0.62, 0.06], "bag_high": [0.62, 0.06]},
        )
    )
    assert ahead[0] < middle[0] - 5
    assert ahead[1] == pytest.approx(middle[1], abs=1)
    assert left[1] < middle[1] - 15
    assert left[0] == pytest.approx(middle[0], abs=1)


def test_nothing_but_the_bag_has_its_colour():
    task = begun()
    task._draw_goal = lambda: np.array([-3.0, 0.0])  # behind the wall
    task.begin_episode()
    rng = np.random.default_rng(0)
    for cycle in range(1, 100):
        if cycle % 5 == 1:
            task.command(rng.choice([-1, 1], 7).astype(np.float32) * task.spec.action_high)
        task.advance_to(cycle * CYCLE_NS)
        assert not any(target_mask(frame).any() for frame in task.read().frames)


@pytest.mark.parametrize("disturbed", [{"lighting_change": 0.3}, {"camera_noise": 8.0}])
def test_the_bag_stays_visible_in_changing_light_and_noise(disturbed):
    expected = target_mask(begun(**BELOW).read().frames[-1]).sum()
    task = begun(**BELOW, **disturbed)
    for _ in range(5):
        task.begin_attempt()
        assert target_mask(task.read().frames[-1]).sum() == pytest.approx(expected, rel=0.1)


# ---------------------------------------------------------------------- the goal


def test_the_goal_is_reached_where_more_than_the_threshold_is_red():
    task = build()

    def judged(pixels):
        frame = np.zeros((90, 160, 3), np.uint8)
        frame.reshape(-1, 3)[:pixels] = (200, 0, 30)
        return task._judge(frame, np.zeros(14, np.float32))

    # 12 % of 160 x 90 are 1728 pixels.
    assert [judged(pixels).terminated for pixels in (0, 1727, 1728, 1729, 14400)] == [False] * 3 + [True] * 2
    assert {judged(pixels).reward for pixels in (0, 1729)} == {-1.0}


def test_the_arm_reaches_the_goal_when_it_is_driven_down_to_the_bag():
    # The shoulder leans forward, and the flange, which is at its height, goes down; the wrist keeps the webcam level.
    assert drive(begun(**BELOW), [0, 0.1, 0, 0, 0, 0.1, 0], 60)
    assert not drive(begun(**BELOW), [0, -0.1, 0, 0, 0, -0.1, 0], 60)


# ---------------------------------------------------------------------- safety


def test_the_flange_is_kept_near_its_box_and_the_webcam_above_the_table_whatever_the_policy_does():
    task = begun()
    low, high = np.array(task._settings.box_low), np.array(task._settings.box_high)
    rng = np.random.default_rng(0)
    farthest, lowest = 0.0, 1.0
    for cycle in range(1, 1500):
        if cycle % 25 == 1:
            task.command(rng.choice([-1, 1], 7).astype(np.float32) * task.spec.action_high)
        robot_of(task).advance(CYCLE_NS)  # without pictures
        tool = robot_of(task).arm.tool_position
        farthest = max(farthest, float(np.max([low - tool, tool - high])))
        lowest = min(lowest, float(tool[2]))
    assert 0 < farthest < 0.03
    assert lowest > 0.05  # the webcam reaches .02 below the flange


def test_a_joint_at_its_limit_turns_back():
    task = begun(box_low=[-2.0, -2.0, 0.04], box_high=[2.0] * 3)
    highest = 0.0
    for _ in range(150):
        task.command(np.array([0, 0, 0, 0, 1.0, 0, 0], np.float32))
        robot_of(task).advance(CYCLE_NS)
        highest = max(highest, float(robot_of(task).arm.angles[4]))
    # From .2 rad/s it turns within .2^2 / (2 * 5) = .004 rad, and a period's .0016 at each end.
    assert 0.4 < highest < 0.4 + 0.004 + 2 * 0.0016
