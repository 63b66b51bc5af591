"""A MuJoCo world takes whole timesteps as dm_control does, and goes on in any portions of time."""

import importlib.util

import numpy as np
import pytest

from common.errors import ServiceError
from services.robot_bridge.robots.mujoco_world import MujocoWorld, load_suite_model

MS = 1_000_000
STARTS = {"reacher": [0.4, -1.0], "ball_in_cup": [0.0, 0.0, 0.1, 0.3]}
TIMESTEP_MS = {"reacher": 20, "ball_in_cup": 2}


def build(model, controls=(0.6, -0.4)):
    world = MujocoWorld(load_suite_model(model))
    world.reset(np.array(STARTS[model]))
    world.command(np.array(controls))
    return world


def state(world):
    return np.concatenate([world.data.qpos, world.data.qvel])


@pytest.fixture(params=sorted(STARTS))
def model(request):
    return request.param


def test_whole_timesteps_give_the_same_state_together_and_one_by_one(model):
    together, one_by_one = build(model), build(model)
    together.advance(200 * MS)
    for _ in range(200 // TIMESTEP_MS[model]):
        one_by_one.advance(TIMESTEP_MS[model] * MS)
    np.testing.assert_array_equal(state(together), state(one_by_one))


def test_the_portions_in_which_time_comes_change_nothing(model):
    whole, parts = build(model), build(model)
    portions = np.random.default_rng(0).integers(1, 30 * MS, 50)
    for portion in portions:
        parts.advance(int(portion))
    assert parts.data.time == pytest.approx(portions.sum() * 1e-9, abs=1e-12)
    whole.advance(int(portions.sum()))
    np.testing.assert_allclose(state(parts), state(whole), atol=1e-9)


def test_what_is_seen_between_two_timesteps_lies_between_them(model):
    world = build(model)
    world.advance(100 * MS)
    timestep = TIMESTEP_MS[model] * MS
    seen = [world.data.qpos[0]]
    for _ in range(10):
        world.advance(timestep // 10)
        seen.append(world.data.qpos[0])
    steps = np.diff(seen)
    assert (steps * np.sign(seen[-1] - seen[0]) > 0).all()


def test_a_nanosecond_before_a_whole_timestep_all_but_nothing_is_missing(model):
    world = build(model)
    timestep = TIMESTEP_MS[model] * MS
    world.advance(5 * timestep - 1)
    before = state(world)
    world.advance(1)
    np.testing.assert_allclose(state(world), before, atol=1e-4)
    later = state(world)
    world.advance(1)
    np.testing.assert_allclose(state(world), later, atol=1e-4)


def test_no_time_changes_nothing(model):
    world = build(model)
    before = state(world)
    world.advance(0)
    np.testing.assert_array_equal(state(world), before)


def test_a_command_within_a_timestep_acts_from_then_on():
    late, never, mean = (build("reacher", (0.0, 0.0)) for _ in range(3))
    for world in (late, never):
        world.advance(15 * MS)
    np.testing.assert_array_equal(state(late), state(never))
    late.command(np.array([1.0, -0.4]))
    late.advance(3 * MS)
    late.advance(22 * MS)
    # A quarter of the timestep with this command, then whole ones.
    mean.command(np.array([0.25, -0.1]))
    mean.advance(20 * MS)
    mean.command(np.array([1.0, -0.4]))
    mean.advance(20 * MS)
    np.testing.assert_allclose(state(late), state(mean), atol=1e-12)


def test_commands_within_a_timestep_count_by_how_long_they_last():
    many, mean = build("reacher", (0.0, 0.0)), build("reacher", (0.0, 0.0))
    for duration_ms, command in ((4, 1.0), (10, -0.5), (6, 0.2)):
        many.command(np.full(2, command))
        many.advance(duration_ms * MS)
    mean.command(np.full(2, (4 * 1.0 - 10 * 0.5 + 6 * 0.2) / 20))
    mean.advance(20 * MS)
    np.testing.assert_allclose(state(many), state(mean), atol=1e-12)


def test_a_stop_within_a_timestep_holds_where_the_joints_are_seen():
    world = build("reacher")
    world.advance(213 * MS)
    seen = world.data.qpos.copy()
    world.stop()
    for duration_ms in (1, 7, 40):
        world.advance(duration_ms * MS)
        np.testing.assert_array_equal(world.data.qpos, seen)


def test_positions_and_velocities_of_bodies_are_those_of_the_state():
    world = build("reacher")
    world.advance(70 * MS)
    shoulder, both = world.data.qpos[0], world.data.qpos.sum()
    expected = [0.12 * np.cos(shoulder) + 0.12 * np.cos(both), 0.12 * np.sin(shoulder) + 0.12 * np.sin(both), 0.01]
    np.testing.assert_allclose(world.data.body("finger").xpos, expected, atol=1e-12)


def test_a_command_is_not_the_callers_array_and_is_clipped():
    controls = np.array([5.0, -5.0])
    first, second = build("reacher", controls), build("reacher", (1.0, -1.0))
    controls[:] = 0
    for world in (first, second):
        world.advance(100 * MS)
    np.testing.assert_array_equal(state(first), state(second))


def test_a_reset_leaves_nothing_of_what_was_before(model):
    used, fresh = build(model), build(model, (0.0, 0.0))
    used.advance(333 * MS + 1)
    used.reset(np.array(STARTS[model]))
    np.testing.assert_array_equal(state(used)[len(STARTS[model]) :], 0)
    for world in (used, fresh):
        world.advance(100 * MS)
    np.testing.assert_array_equal(state(used), state(fresh))
    assert used.data.time == fresh.data.time


def test_stopping_brakes_the_motors_joints_only():
    world = build("ball_in_cup")
    world.advance(200 * MS)
    ball = world.data.qvel[2:].copy()
    assert (np.abs(world.data.qvel[:2]) > 0.01).all()
    world.stop()
    np.testing.assert_array_equal(world.data.qvel, [0, 0, *ball])
    np.testing.assert_array_equal(world.data.ctrl, 0)
    world.advance(2 * MS)
    np.testing.assert_array_equal(world.data.ctrl, 0)


def test_without_dm_control_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ServiceError, match="pip install dm-control"):
        load_suite_model("reacher")
