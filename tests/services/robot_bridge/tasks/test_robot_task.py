"""What every simulated robot's task does with frames, orders and seeds; on a toy, without OpenGL."""

import threading
from dataclasses import dataclass

import numpy as np
import pytest

from common.clock import SystemClock
from common.config import setting
from common.errors import ConfigError, ServiceError
from experiments.simulation import SimulatedClock
from services.robot_bridge.cameras.simulated import BUFFERED_FRAMES
from services.robot_bridge.robots.live_world import LONGEST_WAIT_S
from services.robot_bridge.tasks import robot_task
from services.robot_bridge.tasks.base import Outcome
from services.robot_bridge.tasks.robot_task import RobotSettings, RobotTask, View
from tests.helpers import TIMEOUT_S
from tests.services.robot_bridge.robots.toy_world import RATES, Cart, Sketch

CYCLE_NS = 40_000_000


@dataclass(frozen=True)
class ToySettings(RobotSettings):
    speed: float = setting(0.5)


class Toy(RobotTask):
    """A cart from a random start; at the goal when a frame is bright."""

    SETTINGS = ToySettings
    PRESETS = {"demo": {}}  # noqa: RUF012
    RATES = RATES
    VIEW = View("eye", height=2, width=3, frame_stack=3)
    ALGORITHM_PRESET = "dot_reacher"

    def _build_robot(self):
        self.cart = Cart()
        return self.cart

    def _draw_goal(self):
        return self._rng.uniform(0.0, 1.0, 1)

    def _draw_start(self):
        return self._rng.uniform(0.0, 0.1, 1)

    def _judge(self, frame, proprioception):
        self.judged = int(frame[0, 0, 0]), float(proprioception[0])
        return Outcome(-1.0, terminated=bool(frame[0, 0, 0] > 100))

    def _action_limits(self):
        return np.array([-self._settings.speed]), np.array([self._settings.speed])

    def _proprioception_limits(self):
        return np.array([0.0]), np.array([2.0])


@pytest.fixture(autouse=True)
def without_opengl(monkeypatch):
    def camera(model, name, *, height, width, defects):
        assert (name, height, width) == ("eye", 2, 3)
        return Sketch(model, **vars(defects))

    monkeypatch.setattr(robot_task, "SimulatedCamera", camera)


def build(seed=0, pacing="lockstep", **settings):
    rng = np.random.default_rng(seed)
    return Toy(ToySettings(**settings), name="toy", preset="demo", pacing=pacing, rng=rng)


def begun(**settings):
    task = build(**settings)
    task.advance_to(0)
    task.begin_episode()
    return task


def levels(reading):
    """The grey level of each frame: the cart's position in cm."""
    return reading.frames[:, 0, 0, 0].tolist()


# ---------------------------------------------------------------------- frames


def test_a_reading_has_the_frames_since_the_one_before_and_the_newest_packet():
    task = begun()
    task.read()
    task.command(np.array([0.5], np.float32))
    start = task.cart.position
    for cycle, times in enumerate(
        [[33_333_333], [66_666_666], [100_000_000], [133_333_333], [166_666_666, 200_000_000]]
    ):
        task.advance_to((cycle + 1) * CYCLE_NS)
        reading = task.read()
        assert reading.frame_capture_ns.tolist() == times
        assert levels(reading) == [round((start + 0.5e-9 * time) * 100) for time in times]
        assert reading.proprioception == pytest.approx(start + 0.5 * 0.04 * (cycle + 1))
    assert task.read().frames.shape == (0, 2, 3, 3)


def test_looking_often_loses_and_repeats_nothing():
    often, seldom = begun(), begun()
    for task in (often, seldom):
        task.read()
    seen = {often: [], seldom: []}
    for now_ns in range(2_000_000, 200_000_001, 2_000_000):
        often.advance_to(now_ns)
        if now_ns % CYCLE_NS == 0:
            seldom.advance_to(now_ns)
            for task in (often, seldom):
                seen[task].append(task.read().frame_ids.tolist())
    assert seen[often] == seen[seldom]
    assert [number for ids in seen[often] for number in ids] == list(range(1, 7))


def test_ids_go_on_over_attempts_whatever_nobody_read():
    task = begun()
    assert task.read().frame_ids.tolist() == [0]
    task.advance_to(10 * CYCLE_NS)  # 12 frames, of which the oldest are lost
    task.begin_attempt()
    assert task.read().frame_ids.tolist() == [1]
    task.advance_to(11 * CYCLE_NS)
    assert task.read().frame_ids.tolist() == [2]


def test_within_an_attempt_lost_frames_leave_a_gap():
    task = begun()
    task.read()
    task.advance_to(15 * CYCLE_NS)  # 18 frames
    assert task.read().frame_ids.tolist() == list(range(19 - BUFFERED_FRAMES, 19))


def test_the_goal_is_judged_by_the_newest_frame_and_packet():
    task = begun()
    task.command(np.array([0.5], np.float32))
    start = task.cart.position
    for cycle in range(1, 4):
        task.advance_to(cycle * CYCLE_NS)
        task.outcome()
        assert task.judged[0] == round((start + 0.5 * cycle / 30) * 100)
        assert task.judged[1] == pytest.approx(start + 0.5 * 0.04 * cycle)
        if cycle == 2:
            task.read()  # changes nothing


def test_a_new_attempt_is_not_judged_by_a_frame_of_the_one_before():
    task = begun()
    task.cart.data.qpos[0] = 1.5
    task.advance_to(2 * CYCLE_NS)
    assert task.outcome().terminated
    task.begin_attempt()
    assert not task.outcome().terminated


# ---------------------------------------------------------------------- goals, starts, seeds


def test_the_goal_stays_over_attempts_and_the_start_does_not():
    task = begun()
    task.cart.placed.clear()
    for begin in (task.begin_attempt, task.begin_attempt, task.begin_episode, task.begin_attempt):
        begin()
    goals, starts = zip(*((goal[0], start[0]) for goal, start in task.cart.placed), strict=True)
    assert goals[0] == goals[1] != goals[2] == goals[3]
    assert len(set(starts)) == 4


def test_noise_is_new_in_each_attempt_and_the_same_for_the_same_seed():
    def packets(seed):
        task = begun(seed=seed, sensor_noise=0.1)
        seen = []
        for _ in range(3):
            task.begin_attempt()
            seen.append(float(task.read().proprioception[0]) - task.cart.position)
        return seen

    assert packets(1) == packets(1)
    assert packets(1) != packets(2)
    assert len(set(packets(1))) == 3


def test_the_sensors_noise_is_a_share_of_their_range():
    task = begun(sensor_noise=0.1)
    noise = []
    for cycle in range(1, 1501):
        task.advance_to(cycle * CYCLE_NS)
        noise.append(float(task.read().proprioception[0]) - task.cart.position)
    assert np.std(noise) == pytest.approx(0.2, rel=0.08)  # the range is 2 wide; 1500 values: +- 1.8 % (one sigma)


# ---------------------------------------------------------------------- commands


def test_commands_are_clipped_and_what_is_no_number_stops_the_robot():
    task = begun()
    task.command(np.array([7.0], np.float32))
    assert task.cart.speed == 0.5
    with pytest.raises(ServiceError, match=r"toy: the robot was given the command \[nan\]"):
        task.command(np.array([np.nan], np.float32))
    assert task.cart.speed == 0


def test_the_age_of_the_newest_frame_does_not_depend_on_who_reads():
    task = begun(camera_latency=0.1)
    for cycle in range(1, 10):
        task.advance_to(cycle * CYCLE_NS)
        # Captured, even if it cannot be taken yet: at the last multiple of 33.3 ms.
        assert 0 <= cycle * CYCLE_NS - task.newest_frame_ns() < 33_333_334


def test_packets_and_frames_are_counted_over_attempts():
    task = begun()
    before = task.counters()
    task.advance_to(1_000_000_000)
    task.begin_attempt()
    task.advance_to(2_000_000_000)
    after = task.counters()
    # 125 and 30 a second, and one of each at the placement.
    assert {name: after[name] - before[name] for name in after} == {"sensor_packets": 251, "camera_frames": 61}


@pytest.mark.parametrize(
    ("what", "given", "said"),
    [
        (
            "_action_limits",
            (np.ones(1), -np.ones(1)),
            r"Toy._action_limits\(\) gives \[1.\], \[-1.\]: expected low < high",
        ),
        (
            "_proprioception_limits",
            (np.ones(1), np.ones(1)),
            r"Toy._proprioception_limits\(\) gives .* expected low < high",
        ),
    ],
)
def test_limits_that_leave_nothing_between_them_are_named(monkeypatch, what, given, said):
    monkeypatch.setattr(Toy, what, lambda self: given)
    with pytest.raises(ConfigError, match=said):
        build()


def test_whoever_waits_for_the_robot_to_be_placed_may_give_up():
    task = build(pacing="realtime")
    task.start(SystemClock())
    hanging, released = threading.Event(), threading.Event()

    def hang(goal, start):
        hanging.set()
        released.wait(TIMEOUT_S)

    task.cart.place = hang
    waiting = threading.Thread(target=task.begin_attempt)
    waiting.start()
    try:
        assert hanging.wait(TIMEOUT_S)
        task.give_up()
        waiting.join(LONGEST_WAIT_S / 2)
        assert not waiting.is_alive()
    finally:
        released.set()
        waiting.join(TIMEOUT_S)
        task.close()


@pytest.mark.parametrize("name", ["height", "width", "frame_stack"])
def test_a_view_of_nothing_is_named(name):
    with pytest.raises(ConfigError, match=f"View: {name} = 0: expected at least 1"):
        View(**{"camera": "eye", "height": 2, "width": 3, "frame_stack": 3, name: 0})


def test_what_is_no_outcome_is_named(monkeypatch):
    monkeypatch.setattr(Toy, "_judge", lambda *_: None)
    task = begun()
    with pytest.raises(ServiceError, match=r"Toy._judge\(\) gave None: expected an Outcome"):
        task.outcome()


def test_the_sensors_may_be_a_list(monkeypatch):
    sense = Cart.sense
    monkeypatch.setattr(Cart, "sense", lambda cart: sense(cart).tolist())
    assert begun().read().proprioception.shape == (1,)


def test_closing_stops_the_robot_and_lets_go_of_the_camera():
    task = begun()
    task.command(np.array([0.5], np.float32))
    task.close()
    assert task.cart.speed == 0
    assert task._world.camera.closed == 1


# ---------------------------------------------------------------------- in real time


@pytest.fixture
def clock():
    clock = SimulatedClock()
    yield clock
    clock.end()


def test_a_started_task_has_a_frame_at_once(clock):
    task = build(pacing="realtime")
    task.start(clock)
    task.advance_to(clock.now_ns())
    assert len(task.read().frame_ids) == 1
    task.close()


def test_a_placement_in_real_time_is_shown_by_the_next_reading(clock):
    task = build(pacing="realtime", camera_latency=0.2)
    task.start(clock)
    condition = clock.condition()
    ids = []
    for _ in range(3):
        task.advance_to(clock.now_ns())
        task.begin_attempt()
        reading = task.read()
        start = task.cart.placed[-1][1][0]
        assert levels(reading) == [round(start * 100)]
        assert reading.proprioception == np.float32(start)
        assert reading.frame_capture_ns.tolist() == [clock.now_ns()]
        ids += reading.frame_ids.tolist()
        with condition:
            clock.wait_until(clock.now_ns() + 500_000_000, condition)
    assert ids == [0, 1, 2]
    task.close()


def test_a_world_that_has_ended_is_told_in_the_cycle(clock):
    task = build(pacing="realtime")
    task.start(clock)
    task.cart.offset = np.nan
    condition = clock.condition()
    with condition:
        clock.wait_until(clock.now_ns() + CYCLE_NS, condition)
    with pytest.raises(ServiceError, match=r"a sensor of Cart gave \[nan\]"):
        task.advance_to(clock.now_ns())
    task.close()
