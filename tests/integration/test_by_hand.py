"""Four services started by hand, in any order: they find each other, learn, lose nothing, end with the bridge."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from common.frame_ring import RING_FILE, RingReader
from common.frame_ring.layout import SOURCES
from common.messages import ActionSource
from services.robot_bridge.tasks.noise_frames import read_frame_id
from tests.integration.ring_processes import SMALL_AND_FAST, RingProcesses, options, start_all, wait_until

ORDERS = (
    ("robot_bridge", "actor", "replay", "learner"),
    ("learner", "replay", "actor", "robot_bridge"),
    ("replay", "robot_bridge", "learner", "actor"),
    ("actor", "learner", "robot_bridge", "replay"),
)
ROWS = 600
"""Experiences that wrap the ring several times."""


@pytest.mark.parametrize("order", ORDERS, ids="-".join)
def test_any_start_order_learns_and_loses_nothing(order: tuple[str, ...], tmp_path: Path) -> None:
    # One camera frame in some cycles, two or none in others.
    goals = ("task.goal_probability=0.06", "task.time_limit=12")  # both are many among the rows that a ring holds
    settings = options(*SMALL_AND_FAST, "task.frames_per_cycle=0.9", *goals)
    with RingProcesses(tmp_path, "noise_frames", "--steps", "1000000", *settings) as ring:
        start_all(ring, order)
        wait_until(lambda: ring.counter("actor", "policy_version") >= 2, "the actor acts with what was learnt")
        wait_until(lambda: ring.counter("replay", "rows") > ROWS, "the ring has wrapped")
        ring.interrupt("robot_bridge")
        codes = ring.wait()
        outputs = {service: ring.output(service) for service in order}
        assert codes == dict.fromkeys(order, 0), outputs
        summary = ring.summary()
    experience = summary["experience"]
    assert experience["produced"] == experience["persisted"] > ROWS
    assert (experience["lost"], experience["duplicated"]) == (0, 0)
    assert summary["updates"] > 0
    assert summary["policy_pushes"] > 0
    assert_stacks_hold_the_frames_that_their_ids_name(ring.run_dir / RING_FILE)


def assert_stacks_hold_the_frames_that_their_ids_name(path: Path) -> None:
    ring = RingReader(path)
    assert ring.rows_appended > 2 * ring.layout.capacity_rows, "the ring should have wrapped twice"
    first, end = ring.live_rows()
    rows = np.arange(first, end)
    records = ring.read_rows(rows)
    assert records["whole"].all()
    for record in records:
        slots = ring.frame_slots(record["stack"])
        assert [read_frame_id(ring.frames[slot]) for slot in slots] == record["frame_ids"].tolist()
    pairs = rows[1:][ring.valid_pairs(rows[1:])]
    second, before = ring.read_rows(pairs), ring.read_rows(pairs - 1)
    assert (second["step_index"] == before["step_index"] + 1).all()
    assert (second["attempt"] == before["attempt"]).all()
    # Every TimeStep but an attempt's first, and what the watchdog brought about, ends a transition.
    acted = (records["step_index"][1:] > 0) & (records["action_source"][1:] != SOURCES.index(ActionSource.STOP))
    assert len(pairs) == acted.sum()
    # Goals and time-outs are transitions like the others, with the frames that came last.
    assert second["terminated"].sum() == records["terminated"][1:].sum() > 0
    assert second["truncated"].sum() == records["truncated"][1:].sum() > 0
    ring.close()
