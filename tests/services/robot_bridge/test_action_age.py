"""An action's age, split by hand."""

from __future__ import annotations

import numpy as np

from common import topics
from common.inbox import Arrived
from common.messages import Action
from services.robot_bridge import answers
from services.robot_bridge.action_age import PARTS, PublishedStep, age_parts_us
from tests.services.robot_bridge.scripted import Scene

MS = 1_000_000


def arrived(offset_ms=-3000.0, bound_ms=0.25, at_ms=1060.0) -> Arrived[Action]:
    """Received at 4030, began at 4032, computed at 4037 by an actor's clock that is 3 s ahead."""
    times = (4030 * MS, 4032 * MS, 4037 * MS, round(offset_ms * MS), round(bound_ms * MS))
    return Arrived(Action(5, 1, 7, np.zeros(2, np.float32), 0.0, 0, *times), round(at_ms * MS))


STEP = PublishedStep(published_ns=1010 * MS, sent_ns=1011 * MS, captured_ns=1000 * MS)


def test_the_parts_are_the_times_between_and_their_sum_is_the_age():
    parts = age_parts_us(STEP, arrived(), applied_ns=round(1060.5 * MS))
    # 1000 captured, 1010 published, 1011 sent, 1030 received, 1032 began, 1037 computed, 1060 arrived, 1060.5 applied
    assert parts == {
        "camera_us": 10_000,
        "encode_us": 1_000,
        "uplink_us": 19_000,
        "queue_us": 2_000,
        "inference_us": 5_000,
        "downlink_us": 23_000,
        "apply_us": 500,
        "offset_bound_us": 250,
    }
    assert sum(parts[f"{name}_us"] for name in PARTS) == 60_500


def test_an_error_of_the_offset_moves_time_from_one_way_to_the_other():
    right, wrong = (age_parts_us(STEP, arrived(offset_ms), 1060 * MS) for offset_ms in (-3000.0, -2999.0))
    assert wrong["uplink_us"] - right["uplink_us"] == 1000
    assert wrong["downlink_us"] - right["downlink_us"] == -1000
    assert {name for name in right if right[name] != wrong[name]} == {"uplink_us", "downlink_us"}


def test_what_is_not_known_is_empty():
    step = PublishedStep(published_ns=1010 * MS, sent_ns=1011 * MS)
    parts = age_parts_us(step, arrived(offset_ms=0, bound_ms=-1e-6), applied_ns=None)
    empty = {name for name, value in parts.items() if value is None}
    assert empty == {"camera_us", "uplink_us", "downlink_us", "apply_us", "offset_bound_us"}


def test_the_bridge_records_the_parts_of_what_it_applied(tmp_path):
    scene = Scene(tmp_path, answers=0.01, task={"camera": True}, steps=2)
    # The actor's clock is 2 s behind; each answer is sent 4 ms before it arrives.
    scene.actor_times = lambda: (ns_ago(9), ns_ago(8), ns_ago(4), 2000 * MS, 100_000)

    def ns_ago(ms):
        return scene.clock.now_ns() - round((2000 + ms) * MS) if scene.clock.now_ns() > 2100 * MS else 0

    scene.clock.advance(10.0)
    scene.run()
    probe, *rows = scene.service.record.tables["actions"]
    assert probe["apply_us"] is None, "the answer to the probe does not move the robot"
    for row in rows:
        assert [row[f"{name}_us"] for name in PARTS] == [0, 0, 1_000, 1_000, 4_000, 4_000, 0]
        assert row["offset_bound_us"] == 100


def test_without_new_frames_the_age_counts_from_the_newest_there_is(tmp_path):
    scene = Scene(tmp_path, answers=0.01, task={"camera": True}, steps=3)
    reading = scene.task.read

    def read_once():
        scene.task.read = lambda: without_frames(reading())
        return reading()

    scene.task.read = read_once
    scene.run()
    assert [row["camera_us"] for row in scene.service.record.tables["actions"]] == [0, 0, 40_000, 80_000]


def without_frames(reading):
    return type(reading)(
        reading.frames[:0], reading.frame_ids[:0], reading.frame_capture_ns[:0], reading.proprioception
    )


def test_a_refused_action_is_recorded_without_being_applied(tmp_path):
    scene = Scene(tmp_path, answers=0.01, steps=1)
    scene.clock.at(0.005, lambda: scene.command("pause"))
    scene.clock.at(0.02, lambda: scene.command("resume"))
    scene.run()
    rows = {row["answered_seq"]: row["apply_us"] for row in scene.service.record.tables["actions"]}
    assert rows[1] is None


def test_in_lockstep_cameras_have_a_time_of_their_own(tmp_path):
    scene = Scene(tmp_path, answers=0.01, task={"camera": True, "pacing": "lockstep"}, steps=2)
    scene.run()
    assert {row["camera_us"] for row in scene.service.record.tables["actions"]} == {None}


def test_the_record_of_actions_is_bounded(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(answers, "RECORDED_ACTIONS", 5)
    scene = Scene(tmp_path, answers=0.01, steps=20)
    scene.run()
    assert len(scene.service.record.tables["actions"]) == 5
    assert caplog.text.count("actions.csv has 5 rows of this bridge: no more are added") == 1
    assert scene.counts.unanswered == 0
    assert topics.ACTION.name not in scene.service.refusals.counts
