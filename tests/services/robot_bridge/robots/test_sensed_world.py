"""Sensors and camera at rates of their own, whoever looks and however often."""

import numpy as np
import pytest

from common.errors import ServiceError
from services.robot_bridge.cameras.simulated import BUFFERED_FRAMES
from services.robot_bridge.robots.sensed_world import LONGEST_GAP_NS
from tests.services.robot_bridge.robots.toy_world import toy_world

MS = 1_000_000
CYCLE_NS = 40 * MS
ONE = np.ones(1)


def place(world, at=0.0, seed=0):
    world.place(np.zeros(1), np.array([at]), seed)


def live(world, until_ns, portion_ns=CYCLE_NS):
    """Let the world go on in portions; return all packets seen and all frames."""
    packets, frames = [world.newest], world.camera.take()
    for now_ns in [*range(portion_ns, until_ns, portion_ns), until_ns]:
        world.advance_to(now_ns)
        if world.newest is not packets[-1]:
            packets.append(world.newest)
        frames += world.camera.take()
    return packets, frames


def test_packets_come_every_8_ms_and_frames_every_33_ms_each_with_its_time():
    world = toy_world()
    world.advance_to(0)
    packets, frames = live(world, 1_000 * MS, portion_ns=MS)
    assert [packet.capture_ns for packet in packets] == [8 * MS * k for k in range(126)]
    assert [frame.capture_ns for frame in frames] == [k * 1_000_000_000 // 30 for k in range(31)]
    assert [frame.frame_id for frame in frames] == list(range(31))


def test_a_cycle_of_40_ms_brings_one_or_two_frames():
    world = toy_world()
    world.advance_to(0)
    brought = []
    world.camera.take()
    for cycle in range(1, 51):
        world.advance_to(cycle * CYCLE_NS)
        brought.append(len(world.camera.take()))
    # 1.2 on average: 6 frames in 5 cycles.
    assert brought == [1, 1, 1, 1, 2] * 10


def test_a_short_cycle_may_bring_none():
    world = toy_world()
    world.advance_to(0)
    world.camera.take()
    brought = []
    for cycle in range(1, 7):
        world.advance_to(cycle * 20 * MS)
        brought.append(len(world.camera.take()))
    assert brought == [0, 1, 0, 1, 1, 0]  # at 33.3, 66.6 and 100 ms


@pytest.mark.parametrize("portion_ns", [MS, 7 * MS, 40 * MS, 113 * MS])
def test_frames_show_the_world_at_their_time_whatever_the_portions(portion_ns):
    world = toy_world()
    world.advance_to(0)
    place(world)
    world.command(ONE)
    _, frames = live(world, 900 * MS, portion_ns)
    for frame in frames:
        assert frame.frame[0, 0, 0] == round(frame.capture_ns * 1e-9 * 100)  # 1 m/s, in cm
    assert world.newest.values[0] == pytest.approx(0.896)  # the packet of 896 ms


def test_a_command_acts_from_when_it_is_given():
    world = toy_world()
    world.advance_to(0)
    world.advance_to(21 * MS)
    world.command(ONE)
    world.advance_to(40 * MS)
    assert world.robot.position == pytest.approx(0.019)
    world.stop()
    world.advance_to(80 * MS)
    assert world.robot.position == pytest.approx(0.019)


def test_a_placement_begins_the_rates_anew_and_forgets_older_frames():
    world = toy_world()
    world.advance_to(5 * MS)
    world.advance_to(61 * MS)
    place(world, at=0.5)
    assert world.newest.capture_ns == 61 * MS
    assert world.newest.values == 0.5
    (first,) = world.camera.take()
    assert (first.capture_ns, first.frame_id, first.frame[0, 0, 0]) == (61 * MS, 2, 50)  # after those of 5 and 38.3 ms
    world.advance_to(69 * MS - 1)
    assert world.newest.capture_ns == 61 * MS
    world.advance_to(95 * MS)
    assert world.newest.capture_ns == 93 * MS
    assert [frame.capture_ns for frame in world.camera.take()] == [61 * MS + 33_333_333]


def test_nothing_is_drawn_before_time_begins():
    world = toy_world()
    world.camera.on_capture = lambda: pytest.fail("drawn")
    place(world)


def test_time_never_runs_back():
    world = toy_world()
    world.advance_to(100 * MS)
    world.command(ONE)
    world.advance_to(50 * MS)
    world.advance_to(108 * MS)
    assert world.robot.position == pytest.approx(0.008)


def test_frames_that_nobody_could_take_any_more_are_not_drawn_but_counted():
    world = toy_world()
    world.advance_to(0)
    world.camera.take()
    drawn = []
    world.camera.on_capture = lambda: drawn.append(1)
    world.advance_to(1_000 * MS)
    assert len(drawn) == BUFFERED_FRAMES
    assert [frame.frame_id for frame in world.camera.take()] == list(range(31 - BUFFERED_FRAMES, 31))


def test_a_buffer_that_nobody_empties_keeps_the_newest():
    world = toy_world()
    world.advance_to(0)
    for now_ns in range(CYCLE_NS, 2_000 * MS + 1, CYCLE_NS):
        world.advance_to(now_ns)
    assert [frame.frame_id for frame in world.camera.take()] == list(range(61 - BUFFERED_FRAMES, 61))


def test_a_gap_as_of_a_suspended_computer_is_not_lived_through():
    world = toy_world()
    world.advance_to(0)
    world.command(ONE)
    world.advance_to(3600 * 1_000_000_000)
    assert world.robot.position == pytest.approx(LONGEST_GAP_NS * 1e-9)
    assert world.newest.capture_ns > 3600 * 1_000_000_000 - 8 * MS


def test_latency_delays_when_a_frame_can_be_taken_and_not_what_it_shows():
    world = toy_world(latency_ns=50 * MS)
    world.advance_to(0)
    place(world)
    assert len(world.camera.take()) == 1  # what an attempt begins with has been waited for
    world.command(ONE)
    seen = []
    for now_ms in range(1, 200):
        world.advance_to(now_ms * MS)
        seen += [(now_ms, frame.capture_ns, frame.frame[0, 0, 0]) for frame in world.camera.take()]
    assert seen == [(84, 33_333_333, 3), (117, 66_666_666, 7), (150, 100_000_000, 10), (184, 133_333_333, 13)]


def test_noise_is_the_seeds_and_as_large_as_it_should_be():
    def packets(seed):
        world = toy_world(sensor_noise=0.1)
        world.advance_to(0)
        place(world, seed=seed)
        return [packet.values[0] for packet in live(world, 16_000 * MS, portion_ns=8 * MS)[0]]

    first, again, other = packets(1), packets(1), packets(2)
    assert first == again
    assert first != other
    assert np.std(first) == pytest.approx(0.1, rel=0.1)  # 2001 values: +- 1.6 % (one sigma)
    assert np.mean(first) == pytest.approx(0, abs=0.01)


def test_the_robot_itself_does_not_feel_the_noise():
    world = toy_world(sensor_noise=0.1)
    world.advance_to(0)
    live(world, 1_000 * MS)
    assert world.robot.position == 0


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_sensor_that_gives_no_number_is_named(value):
    world = toy_world()
    world.advance_to(0)
    world.robot.offset = value
    with pytest.raises(ServiceError, match=rf"a sensor of Cart gave \[{value}\]: expected finite numbers"):
        world.advance_to(8 * MS)
