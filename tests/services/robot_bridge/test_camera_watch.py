"""When a camera counts as stalled: by the rule alone, and in the bridge, whose cycles last 40 ms."""

import logging

import pytest

from services.robot_bridge.camera_watch import CameraWatch
from services.robot_bridge.tasks.base import Task
from tests.services.builders import START_NS
from tests.services.robot_bridge.scripted import Scene

MS = 1_000_000


def test_a_stall_is_a_frame_older_than_the_limit_and_is_counted_once():
    watch = CameraWatch(100 * MS)
    looks = [(0, 0), (0, 100), (0, 101), (0, 500), (480, 520), (480, 580), (480, 600)]
    assert [watch.look(frame * MS, now * MS) for frame, now in looks] == [False, False, True, True, False, False, True]
    assert watch.stalls == 2
    assert watch.stalled


def test_a_stall_and_its_end_are_logged_once_each(caplog):
    watch = CameraWatch(100 * MS)
    for frame, now in [(0, 50), (0, 150), (0, 200), (0, 250), (260, 270), (280, 290)]:
        watch.look(frame * MS, now * MS)
    assert [(record.levelno, record.message) for record in caplog.records] == [
        (logging.WARNING, "the camera has stalled: its newest frame is 0.15 s old"),
        (logging.WARNING, "the camera is back: its newest frame is 0.01 s old"),
    ]


def test_where_there_is_no_camera_that_could_stall_nothing_ever_does():
    watch = CameraWatch(1)
    assert not watch.look(None, 10**18)
    assert watch.stalls == 0


def test_a_tasks_camera_cannot_stall_unless_the_task_says_when_its_newest_frame_came():
    assert Task.newest_frame_ns(object()) is None


# ---------------------------------------------------------------------- in the bridge


def scene_of(directory, stall=(0.2, 0.6), *, task=None, **settings):
    """A bridge whose camera gives frames all the time but between the two times; 0.1 s without one is a stall."""
    scene = Scene(directory, 0.001, task, camera_stall_after=0.1, **settings)
    begin_ns, end_ns = (START_NS + round(at * 1e9) for at in stall)

    def newest_frame_ns():
        world_ns = scene.task.advanced_to_ns[-1]
        return begin_ns if begin_ns < world_ns < end_ns else world_ns

    scene.task.newest_frame_ns = newest_frame_ns
    return scene


def test_an_attempt_whose_frames_are_too_old_is_truncated_and_the_robot_rests_until_the_camera_is_back(tmp_path):
    scene = scene_of(tmp_path, task={"reset_steps": 2}, steps=15)
    waited_for = []
    scene.clock.at(0.5, lambda: waited_for.append(scene.bridge.details()["waits_for"]))
    time_steps = scene.run()
    # The frame of 0.2 s is 0.08 s old at 0.28 s, 0.12 s at 0.32 s; the reset takes until 0.4 s.
    ends = [(at, t.terminated) for at, t in zip(scene.published_s, time_steps, strict=True) if t.truncated]
    assert ends == [(0.32, False)]
    last = next(t for t in time_steps if t.truncated)
    assert (last.step_index, last.steps, last.reward) == (8, 8, -1.0)
    assert [at for at in scene.published_s if 0.32 < at < 0.6] == []
    assert waited_for == ["camera"]
    stopped_s = max(at for at in scene.task.times("stop") if at <= 0.4)
    assert stopped_s >= 0.32
    assert [at for at in scene.task.times("command") if stopped_s < at < 0.6] == []
    first = next(t for t in time_steps if t.steps == 10 and t.seq > last.seq + 1)
    assert first.is_first
    assert first.episode == last.episode  # as after a time limit
    assert scene.task.times("begin_episode") == [0.0]
    assert scene.bridge.counters()["camera_stalls"] == 1
    assert scene.bridge.counters()["steps"] == 15


def test_a_stall_shorter_than_the_limit_changes_nothing(tmp_path):
    scene = scene_of(tmp_path, stall=(0.2, 0.3), steps=15)
    assert not any(t.truncated for t in scene.run())
    assert scene.bridge.counters()["camera_stalls"] == 0


def test_a_goal_that_is_reached_meanwhile_is_a_goal(tmp_path):
    scene = scene_of(tmp_path, task={"goal_cycles": {8}}, steps=12)
    time_steps = scene.run()
    assert [(t.terminated, t.truncated) for t in time_steps if t.is_last] == [(True, False)]
    # The next attempt waits for the camera all the same.
    assert [at for at in scene.published_s if 0.32 < at < 0.6] == []


def test_without_a_goal_the_episode_ends_with_the_attempt(tmp_path):
    scene = scene_of(tmp_path, task={"has_goal": False}, steps=10)
    scene.run()
    (row,) = scene.service.record.tables["episodes"]
    assert (row["return"], row["length"]) == (-8.0, 8)


def test_a_camera_that_never_comes_back_does_not_keep_the_run_from_being_stopped(tmp_path):
    scene = scene_of(tmp_path, stall=(0.2, 1e6), steps=1000)
    scene.clock.at(5.0, lambda: scene.service.stop("test"))
    scene.run()
    assert scene.finished[0].reason == "stopped"
    assert scene.counts.cycles == 8


@pytest.mark.parametrize("reset_steps", [0, 3])
def test_in_lockstep_the_cameras_time_goes_on_with_the_attempts(tmp_path, reset_steps):
    scene = scene_of(tmp_path, task={"pacing": "lockstep", "reset_steps": reset_steps}, steps=30)
    time_steps = scene.run()
    truncated = [t.steps for t in time_steps if t.truncated]
    # World time is steps x 0.04 s: too old are the frames after 8 steps up to before 15. Attempts end after one step
    # each, and its reset; nobody waits.
    assert truncated == ([8, 9, 10, 11, 12, 13, 14] if reset_steps == 0 else [8, 12])
    assert scene.bridge.counters()["camera_stalls"] == 1
    assert scene.finished[0].reason == "steps"
