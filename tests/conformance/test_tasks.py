"""What every task in the table has to be, and what the first ones are in particular."""

import numpy as np
import pytest

from common.algorithms import ALGORITHMS
from common.algorithms.presets import resolve_config
from common.codec import decode, encode
from common.errors import ConfigError
from common.frame_ring import central_crop, central_crop_offset, crop_shape
from common.messages import TaskSpec
from common.networks.sizes import cropped_shape, map_size
from services.robot_bridge.robots.dot import MAX_SPEED, Dot
from services.robot_bridge.tasks import TASKS, load_task
from services.robot_bridge.tasks.control_suite import ControlSuiteTask
from services.robot_bridge.tasks.noise_frames import read_frame_id
from services.robot_bridge.tasks.robot_task import RobotTask
from services.robot_bridge.tasks.visual_dot_reacher import BACKGROUND_RGB, DOT_RADIUS, DOT_RGB, TARGET_RGB
from tests.services.robot_bridge.opengl import skip_without_opengl

BUILT = {name: load_task(name, rng=np.random.default_rng(0)) for name in sorted(TASKS)}
RENDERED = {
    name
    for name, task in BUILT.items()
    if isinstance(task, RobotTask) or (isinstance(task, ControlSuiteTask) and task.WINDOW)
}
"""Tasks whose frames MuJoCo renders."""
FIXED_START = {"ur5_visual_reacher", "ur5_visual_reacher_min_time"}
"""Tasks whose attempts all start from the same place; only the goal differs."""
PRESETS = [(name, preset) for name, task in BUILT.items() for preset in task.PRESETS]


@pytest.fixture(params=sorted(TASKS))
def name(request):
    """Each task of the table."""
    if request.param in RENDERED:
        skip_without_opengl()
    return request.param


def build(name, preset="", seed=0, **overrides):
    return load_task(name, preset, overrides, rng=np.random.default_rng(seed))


def cycle_ns(task):
    return round(task.spec.action_cycle_time_s * 1e9)


def drive(task, actions, start_ns=0):
    """Run one attempt; return the readings and the outcomes of its cycles."""
    now_ns = start_ns
    task.advance_to(now_ns)
    task.begin_episode()
    readings, outcomes = [task.read()], []
    for action in actions:
        task.command(action)
        now_ns += cycle_ns(task)
        task.advance_to(now_ns)
        outcomes.append(task.outcome())
        readings.append(task.read())
    return readings, outcomes


def random_actions(task, count=40, seed=1):
    spec = task.spec
    return (
        np.random.default_rng(seed)
        .uniform(spec.action_low, spec.action_high, (count, len(spec.action_low)))
        .astype(np.float32)
    )


def same(a, b):
    return all(
        np.array_equal(getattr(a, field), getattr(b, field))
        for field in ("frames", "frame_ids", "frame_capture_ns", "proprioception")
    )


@pytest.mark.parametrize(("name", "preset"), PRESETS)
def test_every_preset_loads_and_describes_itself(name, preset):
    task = load_task(name, preset, pacing="realtime", rng=np.random.default_rng(0))
    spec = task.spec
    assert (spec.task, spec.preset, spec.pacing) == (name, preset, "realtime")
    received = decode(encode(spec), TaskSpec)
    for field, value in vars(spec).items():
        np.testing.assert_array_equal(getattr(received, field), value)
    assert (spec.action_low < spec.action_high).all()
    assert (spec.proprioception_low < spec.proprioception_high).all()
    assert spec.world_seconds_per_cycle > 0
    assert spec.has_camera == bool(spec.frame_shape.all())
    if spec.has_camera:
        assert min(crop_shape(spec)) >= 1


def test_the_presets_a_task_asks_for_exist_for_every_algorithm_and_fit_its_frames(name):
    spec = build(name).spec
    for algorithm in ALGORITHMS:
        config = resolve_config(algorithm, spec.algorithm_presets[algorithm], {})
        if spec.has_camera:
            height, width, _ = cropped_shape(spec)
            assert min(map_size(height, width, config.encoder_strides)) >= 1


def test_the_first_preset_is_the_default(name):
    task = build(name)
    assert task.spec.preset == next(iter(task.PRESETS)) == "demo"


def test_readings_are_as_the_specification_says(name):
    task = build(name)
    sizes = task.spec.dimensions
    for reading in drive(task, random_actions(task))[0]:
        assert reading.proprioception.dtype == np.float32
        assert reading.proprioception.shape == (sizes.P,)
        assert np.isfinite(reading.proprioception).all()
        new = len(reading.frame_ids)
        assert (reading.frames.dtype, reading.frames.shape) == (np.uint8, (new, sizes.H, sizes.W, sizes.C))
        assert (reading.frame_ids.dtype, reading.frame_capture_ns.dtype) == (np.int64, np.int64)
        assert reading.frame_capture_ns.shape == (new,)
        # The range that the learner normalises by holds what is seen, but for a rebound at a wall.
        width = task.spec.proprioception_high - task.spec.proprioception_low
        assert (reading.proprioception >= task.spec.proprioception_low - 0.1 * width).all()
        assert (reading.proprioception <= task.spec.proprioception_high + 0.1 * width).all()


def test_rewards_and_ends_are_plain_numbers(name):
    task = build(name)
    for outcome in drive(task, random_actions(task))[1]:
        assert np.isfinite(outcome.reward)
        assert isinstance(outcome.terminated, bool)
        assert not outcome.terminated or task.spec.has_goal


def test_frame_ids_are_consecutive_over_attempts_and_never_used_twice(name):
    task = build(name)
    ids, captured = [], []
    for attempt in range(3):
        for reading in drive(task, random_actions(task, 7), start_ns=attempt * 10**9)[0]:
            ids += reading.frame_ids.tolist()
            captured += reading.frame_capture_ns.tolist()
    assert ids == list(range(len(ids)))
    assert captured == sorted(captured)
    assert bool(ids) == task.spec.has_camera


def test_an_attempt_begins_with_a_frame_if_there_is_a_camera(name):
    task = build(name)
    for attempt in range(3):
        assert bool(len(drive(task, [], attempt * 10**9)[0][0].frame_ids)) == task.spec.has_camera


def test_the_same_seed_gives_the_same_world_and_another_seed_another(name):
    tasks = [build(name, seed=seed) for seed in (5, 5, 6)]
    first, again, other = (drive(task, random_actions(task)) for task in tasks)
    assert all(same(a, b) for a, b in zip(first[0], again[0], strict=True))
    assert first[1] == again[1]
    assert not all(same(a, b) for a, b in zip(first[0], other[0], strict=True))


def test_attempts_begin_in_different_places(name):
    task = build(name)
    task.advance_to(0)
    starts = []
    for _ in range(5):
        if name in FIXED_START:
            task.begin_episode()
        else:
            task.begin_attempt()
        reading = task.read()
        starts.append((reading.proprioception.tobytes(), reading.frames.tobytes()))
    assert len(set(starts)) == 5


def test_the_world_goes_on_with_time_and_not_without(name):
    task = build(name, seed=3)
    task.advance_to(0)
    task.begin_episode()
    task.command(task.spec.action_high)
    before = task.read().proprioception
    task.advance_to(0)
    np.testing.assert_array_equal(task.read().proprioception, before)
    task.advance_to(-1)  # a clock never runs back
    np.testing.assert_array_equal(task.read().proprioception, before)
    # Long enough for a packet of sensors that are slower than the cycle.
    half_ns = max(cycle_ns(task) // 2, task.RATES.sensors_ns if isinstance(task, RobotTask) else 0)
    task.advance_to(half_ns)
    halfway = task.read().proprioception
    task.advance_to(2 * half_ns)
    if name != "noise_frames":  # has no state
        assert not np.array_equal(halfway, before)
        assert not np.array_equal(task.read().proprioception, halfway)


def test_the_clock_may_start_anywhere(name):
    runs = [drive(task, random_actions(task), start) for task, start in ((build(name), 0), (build(name), 7 * 10**17))]
    for early, late in zip(runs[0][0], runs[1][0], strict=True):
        np.testing.assert_array_equal(early.proprioception, late.proprioception)
        np.testing.assert_array_equal(early.frames, late.frames)


def test_a_stopped_robot_rests(name):
    if name.startswith("ball_in_cup"):
        pytest.skip("the ball swings on; test_ball_in_cup.py says what stops")
    task = build(name, seed=3)
    drive(task, random_actions(task, 3))
    now_ns = 3 * cycle_ns(task)
    task.stop()
    task.advance_to(now_ns + cycle_ns(task))
    rest = task.read().proprioception
    task.advance_to(now_ns + 20 * cycle_ns(task))
    np.testing.assert_array_equal(task.read().proprioception, rest)
    task.close()


def test_a_command_stays_until_the_next_and_is_not_the_callers_array(name):
    tasks = [build(name, seed=3) for _ in range(2)]
    for task in tasks:
        task.advance_to(0)
        task.begin_episode()
        task.read()
    action = tasks[0].spec.action_high.copy()
    tasks[0].command(action)
    action[:] = 0
    tasks[1].command(tasks[1].spec.action_high)
    for task in tasks:
        task.advance_to(3 * cycle_ns(task))
    np.testing.assert_array_equal(tasks[0].read().proprioception, tasks[1].read().proprioception)


def test_the_settings_decide_limit_reset_and_cycle(name):
    spec = build(name, time_limit=7, reset_steps=3, action_cycle_time=0.1).spec
    assert (spec.time_limit_steps, spec.reset_steps, spec.action_cycle_time_s) == (7, 3, 0.1)


@pytest.mark.parametrize(
    ("overrides", "match"),
    [
        ({"time_limit": 0}, "time_limit = 0: expected at least 1"),
        ({"time_limit": 2.5}, "time_limit = 2.5: expected a whole number"),
        ({"reset_steps": -1}, "reset_steps = -1: expected at least 0"),
        ({"action_cycle_time": 0.0}, "action_cycle_time = 0.0: expected a value from 0.001 to 10.0"),
        ({"action_cycle_time": float("nan")}, "action_cycle_time = nan: expected a finite number"),
        ({"time_limt": 5}, "unknown key 'time_limt'; did you mean 'time_limit'"),
    ],
)
def test_a_wrong_setting_is_named_with_its_value_and_what_was_expected(name, overrides, match):
    with pytest.raises(ConfigError, match=match):
        build(name, **overrides)


def test_an_unknown_preset_is_named_with_the_known_ones(name):
    with pytest.raises(ConfigError, match=r"preset = 'extreme'.*" + ", ".join(build(name).PRESETS)):
        build(name, "extreme")


def test_an_unknown_task_is_named_with_the_known_ones():
    with pytest.raises(ConfigError, match=r"'dot'.*" + ", ".join(sorted(TASKS))):
        build("dot")


def test_a_row_in_the_configuration_adds_a_task():
    rows = {"mine": "services.robot_bridge.tasks.dot_reacher:DotReacher"}
    assert load_task("mine", rows=rows, rng=np.random.default_rng(0)).spec.task == "mine"


@pytest.mark.parametrize("target", ["nowhere:Task", "services.robot_bridge.tasks:Nobody", "no colon", "os:path", 3])
def test_a_row_that_leads_to_no_task_is_named(target):
    with pytest.raises(ConfigError, match=r"\[tasks\] mine = .*: expected"):
        load_task("mine", rows={"mine": target}, rng=np.random.default_rng(0))


@pytest.mark.parametrize(
    ("target", "match"),
    [
        ("nowhere:Task", "No module named 'nowhere'; the folder that it is in has to be on PYTHONPATH"),
        ("services.robot_bridge.tasks:Nobody", "has no attribute 'Nobody'"),
        ("os.path:join", "expected a subclass of Task"),
    ],
)
def test_the_error_says_why_a_row_leads_to_no_task(target, match):
    with pytest.raises(ConfigError, match=match):
        load_task("mine", rows={"mine": target}, rng=np.random.default_rng(0))


def test_a_row_cannot_take_the_name_of_another_task():
    rows = {"create_reacher": "services.robot_bridge.tasks.dot_reacher:DotReacher"}
    with pytest.raises(ConfigError, match=r"\[tasks\] create_reacher: this name is taken, by .*:CreateReacher"):
        load_task("dot_reacher", rows=rows, rng=np.random.default_rng(0))


# ---------------------------------------------------------------------- the dot


def dot_at(position, velocity=(0.0, 0.0)):
    dot = Dot()
    dot.place(np.array(position))
    dot.velocity = np.array(velocity)
    return dot


@pytest.mark.parametrize("pieces", [2, 3, 10, 1000])
def test_time_in_one_go_is_time_in_pieces_away_from_the_walls(pieces):
    whole, parts = dot_at([0.1, -0.2], [0.3, 0.1]), dot_at([0.1, -0.2], [0.3, 0.1])
    for dot in (whole, parts):
        dot.command(np.array([0.7, -0.4], np.float32))
    whole.advance(0.6)
    for _ in range(pieces):
        parts.advance(0.6 / pieces)
    # x0 + v t + a t^2 / 2
    np.testing.assert_allclose(whole.position, [0.1 + 0.18 + 0.126, -0.2 + 0.06 - 0.072], atol=1e-7)
    np.testing.assert_allclose(parts.position, whole.position, atol=1e-7)
    np.testing.assert_allclose(parts.velocity, whole.velocity, atol=1e-7)


def test_a_wall_throws_the_dot_back_with_a_tenth_of_its_speed():
    dot = dot_at([0.95, 0.0], [1.0, 0.5])
    dot.advance(0.2)
    np.testing.assert_allclose(dot.position, [1.0, 0.1])
    np.testing.assert_allclose(dot.velocity, [-0.1, 0.5])


def test_the_dot_never_leaves_its_square_nor_its_range_of_speeds_by_much():
    dot, rng = dot_at([0.0, 0.0]), np.random.default_rng(0)
    for _ in range(2000):
        dot.command(rng.choice([-1.0, 1.0], 2).astype(np.float32))
        dot.advance(0.2)
        assert (np.abs(dot.position) <= 1.0).all()
        assert (np.abs(dot.velocity) <= 1.1 * MAX_SPEED).all()


def test_stopping_the_dot_takes_its_speed():
    dot = dot_at([0.2, 0.2], [1.0, 1.0])
    dot.command(np.ones(2, np.float32))
    dot.stop()
    dot.advance(5.0)
    np.testing.assert_array_equal(dot.position, [0.2, 0.2])


@pytest.mark.parametrize("name", ["dot_reacher", "visual_dot_reacher"])
@pytest.mark.parametrize("preset", ["demo", "thesis"])
def test_an_attempt_starts_at_rest_outside_the_target(name, preset):
    task = build(name, preset)
    task.advance_to(0)
    for _ in range(50):
        task.begin_attempt()
        assert (np.abs(task._dot.position) > task._settings.target_half_width).any()
        np.testing.assert_array_equal(task._dot.velocity, 0)
        assert not task.outcome().terminated


@pytest.mark.parametrize(
    ("name", "preset", "position", "velocity", "at_goal"),
    [
        ("dot_reacher", "demo", [0.25, -0.25], [0.2, -0.2], True),
        ("dot_reacher", "demo", [0.26, 0.0], [0.0, 0.0], False),
        ("dot_reacher", "demo", [0.0, 0.0], [0.21, 0.0], False),
        ("dot_reacher", "thesis", [0.25, 0.0], [0.15, 0.0], True),
        ("dot_reacher", "thesis", [0.25, 0.0], [0.16, 0.0], False),
        ("visual_dot_reacher", "demo", [0.2, -0.2], [2.0, 2.0], True),
        ("visual_dot_reacher", "demo", [0.21, 0.0], [0.0, 0.0], False),
        ("visual_dot_reacher", "thesis", [0.25, 0.0], [0.15, 0.0], True),
        ("visual_dot_reacher", "thesis", [0.25, 0.0], [0.16, 0.0], False),
    ],
)
def test_the_goal_is_a_box_and_a_speed(name, preset, position, velocity, at_goal):
    task = build(name, preset)
    task._dot.place(np.array(position))
    task._dot.velocity = np.array(velocity)
    assert task.outcome().terminated is at_goal
    assert task.outcome().reward == -1.0


@pytest.mark.parametrize(("preset", "reset_steps", "limit"), [("demo", 10, 50), ("thesis", 20, 50)])
def test_the_presets_of_the_dot_are_those_of_the_findings(preset, reset_steps, limit):
    for name in ("dot_reacher", "visual_dot_reacher"):
        spec = build(name, preset).spec
        assert (spec.reset_steps, spec.time_limit_steps) == (reset_steps, limit)
        assert (spec.world_seconds_per_cycle, spec.action_cycle_time_s) == (0.2, 0.04)


def test_a_longer_cycle_lets_the_same_world_time_pass():
    slow, fast = build("dot_reacher", action_cycle_time=0.4), build("dot_reacher", action_cycle_time=0.04)
    actions = random_actions(slow, 5)
    for a, b in zip(drive(slow, actions)[0], drive(fast, actions)[0], strict=True):
        np.testing.assert_allclose(a.proprioception, b.proprioception, atol=1e-6)


def test_a_new_attempt_moves_the_dot_and_keeps_the_goal():
    task = build("visual_dot_reacher")
    task.advance_to(0)
    task.begin_episode()
    frames = []
    for _ in range(4):
        task.begin_attempt()
        frames.append(task.read().frames[0])
    assert len({frame.tobytes() for frame in frames}) == 4
    targets = [(frame == TARGET_RGB).all(axis=-1) for frame in frames]
    dots = [~target & (frame != BACKGROUND_RGB).any(axis=-1) for target, frame in zip(targets, frames, strict=True)]
    for target, dot in zip(targets, dots, strict=True):
        assert (target == targets[0])[~dot & ~dots[0]].all()


# ---------------------------------------------------------------------- what the camera shows


def picture_of(task, position):
    task._dot.place(np.array(position))
    return task.read().frames[0]


def dot_pixels(frame):
    """Pixels of which the dot covers more than half: nothing else in the picture is blue."""
    return frame[..., 2] > (BACKGROUND_RGB[2] + DOT_RGB[2]) / 2


@pytest.mark.parametrize("preset", ["demo", "thesis"])
def test_the_dot_is_wholly_in_view_after_the_central_crop_wherever_it_is(preset):
    task = build("visual_dot_reacher", preset)
    (y, x), (h, w) = central_crop_offset(task.spec), crop_shape(task.spec)
    areas = []
    for px in np.linspace(-1, 1, 21):
        for py in np.linspace(-1, 1, 21):
            covered = dot_pixels(picture_of(task, [px, py]))
            areas.append(covered.sum())
            assert covered[y : y + h, x : x + w].sum() == covered.sum(), (px, py)
    assert min(areas) >= 28  # pi 3**2, and OpenCV draws half a pixel more
    assert max(areas) <= np.pi * (DOT_RADIUS + 1) ** 2


def test_the_dot_is_drawn_where_it_is():
    task = build("visual_dot_reacher")
    for position in ([0.0, 0.0], [-1.0, -1.0], [1.0, 0.5], [0.2, -0.7]):
        rows, columns = np.nonzero(dot_pixels(picture_of(task, position)))
        # x to the right, y down; the centre moves over 35 pixels.
        np.testing.assert_allclose([columns.mean(), rows.mean()], 21.5 + np.array(position) * 17.5, atol=0.6)


def test_different_positions_look_different():
    task = build("visual_dot_reacher")
    grid = [(x, y) for x in np.linspace(-1, 1, 41) for y in np.linspace(-1, 1, 11)]
    cropped = {central_crop([picture_of(task, p)], task.spec).tobytes() for p in grid}
    assert len(cropped) == len(grid)


def test_the_target_is_seen_where_it_is_and_as_large_as_it_is():
    task = build("visual_dot_reacher")
    red = (picture_of(task, [1.0, 1.0]) == TARGET_RGB).all(axis=-1)
    rows, columns = np.nonzero(red)
    # Half-width 0.2 of a world that spans 35 pixels between centres of dots: 7 pixels about the middle.
    for line in (rows, columns):
        assert (line.min() + line.max()) / 2 == pytest.approx(21.5, abs=0.5)
        assert line.max() - line.min() + 1 == pytest.approx(0.2 * 35, abs=1.5)


def test_the_background_is_even():
    frame = picture_of(build("visual_dot_reacher"), [1.0, 1.0])
    assert (frame[:10, :30] == BACKGROUND_RGB).all()


def test_noise_frames_carry_their_id_and_cannot_be_compressed():
    import zlib

    task = build("noise_frames", height=24, width=32)
    task.advance_to(0)
    for expected in range(3):
        (frame,) = task.read().frames
        assert read_frame_id(frame) == expected
        assert len(zlib.compress(frame.tobytes())) > 0.98 * frame.nbytes


@pytest.mark.parametrize("rate", [0.0, 0.5, 1.2, 3.0])
def test_a_camera_brings_its_own_number_of_frames(rate):
    task = build("noise_frames", frames_per_cycle=rate)
    readings, _ = drive(task, random_actions(task, 99))
    brought = [len(reading.frame_ids) for reading in readings]
    assert brought[0] == 1
    assert sum(brought[1:]) == pytest.approx(99 * rate, abs=1)
    assert set(brought[1:]) <= {int(rate), int(rate) + 1}
