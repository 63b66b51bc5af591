"""What every simulated robot of the table has to do with what it should never be given, and in real time."""

import math
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from common.errors import ConfigError, ServiceError
from experiments.simulation import SimulatedClock
from services.robot_bridge.target_detection import ColourSpace, colour_mask
from services.robot_bridge.tasks import load_task
from services.robot_bridge.tasks.robot_task import RobotTask
from tests.conformance.test_tasks import BUILT, build, cycle_ns, same
from tests.services.robot_bridge.opengl import skip_without_opengl

ROBOTS = sorted(name for name, task in BUILT.items() if isinstance(task, RobotTask))
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(params=ROBOTS)
def name(request):
    """Each task of a simulated robot."""
    skip_without_opengl()
    return request.param


def begun(name, **settings):
    task = build(name, **settings)
    task.advance_to(0)
    task.begin_episode()
    return task


def last_reading(task, now_ns):
    task.advance_to(now_ns)
    return task.read()


def painted(colours):
    """An RGB colour in the middle of a range."""
    middle = np.array([[(np.array(colours.low) + colours.high) // 2]], np.uint8)
    conversion = cv2.COLOR_HSV2RGB if colours.space is ColourSpace.HSV else cv2.COLOR_BGR2RGB
    return cv2.cvtColor(middle, conversion)[0, 0]


def test_there_are_such_robots():
    assert {name.split("_")[0] for name in ROBOTS} == {"ur5", "franka", "create", "vector"}


# ---------------------------------------------------------------------- bad input


def test_an_action_beyond_its_bounds_is_the_bound(name):
    inside, beyond = begun(name), begun(name)
    inside.command(inside.spec.action_high)
    beyond.command(np.full(len(inside.spec.action_high), 1e6, np.float32))
    now_ns = 10 * cycle_ns(inside)
    assert same(last_reading(inside, now_ns), last_reading(beyond, now_ns))


@pytest.mark.parametrize("value", [math.nan, -math.inf])
def test_an_action_that_is_no_number_stops_the_robot_and_is_named(name, value):
    task = begun(name)
    task.command(task.spec.action_high)
    task.advance_to(5 * cycle_ns(task))
    action = np.zeros(len(task.spec.action_high), np.float32)
    action[-1] = value
    with pytest.raises(ServiceError, match=rf"{name}: the robot was given the command .*{value}.*it was stopped"):
        task.command(action)
    rest = last_reading(task, 30 * cycle_ns(task)).proprioception
    np.testing.assert_array_equal(last_reading(task, 40 * cycle_ns(task)).proprioception, rest)


def test_a_robot_driven_to_its_limits_stays_within_them_and_comes_back(name):
    task = begun(name)
    spec, seconds = task.spec, 10
    for direction, start_s in ((spec.action_high, 0), (spec.action_low, seconds)):
        task.command(direction)
        for second in range(start_s + 1, start_s + seconds + 1):
            felt = last_reading(task, second * 10**9).proprioception
            tenth = 0.1 * (spec.proprioception_high - spec.proprioception_low)
            assert (felt >= spec.proprioception_low - tenth).all()
            assert (felt <= spec.proprioception_high + tenth).all()
            if second == seconds:
                at_limit = felt
    assert not np.array_equal(felt, at_limit)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_sensor_that_gives_no_number_is_named(name, value):
    task = begun(name)
    robot, felt = task.robot, task.robot.sense()
    robot.sense = lambda: np.full_like(felt, value)
    with pytest.raises(ServiceError, match=rf"a sensor of {type(robot).__name__} gave .*{value}.*expected finite"):
        task.advance_to(10**9)


def test_a_picture_that_is_all_target_is_the_goal_and_one_without_any_is_not(name):
    task = begun(name)
    height, width, _ = task.spec.frame_shape
    none = np.full((height, width, 3), 255, np.uint8)
    everything = np.full_like(none, painted(task.TARGET_RANGE))
    assert colour_mask(everything, task.TARGET_RANGE).all()
    assert not colour_mask(none, task.TARGET_RANGE).any()
    # At a wall, with a joint at 0: as near as can be.
    proprioception = np.zeros(len(task.spec.proprioception_low), np.float32)
    at_goal, lost = task._judge(everything, proprioception), task._judge(none, proprioception)
    assert (at_goal.terminated, lost.terminated) == (task.spec.has_goal, False)
    assert math.isfinite(at_goal.reward)
    assert at_goal.reward >= lost.reward


def test_a_camera_of_the_users_is_refused(name):
    with pytest.raises(ConfigError, match=rf"\[camera\]: {name} draws its frames itself; expected no camera"):
        build(name).use_camera(lambda size: None)


def test_without_opengl_every_robots_task_says_so_before_it_begins():
    program = """
import sys
import numpy as np
from services.robot_bridge.tasks import load_task
for name in sys.argv[1:]:
    try:
        load_task(name, rng=np.random.default_rng(0)).advance_to(0)
    except Exception as error:
        print(name, type(error).__name__, error)
"""
    result = subprocess.run(
        [sys.executable, "-c", program, *ROBOTS],
        cwd=ROOT,
        env={**os.environ, "MUJOCO_GL": "disabled"},
        capture_output=True,
        text=True,
        timeout=240,
        check=True,
    )
    error = "ServiceError this task has a camera, but MUJOCO_GL=disabled forbids OpenGL: unset it, or set egl"
    assert result.stdout.splitlines() == [f"{name} {error}" for name in ROBOTS]


# ---------------------------------------------------------------------- in real time


def test_in_simulated_real_time_the_task_is_the_same_as_in_lockstep(name):
    clock = SimulatedClock()
    live = load_task(name, pacing="realtime", rng=np.random.default_rng(3))
    lockstep = build(name, seed=3)
    live.start(clock)
    begun_ns = clock.now_ns()
    condition = clock.condition()
    rng = np.random.default_rng(0)
    shown = {live: [], lockstep: []}
    for task in shown:
        task.advance_to(begun_ns)
        task.begin_episode()
    for cycle in range(1, 16):
        # Never at the time of a packet or of a frame.
        now_ns = begun_ns + cycle * (cycle_ns(live) + 300_000)
        with condition:
            clock.wait_until(now_ns, condition)
        action = rng.uniform(live.spec.action_low, live.spec.action_high).astype(np.float32)
        for task, seen in shown.items():
            task.advance_to(now_ns)
            seen += [task.outcome(), [part.tobytes() for part in vars(task.read()).values()]]
            task.command(action)
            if cycle == 10:
                task.begin_attempt()
    assert shown[live] == shown[lockstep]
    live.close()
    lockstep.close()
    clock.end()
