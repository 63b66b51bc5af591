"""Each service is killed in the middle of a run and started again by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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


def test_a_killed_actor_or_bridge_loses_no_more_than_it_held(tmp_path: Path) -> None:
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
        ring.kill("robot_bridge")
        ring.start("robot_bridge")
        wait_until(lambda: ring.incarnations("robot_bridge") == 2, "the bridge is back, as a new incarnation")
        wait_until(lambda: ring.counter("robot_bridge", "steps") > steps + MORE_STEPS, "the run goes on")

        summary = end(ring)
    experience = summary["experience"]
    assert experience["duplicated"] == 0
    # Each held what had not been acknowledged: a period of 0.1 s and the way there, at 50 cycles a second.
    assert experience["lost"] <= 2 * 20
    assert experience["persisted"] > 2 * MORE_STEPS


def end(ring: RingProcesses) -> dict[str, Any]:
    ring.interrupt("robot_bridge")
    codes = ring.wait()
    assert set(codes.values()) == {0}, {name: ring.output(name)[-2000:] for name in codes}
    return ring.summary()


def goes_on(ring: RingProcesses, when: str) -> None:
    rows = ring.counter("replay", "rows")
    wait_until(lambda: ring.counter("replay", "rows") > rows + MORE_STEPS, f"experience is persisted {when}")
