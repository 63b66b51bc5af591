"""A world in a thread of its own: by a simulated clock the same as in lockstep; by the real one, never waited for."""

import functools
import threading

import numpy as np
import pytest

from common.clock import SystemClock
from common.errors import ServiceError
from experiments.simulation import SimulatedClock
from services.robot_bridge.robots import live_world
from services.robot_bridge.robots.live_world import LiveWorld
from tests.helpers import TIMEOUT_S
from tests.services.robot_bridge.robots.toy_world import toy_world

MS = 1_000_000
ZERO, ONE = np.zeros(1), np.ones(1)


@pytest.fixture
def clock():
    clock = SimulatedClock()
    yield clock
    clock.end()


def live_from(world, clock):
    live = LiveWorld(world, clock)
    live.begin()
    return live


def sleep_until(clock, now_ns):
    condition = clock.condition()
    with condition:
        clock.wait_until(now_ns, condition)


def test_a_live_world_shows_what_the_same_world_in_lockstep_shows(clock):
    live, lockstep = live_from(toy_world(sensor_noise=0.01), clock), toy_world(sensor_noise=0.01)
    begun_ns = clock.now_ns()
    lockstep.advance_to(begun_ns)
    worlds = live, lockstep
    seen = {world: [] for world in worlds}
    for cycle in range(1, 60):
        # Never at the time of a packet or of a frame: which is first would be a matter of the threads' order.
        now_ns = begun_ns + cycle * 40_300_000
        sleep_until(clock, now_ns)
        for world in worlds:
            world.advance_to(now_ns)
            frames = [(frame.frame_id, frame.capture_ns, frame.frame.tobytes()) for frame in world.camera.take()]
            seen[world].append((world.newest.capture_ns, world.newest.values.tolist(), frames))
            if cycle % 20 == 0:
                world.place(ZERO, np.array([0.1 * cycle]), cycle)
            elif cycle % 17 == 0:
                world.stop()
            else:
                world.command(np.sin([cycle]))
    assert seen[live] == seen[lockstep]
    assert len({str(shown) for shown in seen[live]}) == 59
    live.close()


def test_the_world_goes_on_while_nobody_looks(clock):
    world = toy_world()
    live = live_from(world, clock)
    live.command(ONE)
    sleep_until(clock, clock.now_ns() + 1_000 * MS + MS)
    assert live.newest.values[0] == pytest.approx(1.0)  # 1 m/s for 1 s
    live.stop()
    sleep_until(clock, clock.now_ns() + 1_000 * MS)
    assert live.newest.values[0] == pytest.approx(1.0, abs=0.002)  # it was stopped a millisecond later
    live.close()


def test_a_placement_is_there_with_its_frame_when_it_returns(clock):
    live = live_from(toy_world(latency_ns=100 * MS), clock)
    live.command(ONE)
    sleep_until(clock, clock.now_ns() + 500 * MS)
    before_ns = clock.now_ns()
    live.place(ZERO, np.array([0.7]), 1)
    assert live.newest.values == np.float32(0.7)
    (frame,) = live.camera.take()
    assert (frame.frame[0, 0, 0], frame.capture_ns) == (70, before_ns)
    live.close()


def test_time_begins_when_the_camera_is_open(clock):
    world = toy_world()
    begun_ns = clock.now_ns()
    world.camera.on_open = lambda: sleep_until(clock, begun_ns + 700 * MS)
    live = live_from(world, clock)
    assert [frame.capture_ns for frame in live.camera.take()] == [begun_ns + 700 * MS]
    assert live.newest.capture_ns == begun_ns + 700 * MS
    live.close()


def test_a_world_that_cannot_draw_says_so_before_anything_begins(clock):
    world = toy_world()

    def fail():
        raise ServiceError("no OpenGL backend works here")

    world.camera.on_capture = fail
    with pytest.raises(ServiceError, match="the simulated world has ended: no OpenGL backend works here"):
        live_from(world, clock)
    assert world.camera.closed == 1


def test_a_robot_s_own_fault_is_named_and_its_place_logged(clock, caplog):
    world = toy_world()

    def fail():
        assert clock is None

    world.camera.on_capture = fail
    with pytest.raises(ServiceError, match="the simulated world has ended: AssertionError"):
        live_from(world, clock)
    assert "test_live_world.py" in caplog.text
    assert "assert clock is None" in caplog.text


def test_whoever_waits_for_a_camera_that_does_not_open_may_give_up(monkeypatch):
    for wait in ("LONG_WAIT_S", "LONGEST_WAIT_S"):
        monkeypatch.setattr(live_world, wait, 10 * TIMEOUT_S)
    world = toy_world()
    released = threading.Event()
    world.camera.on_open = lambda: released.wait(TIMEOUT_S)
    live = LiveWorld(world, SystemClock())
    waiting = threading.Thread(target=live.begin)
    waiting.start()
    try:
        live.give_up()
        waiting.join(TIMEOUT_S)
        assert not waiting.is_alive()
        live.advance_to(SystemClock().now_ns())
    finally:
        released.set()
        live.close()


def test_what_is_done_at_the_last_moment_is_done(clock, monkeypatch):
    world = toy_world()
    live = live_from(world, clock)
    wait_until = clock.wait_until

    def time_out(deadline_ns, condition):
        wait_until(deadline_ns, condition)
        return False

    with monkeypatch.context() as patch:
        patch.setattr(clock, "wait_until", time_out)
        live.place(ZERO, ONE, 1)
    assert live.newest.values == 1.0
    live.close()


def test_a_robot_that_wants_to_end_the_process_ends_the_world(clock):
    world = toy_world()
    live = live_from(world, clock)

    def leave(duration_ns):
        raise SystemExit(3)

    world.robot.advance = leave
    sleep_until(clock, clock.now_ns() + 10 * MS)
    with pytest.raises(ServiceError, match="has ended: SystemExit: 3"):
        live.advance_to(clock.now_ns())
    live.close()


def test_a_slow_placement_is_named_and_begins_when_it_is_done(clock, caplog):
    world = toy_world()
    live = live_from(world, clock)
    place = world.robot.place

    def place_slowly(goal, start):
        sleep_until(clock, clock.now_ns() + 3_000 * MS)
        place(goal, start)

    world.robot.place = place_slowly
    live.camera.take()
    live.place(ZERO, np.array([0.7]), 1)
    (frame,) = live.camera.take()
    assert (frame.frame[0, 0, 0], frame.capture_ns) == (70, clock.now_ns())
    assert live.newest.capture_ns == clock.now_ns()
    (told,) = [record.getMessage() for record in caplog.records]
    assert "waiting for the simulated world's first picture" in told
    assert "place_slowly" in told
    live.close()


def test_whoever_waits_for_a_placement_that_hangs_may_give_up(caplog, monkeypatch):
    for wait in ("LONG_WAIT_S", "LONGEST_WAIT_S"):
        monkeypatch.setattr(live_world, wait, 10 * TIMEOUT_S)
    world = toy_world()
    live = live_from(world, SystemClock())
    hanging, released = threading.Event(), threading.Event()

    def hang(goal, start):
        hanging.set()
        released.wait(TIMEOUT_S)

    world.robot.place = hang
    waiting = threading.Thread(target=live.place, args=(ZERO, ZERO, 1))
    waiting.start()
    try:
        assert hanging.wait(TIMEOUT_S)
        live.give_up()
        waiting.join(TIMEOUT_S)
        assert not waiting.is_alive()
        live.close()
        assert "thread hangs and is left behind" in caplog.text
    finally:
        released.set()
        waiting.join(TIMEOUT_S)


def test_whoever_looks_is_told_what_has_ended_the_world(clock):
    world = toy_world()
    live = live_from(world, clock)
    live.advance_to(clock.now_ns())
    world.robot.offset = np.nan
    sleep_until(clock, clock.now_ns() + 10 * MS)
    for look in (lambda: live.advance_to(clock.now_ns()), lambda: live.place(ZERO, ZERO, 0)):
        with pytest.raises(ServiceError, match=r"has ended: a sensor of Cart gave \[nan\]"):
            look()
    live.close()
    assert world.camera.closed == 1


def slow_down(world, clock, factor):
    """Let ``world`` need ``factor`` times as long for a time as that lasts; return the durations that it went on by."""
    advance, durations_ns = world.robot.advance, []

    def advance_slowly(duration_ns):
        durations_ns.append(duration_ns)
        sleep_until(clock, clock.now_ns() + round(factor * duration_ns))
        advance(duration_ns)

    world.robot.advance = advance_slowly
    return durations_ns


def warnings_at(clock, caplog, factor):
    """What is told in 4 s of a world that needs ``factor`` times as long for a time as that lasts."""
    world = toy_world()
    live = live_from(world, clock)
    slow_down(world, clock, factor)
    for _ in range(100):
        sleep_until(clock, clock.now_ns() + 40 * MS)
        live.advance_to(clock.now_ns())
    live.close()
    return [record.getMessage() for record in caplog.records if "behind the clock" in record.message]


def test_a_world_too_slow_for_real_time_is_named_with_what_it_does(clock, caplog):
    (warning,) = warnings_at(clock, caplog, factor=2)
    assert "Cart" in warning
    assert f'File "{__file__}", line ' in warning
    assert "advance_slowly\n" in warning


def test_a_world_that_keeps_up_is_not_told_of(clock, caplog):
    assert not warnings_at(clock, caplog, factor=0.9)


@pytest.mark.parametrize("commands", [True, False])
def test_a_world_too_slow_forgets_what_is_older_than_two_seconds(clock, commands):
    world = toy_world()
    live = live_from(world, clock)
    slow_down(world, clock, 2)
    lags_ns = []
    for _ in range(250):
        sleep_until(clock, clock.now_ns() + 40 * MS)
        lags_ns.append(clock.now_ns() - live.newest.capture_ns)
        if commands:
            live.command(ONE)
    assert 1_500 * MS < max(lags_ns) < 2_200 * MS
    live.close()


@pytest.mark.parametrize("commands", [True, False])
def test_where_drawing_is_what_is_slow_pictures_are_left_out(clock, commands):
    world = toy_world()
    live = live_from(world, clock)
    world.camera.on_capture = lambda: sleep_until(clock, clock.now_ns() + 50 * MS)
    lags_ns = []
    for _ in range(250):
        sleep_until(clock, clock.now_ns() + 40 * MS)
        lags_ns.append(clock.now_ns() - live.newest.capture_ns)
        live.camera.take()
        if commands:
            live.command(ONE)
    assert max(lags_ns) < 500 * MS
    assert 0 < world.camera.dropped < 200  # of 300
    live.close()


def test_a_placement_does_not_wait_for_what_a_slow_world_has_missed(clock):
    world = toy_world()
    live = live_from(world, clock)
    slow_down(world, clock, 2)
    sleep_until(clock, clock.now_ns() + 6_000 * MS)
    before_ns = clock.now_ns()
    assert before_ns - live.newest.capture_ns > 1_500 * MS
    live.place(ZERO, ONE, 1)
    assert clock.now_ns() - before_ns < 800 * MS
    assert live.newest.values == 1.0
    live.close()


def test_a_world_that_is_behind_ends_at_the_next_packet(clock):
    world = toy_world()
    live = live_from(world, clock)
    durations_ns = slow_down(world, clock, 10)
    sleep_until(clock, clock.now_ns() + 1_000 * MS)
    live.command(ONE)
    before = len(durations_ns)
    assert before > 5
    live.close()
    assert len(durations_ns) <= before + 1
    assert world.camera.closed == 1


def test_a_world_that_hangs_is_left_behind_when_it_is_closed(monkeypatch, caplog):
    world = toy_world()
    live = live_from(world, SystemClock())
    drawing, drawn = threading.Event(), threading.Event()

    def draw():
        drawing.set()
        drawn.wait(TIMEOUT_S)

    world.camera.on_capture = draw
    monkeypatch.setattr(live_world, "CLOSING_TAKES_S", 0.05)
    try:
        assert drawing.wait(TIMEOUT_S)
        live.close()
        assert "thread hangs and is left behind" in caplog.text
        assert "draw\n" in caplog.text
    finally:
        drawn.set()
        monkeypatch.undo()
        live.close()
    assert world.camera.closed == 1


def test_a_closed_world_has_no_thread_and_stands_still():
    world = toy_world()
    before = threading.active_count()
    live = live_from(world, SystemClock())
    assert threading.active_count() == before + 1
    live.close()
    assert threading.active_count() == before
    assert world.camera.closed == 1


def test_nothing_waits_for_a_picture_that_is_being_drawn():
    world = toy_world()
    clock = SystemClock()
    live = live_from(world, clock)
    drawing, drawn = threading.Event(), threading.Event()

    def draw():
        drawing.set()
        assert drawn.wait(TIMEOUT_S)

    world.camera.on_capture = draw
    try:
        assert drawing.wait(TIMEOUT_S)  # from here on the world's thread hangs
        for _ in range(100):
            live.advance_to(clock.now_ns())
            live.command(ONE)
            live.stop()
            live.camera.take()
            assert live.newest.values.shape == (1,)
    finally:
        drawn.set()
        live.close()


def test_a_world_that_hangs_when_an_attempt_begins_is_named(monkeypatch):
    world = toy_world()
    live = live_from(world, SystemClock())
    drawn = threading.Event()
    world.camera.on_capture = functools.partial(drawn.wait, TIMEOUT_S)
    monkeypatch.setattr(live_world, "LONG_WAIT_S", 0.02)
    monkeypatch.setattr(live_world, "LONGEST_WAIT_S", 0.05)
    try:
        with pytest.raises(ServiceError, match=r"(?s)no picture for 0.05 s: .*in Sketch._picture\n.*in Event.wait"):
            live.place(ZERO, ZERO, 0)
    finally:
        drawn.set()
        monkeypatch.undo()
        live.close()
