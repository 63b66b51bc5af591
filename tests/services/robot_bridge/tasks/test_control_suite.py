"""The tasks made from the DeepMind Control Suite: dm_control's physics, starts and success; the thesis's episodes."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from common.clock import SystemClock
from services.robot_bridge.tasks import load_task
from services.robot_bridge.tasks.control_suite import LONGEST_GAP_CYCLES
from tests.services.robot_bridge.tasks.suite import environment_like, take_over_state

ROOT = Path(__file__).resolve().parents[4]
STATE_TASKS = ["reacher_easy", "reacher_hard", "reacher_extreme", "ball_in_cup"]
CYCLE_NS = 40_000_000


@pytest.fixture(params=STATE_TASKS)
def name(request):
    return request.param


def build(name, seed=0, preset="", **settings):
    task = load_task(name, preset, settings, rng=np.random.default_rng(seed))
    task.advance_to(0)
    return task


def joints(task):
    return np.concatenate([task._world.data.qpos, task._world.data.qvel])


def suite_joints(environment):
    return np.concatenate([environment.physics.data.qpos, environment.physics.data.qvel])


def random_actions(count, seed=1):
    return np.tanh(np.random.default_rng(seed).standard_normal((count, 2))).astype(np.float32)


# ---------------------------------------------------------------------- the same as dm_control


def test_an_action_cycle_is_dm_controls_control_step(name):
    task, environment = build(name), environment_like(name)
    assert environment.control_timestep() == task.spec.world_seconds_per_cycle == 0.02
    now_ns = 0
    for start in range(3):
        task.begin_episode()
        take_over_state(environment, task)
        for action in random_actions(200, seed=start):
            task.command(action)
            now_ns += CYCLE_NS
            task.advance_to(now_ns)
            environment.step(action)
            np.testing.assert_array_equal(joints(task), suite_joints(environment))


def test_an_episode_ends_where_dm_controls_reward_is_one(name):
    task, environment = build(name), environment_like(name)
    now_ns, ends = 0, []
    for start in range(60):
        task.begin_episode()
        take_over_state(environment, task)
        for action in random_actions(10, seed=start):
            task.command(action)
            now_ns += CYCLE_NS
            task.advance_to(now_ns)
            outcome, reward = task.outcome(), environment.step(action).reward
            assert outcome.reward == -1.0
            assert outcome.terminated is (reward == 1.0)
            ends.append(outcome.terminated)
    assert False in ends
    assert (True in ends) is (name != "reacher_extreme")


def test_the_observation_is_dm_controls_without_what_a_camera_must_see(name):
    task, environment = build(name), environment_like(name)
    task.begin_episode()
    take_over_state(environment, task)
    action = np.array([0.9, -0.7], np.float32)
    task.command(action)
    task.advance_to(CYCLE_NS)
    seen = environment.step(action).observation
    parts = [seen["position"], seen["velocity"], *([seen["to_target"]] if "to_target" in seen else [])]
    np.testing.assert_array_equal(task.read().proprioception, np.concatenate(parts).astype(np.float32))
    visual = load_task(f"{name}_visual", rng=np.random.default_rng(0))
    visual._world.data.qpos[:], visual._world.data.qvel[:] = seen["position"], seen["velocity"]
    left = parts[1:2] if name == "ball_in_cup" else parts[:2]
    np.testing.assert_array_equal(visual._proprioception(), np.concatenate(left))
    assert sum(map(len, left)) == visual.spec.dimensions.P


def test_starts_are_distributed_as_dm_controls(name):
    task, environment = build(name), environment_like(name)
    ours, theirs = [], []
    for _ in range(400):
        task.begin_episode()
        environment.reset()
        ours.append(start_of(task._world.model, task._world.data))
        theirs.append(start_of(environment.physics.model.ptr, environment.physics.data.ptr))
    ours, theirs = np.array(ours), np.array(theirs)
    spread = theirs.std(axis=0)
    # The difference of two means of 400 has a standard deviation of spread / sqrt(200): 4.5 of them do not happen.
    assert (np.abs(ours.mean(axis=0) - theirs.mean(axis=0)) <= 4.5 * spread / np.sqrt(200)).all()
    assert (np.abs(ours.std(axis=0) - spread) <= 0.15 * spread).all()
    for share in (0.02, 0.25, 0.75, 0.98):
        assert (np.abs(np.quantile(ours, share, axis=0) - np.quantile(theirs, share, axis=0)) <= 0.3 * spread).all()


def start_of(model, data):
    """Joints, and where there is one, the target's position and distance from the middle."""
    names = [model.geom(i).name for i in range(model.ngeom)]
    x, y = model.geom("target").pos[:2] if "target" in names else (0.0, 0.0)
    return [*data.qpos, x, y, np.hypot(x, y)]


# ---------------------------------------------------------------------- the thesis's episodes


def goal(task):
    return task.read().proprioception[-2:] if "reacher" in task.spec.task else np.zeros(2)


@pytest.mark.parametrize("reacher", ["reacher_easy", "reacher_hard", "reacher_extreme"])
def test_a_time_out_keeps_the_target_and_moves_the_joints(reacher):
    task = build(reacher)
    targets, starts = [], []
    for _ in range(5):
        task.command(np.ones(2, np.float32))
        task.advance_to((len(starts) + 1) * 7 * CYCLE_NS)
        task.begin_attempt()
        targets.append(task._world.data.geom("target").xpos.tobytes())
        starts.append(tuple(joints(task)))
    assert len(set(targets)) == 1
    assert len({start[:2] for start in starts}) == 5
    assert {start[2:] for start in starts} == {(0.0, 0.0)}
    task.begin_episode()
    assert task._world.data.geom("target").xpos.tobytes() not in targets


def test_a_time_out_of_ball_in_cup_moves_the_ball_and_centres_the_cup():
    task = build("ball_in_cup")
    starts = []
    for _ in range(5):
        task.command(np.ones(2, np.float32))
        task.advance_to((len(starts) + 1) * 7 * CYCLE_NS)
        task.begin_attempt()
        starts.append(tuple(joints(task)))
    assert {start[:2] + start[4:] for start in starts} == {(0.0,) * 6}
    assert len({start[2:4] for start in starts}) == 5


def test_resets_repeat_with_the_seed(name):
    runs = []
    for seed in (4, 4, 5):
        task = build(name, seed)
        runs.append([])
        for begin in (task.begin_episode, task.begin_attempt, task.begin_attempt, task.begin_episode) * 3:
            begin()
            runs[-1].append((joints(task).tobytes(), goal(task).tobytes()))
    assert runs[0] == runs[1]
    assert runs[0] != runs[2]


@pytest.mark.parametrize(
    ("task", "preset", "limit"),
    [
        ("reacher_easy", "demo", 50),
        ("reacher_hard", "thesis", 1000),
        ("ball_in_cup", "demo", 50),
        ("ball_in_cup", "thesis", 100),
    ],
)
def test_presets_are_those_of_the_thesis(task, preset, limit):
    spec = build(task, preset=preset).spec
    assert (spec.time_limit_steps, spec.reset_steps) == (limit, 20)
    assert (spec.action_cycle_time_s, spec.world_seconds_per_cycle) == (0.04, 0.02)


@pytest.mark.parametrize(
    ("task", "shape", "margin"),
    [("reacher_hard_visual", [70, 100, 3], [7, 10]), ("ball_in_cup_visual", [100, 120, 3], [10, 12])],
)
def test_frames_are_as_large_as_the_thesis_says(task, shape, margin):
    spec = build(task).spec
    assert (spec.frame_shape.tolist(), spec.crop_margin.tolist(), spec.frame_stack) == (shape, margin, 3)


# ---------------------------------------------------------------------- a world that goes on


def test_a_late_look_finds_a_world_that_has_gone_on(name):
    late, punctual = build(name, seed=2), build(name, seed=2)
    for task in (late, punctual):
        task.command(np.array([0.5, -1.0], np.float32))
    late.advance_to(3 * CYCLE_NS)
    for cycle in (1, 2, 3):
        punctual.advance_to(cycle * CYCLE_NS)
    np.testing.assert_array_equal(joints(late), joints(punctual))


@pytest.mark.parametrize("cycle_s", [0.04, 0.03, 0.007, 0.1])
def test_a_cycle_brings_20_ms_of_world_whatever_its_length_and_whenever_someone_looks(name, cycle_s):
    task = build(name, action_cycle_time=cycle_s)
    rng, now_ns, end_ns = np.random.default_rng(0), 0, round(30 * cycle_s * 1e9)
    while now_ns < end_ns:
        now_ns = min(now_ns + int(rng.integers(1, round(cycle_s * 1e9))), end_ns)
        task.advance_to(now_ns)
    assert task._world.data.time == pytest.approx(30 * 0.02, abs=1e-9)


def test_of_a_suspended_computers_gap_a_bounded_part_is_lived_through(name):
    task = build(name)
    began_ns = SystemClock().now_ns()
    task.advance_to(3600 * 10**9)
    assert task._world.data.time == pytest.approx(LONGEST_GAP_CYCLES * 0.02)
    assert SystemClock().now_ns() - began_ns < 10**10  # 90 000 cycles would take minutes
    before = task._world.data.time
    task.advance_to(3600 * 10**9 + CYCLE_NS)
    assert task._world.data.time - before == pytest.approx(0.02)


def test_a_robot_can_be_read_before_its_first_episode(name):
    task = build(name)
    assert np.isfinite(task.read().proprioception).all()
    assert not np.array_equal(joints(task)[:4], np.zeros(4))


@pytest.mark.parametrize("backend", ["", "egl", "osmesa"])
def test_tasks_without_camera_load_no_opengl(backend):
    program = """
import sys
import numpy as np
from services.robot_bridge.tasks import load_task
for name in sys.argv[1:]:
    task = load_task(name, rng=np.random.default_rng(0))
    task.advance_to(0)
    task.command(np.ones(2, np.float32))
    task.advance_to(40_000_000)
    task.read()
    task.close()
print([m for m in sys.modules if m.split(".")[0] in ("OpenGL", "torch", "triton", "dm_control")])
"""
    arguments = [sys.executable, "-c", program, *STATE_TASKS]
    environment = {**os.environ, "MUJOCO_GL": backend}
    result = subprocess.run(
        arguments, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "[]"
