"""Each service is killed in the middle of a run and started again by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from common.frame_ring import RING_FILE, RingReader
from tests.integration.ring_processes import SMALL_AND_FAST, RingProcesses, options, start_all, wait_until

MORE_STEPS = 100
"""Progress that shows that the ring goes on."""
SETTINGS = options(*SMALL_AND_FAST, "algorithm.replay_capacity=4000", "learner.checkpoint_s=1.0")
ENDLESS = ("--steps", "1000000")


def test_a_killed_learner_or_replay_loses_nothing(tmp_path: Path) -> None:
    with RingProcesses(tmp_path, "noise_frames", *ENDLESS, *SETTINGS) as ring:
        start_all(ring)
        wait_until(lambda: ring.counter("learner", "updates") > 20, "learning starts")

        version = ring.counter("learner", "policy_version")
        ring.kill("learner")
        goes_on(ring, "without a learner")
        ring.start("learner")
        wait_until(lambda: ring.incarnations("learner") == 2, "the learner is back")
        wait_until(lambda: ring.counter("learner", "policy_version") > version, "newer policies are pushed")
        wait_until(lambda: ring.counter("actor", "policy_version") > version, "the actor acts with them")

        rows = ring.counter("replay", "rows")
        ring.kill("replay")
        # The bridge goes on within its grace; the actor keeps what replay does not acknowledge.
        wait_until(lambda: ring.counter("actor", "unacknowledged") > 0, "experience waits for replay")
        ring.start("replay")
        wait_until(lambda: ring.counter("replay", "rows") > rows + MORE_STEPS, "replay goes on in its ring")

        summary = end(ring)
    experience = summary["experience"]
    assert (experience["lost"], experience["duplicated"]) == (0, 0)
    assert experience["produced"] > 2 * MORE_STEPS


def test_what_a_killed_actor_or_bridge_held_is_reported_exactly(tmp_path: Path) -> None:
    with RingProcesses(tmp_path, "noise_frames", *ENDLESS, *SETTINGS) as ring:
        start_all(ring)
        wait_until(lambda: ring.counter("replay", "rows") > MORE_STEPS, "experience is persisted")

        ring.kill("actor")
        wait_until(lambda: ring.counter("robot_bridge", "stops") >= 1, "the watchdog stops the robot")
        produced = ring.counter("robot_bridge", "produced")
        ring.start("actor")
        wait_until(
            lambda: ring.incarnations("actor") == 2 and ring.counter("actor", "actions") > 0, "the actor is back"
        )
        wait_until(lambda: ring.counter("robot_bridge", "produced") > produced + MORE_STEPS, "the run goes on")
        # What came in between waits at the bridge; killed now, it would take that along.
        wait_until(lambda: ring.counter("robot_bridge", "unacknowledged") < 15, "the gap has been filled")

        steps = ring.counter("robot_bridge", "steps")
        with ring.listen_to_bridge() as listener:
            wait_until(lambda: listener.heard, "the bridge is heard")
            # Without an actor nobody acknowledges: all that comes now is lost with the bridge.
            ring.kill("actor")
            wait_until(lambda: ring.counter("robot_bridge", "unacknowledged") > 15, "experience waits at the bridge")
            ring.kill("robot_bridge")
            wait_until(lambda: listener.quiet_for_s > 0.5, "what was on its way has been heard")
        ((killed, heard),) = listener.heard.items()
        published = max(heard) + 1
        counted = ring.parts("robot_bridge")[-1]["counters"]["produced"]
        # It counts before it publishes: the last one may have stayed in the dead process.
        assert published <= counted <= published + 1
        ring.start("actor")
        ring.start("robot_bridge")
        wait_until(lambda: ring.incarnations("robot_bridge") == 2, "the bridge is back, as a new incarnation")
        wait_until(lambda: ring.counter("robot_bridge", "steps") > steps + MORE_STEPS, "the run goes on")

        summary = end(ring)
    experience = summary["experience"]
    assert experience["duplicated"] == 0
    rows = rows_of(ring.run_dir / RING_FILE)
    assert experience["persisted"] == len(rows) > 2 * MORE_STEPS
    killed_bridge, last_bridge = ring.parts("robot_bridge")
    assert killed_bridge["incarnation"] == killed
    assert killed_bridge["counters"]["produced"] == counted
    assert experience["produced"] == counted + last_bridge["counters"]["produced"]
    missing = set(range(counted)) - set(rows["seq"][rows["incarnation"] == killed].tolist())
    assert (rows["incarnation"] == last_bridge["incarnation"]).sum() == last_bridge["counters"]["produced"]
    assert experience["lost"] == len(missing) > 15
    # Not a step is counted twice or left out either.
    assert summary["steps"] == killed_bridge["counters"]["steps"] + last_bridge["counters"]["cycles"]
    assert summary["cycles"] == killed_bridge["counters"]["cycles"] + last_bridge["counters"]["cycles"]


def rows_of(path: Path) -> Any:
    """All rows of a ring that has not wrapped."""
    ring = RingReader(path)
    try:
        return ring.read_rows(np.arange(ring.rows_appended)).copy()
    finally:
        ring.close()


def end(ring: RingProcesses) -> dict[str, Any]:
    ring.interrupt("robot_bridge")
    codes = ring.wait()
    assert set(codes.values()) == {0}, {name: ring.output(name)[-2000:] for name in codes}
    return ring.summary()


def goes_on(ring: RingProcesses, when: str) -> None:
    rows = ring.counter("replay", "rows")
    wait_until(lambda: ring.counter("replay", "rows") > rows + MORE_STEPS, f"experience is persisted {when}")
