"""Each service is killed once in the middle of a run and started again by hand."""

from __future__ import annotations

from pathlib import Path

from tests.integration.ring_processes import SMALL_AND_FAST, RingProcesses, options, start_all, wait_until

MORE_STEPS = 100
"""Progress that shows that the ring goes on."""


def test_whoever_dies_the_others_go_on_and_only_its_memory_is_lost(tmp_path: Path) -> None:
    settings = options(*SMALL_AND_FAST, "algorithm.replay_capacity=4000", "learner.checkpoint_s=1.0")
    with RingProcesses(tmp_path, "noise_frames", "--steps", "1000000", *settings) as ring:
        start_all(ring)
        wait_until(lambda: ring.counter("learner", "updates") > 20, "learning starts")

        version = ring.counter("learner", "policy_version")
        ring.kill("learner")
        goes_on(ring, "without a learner")
        ring.start("learner")
        wait_until(lambda: ring.incarnations("learner") == 2, "the learner is back")
        wait_until(lambda: ring.counter("learner", "policy_version") > version, "newer policies are pushed")
        wait_until(lambda: ring.counter("actor", "policy_version") > version, "the actor acts with them")

        ring.kill("actor")
        wait_until(lambda: ring.counter("robot_bridge", "stops") >= 1, "the watchdog stops the robot")
        actions = ring.counter("robot_bridge", "produced")
        ring.start("actor")
        wait_until(lambda: ring.incarnations("actor") == 2, "the actor is back")
        wait_until(lambda: ring.counter("robot_bridge", "produced") > actions + MORE_STEPS, "it acts")

        rows = ring.counter("replay", "rows")
        ring.kill("replay")
        # The bridge goes on within its grace; the actor keeps what replay does not acknowledge.
        wait_until(lambda: ring.counter("actor", "unacknowledged") > 0, "experience waits for replay")
        ring.start("replay")
        wait_until(lambda: ring.counter("replay", "rows") > rows + MORE_STEPS, "replay goes on in its ring")

        steps = ring.counter("robot_bridge", "steps")
        ring.kill("robot_bridge")
        ring.start("robot_bridge")
        wait_until(lambda: ring.incarnations("robot_bridge") == 2, "the bridge is back, as a new incarnation")
        wait_until(lambda: ring.counter("robot_bridge", "steps") > steps + MORE_STEPS, "the run goes on")
        goes_on(ring, "after all of them have died once")

        ring.interrupt("robot_bridge")
        codes = ring.wait()
        assert set(codes.values()) == {0}, {name: ring.output(name)[-2000:] for name in codes}
        summary = ring.summary()
    experience = summary["experience"]
    assert experience["duplicated"] == 0
    assert experience["lost"] == experience["produced"] - experience["persisted"]
    # What the actor and the bridge held in memory when they were killed: an acknowledgement period or two of
    # cycles each. A killed replay or learner loses nothing.
    assert 0 <= experience["lost"] <= 60


def goes_on(ring: RingProcesses, when: str) -> None:
    rows = ring.counter("replay", "rows")
    wait_until(lambda: ring.counter("replay", "rows") > rows + MORE_STEPS, f"experience is persisted {when}")
