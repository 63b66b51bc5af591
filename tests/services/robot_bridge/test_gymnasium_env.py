"""Tasks through Gymnasium's interface: what its own checker wants, and what minimum-time tasks add to it."""

import copy
import functools
import os
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError, InvalidAction, ResetNeeded
from gymnasium.utils.env_checker import check_env

from common.errors import ConfigError, RelodError
from services.robot_bridge import gymnasium_env
from services.robot_bridge.class_table import load_class
from services.robot_bridge.gymnasium_env import TaskEnv
from services.robot_bridge.gymnasium_ids import tasks_by_id
from services.robot_bridge.tasks import TASKS, Task, load_task
from tests.helpers import TIMEOUT_S
from tests.services.builders import EventClock
from tests.services.robot_bridge.opengl import skip_without_opengl
from tests.services.robot_bridge.scripted import ScriptedTask

CENTRE = np.zeros(2, np.float32)
DISTURBED = sorted(
    identifier
    for identifier, name in tasks_by_id().items()
    if "disturbed" in load_class(Task, name, TASKS, "task").PRESETS
)


@functools.cache
def opengl_works() -> bool:
    """Whether MuJoCo can draw on this machine."""
    code = "import mujoco; mujoco.GLContext(32, 32).make_current()"
    probes = (
        subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "MUJOCO_GL": backend},
            capture_output=True,
            timeout=120,
            check=False,
        )
        for backend in ("egl", "osmesa")
    )
    return any(probe.returncode == 0 for probe in probes)


def make(identifier, **options) -> TaskEnv:
    """Make a task by its id, without Gymnasium's wrappers."""
    made = gymnasium.make(identifier, **options).unwrapped
    assert isinstance(made, TaskEnv)
    return made


@pytest.fixture(params=sorted(tasks_by_id()))
def identifier(request):
    """Each id whose task can show something here."""
    made = make(request.param)
    try:
        made.reset()
    except RelodError as error:
        if opengl_works():
            raise
        pytest.skip(f"no OpenGL on this machine: {error}")
    finally:
        made.close()
    return request.param


@pytest.fixture
def scripted(monkeypatch):
    """Return a function that makes a :class:`ScriptedTask` and the Gymnasium interface to it."""

    def make_scripted(*goal_cycles, **arguments):
        task = ScriptedTask(EventClock(), goal_cycles, pacing="lockstep", **arguments)
        monkeypatch.setattr(gymnasium_env, "load_task", lambda *_, **__: task)
        return TaskEnv("scripted"), task

    return make_scripted


def begun(task):
    """Which attempts and episodes were begun, in order."""
    return [what for what, *_ in task.log if what.startswith("begin")]


def until_the_end(interface, action=CENTRE):
    """Step until the attempt ends; return its last step and the number of steps."""
    for count in range(1, 10_000):
        taken = interface.step(action)
        if taken[2] or taken[3]:
            return taken, count
    raise AssertionError("the attempt never ended")


def flat(observation):
    """All numbers of an observation."""
    if isinstance(observation, dict):
        return np.concatenate([part.astype(np.float64).ravel() for part in observation.values()])
    return observation


def record(interface, seed, count=60):
    """Act at random, over resets, from a seeded reset on; return all that came back."""
    rng = np.random.default_rng(1)
    came = [interface.reset(seed=seed)]
    for _ in range(count):
        came.append(interface.step(rng.uniform(-1, 1, interface.action_space.shape).astype(np.float32)))
        if came[-1][2] or came[-1][3]:
            came.append(interface.reset())
    return came


def same(first, second):
    return len(first) == len(second) and all(
        np.array_equal(flat(a[0]), flat(b[0])) and a[1:] == b[1:] for a, b in zip(first, second, strict=True)
    )


# ---------------------------------------------------------------------- every task


def test_gymnasiums_checker_accepts_every_task(identifier):
    # pytest turns the checker's warnings into errors.
    check_env(make(identifier), skip_render_check=True)


def test_a_task_with_camera_is_also_rendered_as_the_checker_wants():
    check_env(make("relod/VisualDotReacher-v0", render_mode="rgb_array"))


def test_observations_are_as_the_tasks_specification_says(identifier):
    interface = make(identifier)
    task = load_task(tasks_by_id()[identifier], rng=np.random.default_rng(0))
    sizes, space = task.spec.dimensions, interface.observation_space
    task.close()
    if sizes.S:
        assert list(space) == ["frames", "proprioception"]
        assert (space["frames"].shape, space["frames"].dtype) == ((sizes.H, sizes.W, sizes.S * sizes.C), np.uint8)
        space = space["proprioception"]
    assert isinstance(space, gymnasium.spaces.Box)
    assert (space.shape, space.dtype) == ((sizes.P,), np.float32)
    assert np.isfinite([space.low, space.high]).all()
    assert (space.low < task.spec.proprioception_low).all()
    assert (space.high > task.spec.proprioception_high).all()
    assert interface.task_spec.proprioception_high.tolist() == task.spec.proprioception_high.tolist()
    assert interface.action_space == gymnasium.spaces.Box(-1, 1, (sizes.A,), np.float32)


def test_a_seed_determines_everything_whatever_was_before(identifier):
    fresh, used = make(identifier, time_limit=7), make(identifier, time_limit=7)
    record(used, seed=3, count=11)
    first = record(fresh, seed=5)
    assert same(first, record(used, seed=5))
    assert not same(first, record(used, seed=6))


@pytest.mark.parametrize("identifier", DISTURBED)
def test_a_seed_determines_also_what_disturbs_a_robot(identifier):
    skip_without_opengl()
    fresh, used = make(identifier, preset="disturbed", time_limit=7), make(identifier, preset="disturbed", time_limit=7)
    record(used, seed=3, count=11)
    first = record(fresh, seed=5, count=20)
    assert same(first, record(fresh, seed=5, count=20))
    assert same(first, record(used, seed=5, count=20))


def test_the_interface_adds_nothing_to_the_task():
    # The dot's bounds are -1 and 1, so actions are the task's own.
    interface, rng = make("relod/DotReacher-v0"), np.random.default_rng(8)
    task = load_task("dot_reacher", rng=rng)
    task.advance_to(0)
    task.begin_episode()
    observation, _ = interface.reset(seed=8)
    for cycle in range(1, 31):
        assert observation.tolist() == task.read().proprioception.tolist()
        action = np.array([np.sin(cycle), np.cos(cycle)], np.float32)
        task.command(action)
        task.advance_to(cycle * 40_000_000)
        observation, reward, terminated, truncated, _ = interface.step(action)
        assert (reward, terminated, truncated) == (-1.0, task.outcome().terminated, False)


# ---------------------------------------------------------------------- episodes, attempts, steps


def test_after_a_truncation_the_goal_stays_and_after_a_termination_it_is_a_new_one(scripted):
    interface, task = scripted(7, time_limit=3)
    interface.reset()
    ends = []
    for _ in range(3):
        (_, reward, terminated, truncated, _), count = until_the_end(interface)
        assert reward == -1.0
        ends.append((count, terminated, truncated))
        interface.reset()
    assert ends == [(3, False, True), (3, False, True), (1, True, False)]
    assert begun(task) == ["begin_episode", "begin_attempt", "begin_attempt", "begin_episode"]


def test_the_goal_in_the_last_step_before_the_limit_is_no_truncation(scripted):
    interface, _ = scripted(3, time_limit=3)
    interface.reset()
    (_, _, terminated, truncated, info), _ = until_the_end(interface)
    assert (terminated, truncated, info["is_success"]) == (True, False, True)


def test_a_reset_in_the_middle_of_an_attempt_keeps_the_goal_and_takes_no_steps(scripted):
    interface, task = scripted(reset_steps=9)
    interface.reset()
    interface.reset()
    interface.step(CENTRE)
    _, info = interface.reset()
    assert begun(task) == ["begin_episode", "begin_attempt", "begin_attempt"]
    assert info == {"is_success": False, "attempt": 3, "episode_steps": 1}


@pytest.mark.parametrize("arguments", [{"seed": 1}, {"options": {"new_goal": True}}])
def test_a_new_goal_can_be_asked_for(scripted, arguments):
    interface, task = scripted(time_limit=1)
    interface.reset()
    until_the_end(interface)
    interface.reset(options={"new_goal": False})
    _, info = interface.reset(**arguments)
    assert begun(task) == ["begin_episode", "begin_attempt", "begin_episode"]
    assert info == {"is_success": False, "attempt": 1, "episode_steps": 0}


def test_a_task_without_goal_begins_an_episode_with_each_reset(scripted):
    interface, task = scripted(time_limit=2, reset_steps=4, has_goal=False)
    for _ in range(3):
        _, info = interface.reset()
        assert info == {"is_success": False, "attempt": 1, "episode_steps": 0}
        until_the_end(interface)
    assert begun(task) == ["begin_episode"] * 3


def test_steps_of_an_episode_are_counted_as_in_the_thesis(scripted):
    # Section 6.1: limit 100, reset 20 steps, three time-outs, then the goal in 25 steps: 3 * (100 + 20) + 25.
    interface, _ = scripted(325, time_limit=100, reset_steps=20)
    infos = []
    for _ in range(4):
        infos.append(interface.reset()[1])
        (*_, info), _ = until_the_end(interface)
        infos.append(info)
    assert [(info["attempt"], info["episode_steps"]) for info in infos] == [
        (1, 0), (1, 100), (2, 120), (2, 220), (3, 240), (3, 340), (4, 360), (4, 385),
    ]  # fmt: skip
    assert [info["is_success"] for info in infos] == [False] * 7 + [True]
    assert interface.reset()[1] == {"is_success": False, "attempt": 1, "episode_steps": 0}


def test_the_reset_after_a_time_out_takes_its_time_at_rest(scripted):
    interface, task = scripted(time_limit=2, reset_steps=3)
    interface.reset()
    until_the_end(interface)
    interface.reset()
    assert task.advanced_to_ns == [cycle * 40_000_000 for cycle in range(6)]
    assert [what for what, *_ in task.log][-2:] == ["stop", "begin_attempt"]


# ---------------------------------------------------------------------- actions and observations


@pytest.mark.parametrize(
    ("action", "command"),
    [([0.5, -0.5], [0.5, -1.0]), ([3, -3], [1.0, -2.0]), (np.float64([0, 1]), [0.0, 2.0])],
)
def test_actions_are_shares_of_the_tasks_bounds_and_clipped_to_them(scripted, action, command):
    interface, task = scripted()  # Its bounds are 1 and 2.
    interface.reset()
    interface.step(action)
    assert list(task.log[-1][2:]) == command


def test_only_what_lies_far_beyond_the_tasks_range_is_clipped(scripted):
    interface, task = scripted()  # Its range is -1 to 1.
    task.offset = 9.5
    assert interface.reset()[0].tolist() == [9.5, 9.5]
    task.offset = -50.0
    observation, *_ = interface.step(CENTRE)
    assert observation.tolist() == [-10.0, -10.0]
    assert observation in interface.observation_space


def test_frames_are_stacked_oldest_first_and_do_not_reach_back_into_the_attempt_before(scripted):
    interface, _ = scripted(camera=True)  # Two new frames a reading, whose pixels are their ids; two are stacked.
    for first in (0, 4):
        observation, _ = interface.reset()
        assert observation["frames"].shape == (2, 3, 6)
        assert observation["frames"][0, 0].tolist() == [first] * 3 + [first + 1] * 3
        observation, *_ = interface.step(CENTRE)
        assert observation["frames"][1, 2].tolist() == [first + 2] * 3 + [first + 3] * 3


def test_the_first_frame_of_an_attempt_fills_the_stack():
    interface = make("relod/VisualDotReacher-v0", time_limit=1)
    interface.reset(seed=0)
    for _ in range(2):
        interface.step(np.ones(2, np.float32))
        oldest, middle, newest = np.split(interface.reset()[0]["frames"], 3, axis=-1)
        assert (oldest == newest).all()
        assert (middle == newest).all()


def test_observations_that_were_kept_stay_what_they_were():
    interface = make("relod/VisualDotReacher-v0")
    kept = [interface.reset(seed=0)[0]]
    copies = [flat(kept[0]).copy()]
    for _ in range(5):
        kept.append(interface.step(np.ones(2, np.float32))[0])
        copies.append(flat(kept[-1]).copy())
    assert all(np.array_equal(flat(a), b) for a, b in zip(kept, copies, strict=True))


def test_the_newest_frame_is_rendered():
    interface = make("relod/VisualDotReacher-v0", render_mode="rgb_array")
    assert interface.render() is None
    observation, _ = interface.reset(seed=0)
    assert (interface.render() == observation["frames"][..., -3:]).all()
    observation, *_ = interface.step(np.ones(2, np.float32))
    assert (interface.render() == observation["frames"][..., -3:]).all()
    assert interface.metadata["render_fps"] == 25


def test_nothing_is_rendered_unless_asked_for():
    interface = make("relod/VisualDotReacher-v0")
    interface.reset()
    assert interface.render() is None


def test_preset_and_settings_reach_the_task():
    interface = make("relod/DotReacher-v0", preset="thesis", time_limit=4)
    interface.reset(seed=0)
    _, count = until_the_end(interface)
    assert count == 4
    assert interface.reset()[1]["episode_steps"] == 4 + 20  # The preset's reset steps; the default has 10.


@pytest.mark.parametrize(
    "low", [[-0.5, 0, 0], (-0.5, 0, 0), np.array([-0.5, 0, 0], np.float32), [np.float32(-0.5), np.int64(0), 0.0]]
)
def test_a_list_may_be_a_tuple_or_an_array_and_hold_whole_numbers(low):
    with pytest.raises(ConfigError, match=r"box_low = \[-0.5, 0.0, 0.0\]: .* box_high = \[-1.0, 0.5, 1.0\]"):
        gymnasium.make("relod/Ur5VisualReacher-v0", box_low=low, box_high=(-1, 0.5, 1))
    made = gymnasium.make("relod/Ur5VisualReacher-v0", box_low=low)
    made.close()


@pytest.mark.parametrize("low", [("a", 0, 0), np.zeros((1, 3)), np.array(["a", "b", "c"]), [True, 0, 0], 0, None])
def test_what_is_no_list_of_numbers_is_refused(low):
    with pytest.raises(ConfigError, match=r"box_low = .*: expected a list of numbers"):
        gymnasium.make("relod/Ur5VisualReacher-v0", box_low=low)


def test_several_run_side_by_side():
    vector = gymnasium.make_vec("relod/DotReacher-v0", 2, "sync", time_limit=3)
    observations, _ = vector.reset(seed=4)
    alone = make("relod/DotReacher-v0", time_limit=3)
    assert observations[0].tolist() == alone.reset(seed=4)[0].tolist()
    assert observations[1].tolist() == alone.reset(seed=5)[0].tolist()
    vector.close()


# ---------------------------------------------------------------------- what is refused


def test_stepping_needs_a_running_attempt(scripted):
    interface, _ = scripted(time_limit=1)
    with pytest.raises(ResetNeeded, match=r"has not begun; call reset\(\)"):
        interface.step(CENTRE)
    interface.reset()
    interface.step(CENTRE)
    with pytest.raises(ResetNeeded, match=r"has ended; call reset\(\)"):
        interface.step(CENTRE)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(3, np.float32), r"shape \(2,\), got shape \(3,\)"),
        (np.zeros((1, 2), np.float32), r"shape \(2,\), got shape \(1, 2\)"),
        (0.0, r"shape \(2,\), got shape \(\)"),
        ([np.nan, 0.0], r"finite numbers in \[-1, 1\], got \[nan"),
        ([0.0, np.inf], r"finite numbers"),
        (["left", "up"], r"numbers of shape \(2,\), got \['left'"),
        (np.array([1 + 1j, 0]), r"numbers of shape \(2,\), got array\(\[1.\+1.j"),
        ([0.5j, 0.5], r"numbers of shape \(2,\), got \[0.5j"),
        (None, r"got shape \(\)"),
    ],
)
def test_an_action_that_is_none_is_refused_and_moves_nothing(scripted, action, message):
    interface, task = scripted()
    interface.reset()
    before = list(task.log), list(task.advanced_to_ns)
    with pytest.raises(InvalidAction, match=message):
        interface.step(action)
    assert (task.log, task.advanced_to_ns) == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"preset": "nope"}, r"preset = 'nope': task dot_reacher has the presets demo, thesis"),
        ({"time_limt": 5}, r"unknown key 'time_limt'; did you mean 'time_limit'\?"),
        ({"time_limit": 0}, r"time_limit = 0: expected at least 1"),
    ],
)
def test_unknown_presets_and_settings_are_refused_by_name(options, message):
    with pytest.raises(ConfigError, match=message):
        gymnasium.make("relod/DotReacher-v0", **options)


def test_pictures_of_a_task_without_camera_can_be_asked_for_but_there_are_none():
    interface = make("relod/DotReacher-v0", render_mode="rgb_array")
    interface.reset()
    assert (interface.render_mode, interface.metadata["render_modes"], interface.render()) == (None, [], None)


def test_unknown_render_modes_are_refused():
    with pytest.raises(ConfigError, match="render_mode = 'ansi': expected None or 'rgb_array'"):
        TaskEnv("dot_reacher", render_mode="ansi")


def test_unknown_reset_options_are_refused(scripted):
    interface, task = scripted()
    with pytest.raises(ConfigError, match="unknown option 'goal'; known: new_goal"):
        interface.reset(options={"goal": True})
    assert begun(task) == []


def test_a_closed_task_is_let_go_once_and_does_nothing_more(scripted):
    interface, task = scripted()
    interface.reset()
    interface.close()
    interface.close()
    assert [what for what, *_ in task.log].count("close") == 1
    for call in (interface.reset, lambda: interface.step(CENTRE)):
        with pytest.raises(ClosedEnvironmentError, match="is closed; make a new one"):
            call()


def test_a_large_action_is_clipped_and_an_infinite_one_refused():
    interface = make("relod/DotReacher-v0")
    interface.reset(seed=0)
    interface.step(np.array([1e300, -1e300]))
    with pytest.raises(InvalidAction, match="finite"):
        interface.step(np.array([np.inf, 0.0]))


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, pickle.dumps])
def test_a_copy_is_refused_rather_than_made_of_half_a_world(copied):
    with pytest.raises(TypeError, match="cannot be copied or pickled: make another one"):
        copied(make("relod/ReacherEasy-v0"))


def test_any_thread_may_use_an_environment(identifier):
    one, other = make(identifier), make(identifier)

    def frames_and_more(observation):
        return list(observation.values()) if isinstance(observation, dict) else [observation]

    with ThreadPoolExecutor(1) as threads:
        for call in (
            lambda made: made.reset(seed=3),
            lambda made: made.step(np.ones(made.action_space.shape)),
            lambda made: made.reset(seed=4),
        ):
            here, there = call(one), threads.submit(call, other).result(TIMEOUT_S)
            for mine, theirs in zip(frames_and_more(here[0]), frames_and_more(there[0]), strict=True):
                np.testing.assert_array_equal(mine, theirs)
    one.step(np.ones(one.action_space.shape))
    other.step(np.ones(other.action_space.shape))  # in this thread, and the other one has ended
    one.close()
    other.close()
