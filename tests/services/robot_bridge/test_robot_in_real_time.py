"""The bridge and a simulated robot in a thread of its own, by a simulated clock: the world does not pause."""

import numpy as np
import pytest

from common import topics
from common.codec import decode
from common.messages import Acknowledgement, Action, ActionSource, TimeStep
from common.transport import InMemoryNetwork
from experiments.simulation import SimulatedClock
from services.robot_bridge.bookkeeping import Totals
from services.robot_bridge.bridge import RobotBridge
from services.robot_bridge.config import RobotBridgeSettings
from services.robot_bridge.tasks import load_task
from tests.services.builders import Peer, SoloService
from tests.services.robot_bridge.opengl import skip_without_opengl

BRIDGE, ACTOR = 1000, 50
TURN = np.array([0.1, 0, 0, 0, 0], np.float32)


class Run:
    """A run of a robot whose actor always answers the same, but for the cycles in which it is silent."""

    def __init__(
        self,
        directory,
        steps,
        silent=(),
        name="ur5_visual_reacher_min_time",
        answer=TURN,
        where=None,
        answered_from=0,
        **task,
    ) -> None:
        skip_without_opengl()
        self.clock = SimulatedClock()
        self.network = InMemoryNetwork()
        self.service = SoloService(topics.ROBOT_BRIDGE, self.network, directory, self.clock, incarnation=BRIDGE)
        self.service.peers = {topics.ACTOR: "running", topics.REPLAY: "running"}
        rng = np.random.default_rng(0)
        self.task = load_task(name, overrides=task, pacing="realtime", rng=rng)
        settings = RobotBridgeSettings(pacing="realtime", steps=steps, stop_after=0.5)
        self.bridge = RobotBridge(self.service, self.task, settings, Totals())
        self.actor, self.silent, self.answer, self.time_steps = Peer(self.network), silent, answer, []
        self.answered_from = answered_from
        self.where, self.places = where or (lambda robot: None), []
        self.actor.transport.subscribe(topics.TIME_STEP, self._receive)
        self.actor.transport.subscribe(topics.FINISHED, lambda _: self._end())
        try:
            self.bridge.run()
        finally:
            self.clock.end()

    def _receive(self, payload) -> None:
        time_step = decode(payload, TimeStep, self.task.spec.dimensions)
        self.time_steps.append(time_step)
        self.places.append(self.where(self.task.robot))
        answered = time_step.seq >= self.answered_from and time_step.step_index not in self.silent
        if answered and not time_step.is_last:
            answer = Action(ACTOR, BRIDGE, time_step.seq, self.answer, -1.0, 3, 0, 0, 0, 0, -1)
            self.actor.send(topics.ACTION, answer)

    def _end(self) -> None:
        self.service.peers = dict.fromkeys(self.service.peers, "drained")
        produced = self.bridge.counts.produced
        self.actor.send(topics.TIME_STEP_ACK, Acknowledgement(BRIDGE, produced, np.zeros((0, 2), np.int64), 0.0))


def test_without_answers_the_arm_goes_on_at_its_last_speed_until_the_watchdog_stops_it(tmp_path):
    run = Run(tmp_path, steps=75, silent=range(25, 50))
    steps = [step for step in run.time_steps if step.seq > 0]  # without the one that asks for a first answer
    assert [step.step_index for step in steps] == list(range(76))
    angles, speeds = (np.array([step.proprioception[joint] for step in steps]) for joint in (0, 5))
    # 0.1 rad/s, reached in 72 ms, goes on over the silence's first half second: 12 cycles of 40 ms.
    np.testing.assert_allclose(speeds[3:37], 0.1, atol=1e-6)
    np.testing.assert_allclose(np.diff(angles)[3:36], 0.004, atol=1e-6)
    assert steps[36].action_source is ActionSource.HELD
    # Then it is at rest, until there are answers again.
    np.testing.assert_allclose(speeds[39:50], 0, atol=1e-6)
    np.testing.assert_allclose(np.diff(angles)[39:50], 0, atol=1e-6)
    assert steps[40].action_source is ActionSource.STOP
    np.testing.assert_allclose(speeds[55:], 0.1, atol=1e-6)
    assert run.bridge.counts.overruns == 0
    assert run.bridge.counters()["stops"] == 1


@pytest.mark.parametrize(
    ("name", "answer", "where", "speed"),
    [
        ("ur5_visual_reacher", [0.1, 0, 0, 0, 0], lambda robot: robot.arm.angles[0], 0.1),
        ("franka_visual_reacher", [0.1, 0, 0, 0, 0, 0, 0], lambda robot: robot.arm.angles[0], 0.1),
        # On the spot, away from whatever wall there is: 2 x 47 mm/s at the ends of a track of 235 mm, and of 48 mm.
        ("create_reacher", [-47, 47], lambda robot: robot.drive.pose[2], 0.4),
        ("vector_charger_detector", [-9.6, 9.6], lambda robot: robot.drive.pose[2], 0.4),
    ],
    ids=["ur5", "franka", "create", "vector"],
)
def test_every_robot_goes_on_without_answers_until_the_watchdog_stops_it(tmp_path, name, answer, where, speed):
    # The watchdog waits for 0.5 s; the silence, in cycles of 40 to 100 ms, lasts for 1 s and more.
    run = Run(tmp_path, 50, range(25, 50), name, np.array(answer, np.float32), where)
    seconds = np.array([(step.published_ns - run.time_steps[0].published_ns) * 1e-9 for step in run.time_steps])
    silent_from = next(time for time, step in zip(seconds, run.time_steps, strict=True) if step.step_index == 25)
    since, places = seconds - silent_from, np.array(run.places)
    goes_on = (since >= 0) & (since <= 0.45)
    rests = since >= 0.7
    # What is seen is up to a sensor's period old, 60 ms at most.
    moved, took = np.ptp(places[goes_on]), np.ptp(since[goes_on])
    assert moved == pytest.approx(speed * took, abs=speed * 0.07)
    assert rests.sum() >= 6
    np.testing.assert_allclose(places[rests], places[-1], atol=1e-9)
    assert run.bridge.counters()["stops"] == 1
    assert {step.action_source for step in np.array(run.time_steps)[rests]} == {ActionSource.STOP}


def test_each_cycle_brings_the_frames_and_packets_of_its_time(tmp_path):
    run = Run(tmp_path, steps=50)
    steps = [step for step in run.time_steps if step.seq > 0]
    captured = np.concatenate([step.frame_capture_ns for step in steps])
    ids = np.concatenate([step.frame_ids for step in steps])
    assert np.diff(ids).tolist() == [1] * (len(ids) - 1)
    assert set(np.diff(captured)) <= {33_333_333, 33_333_334}
    assert {len(step.frame_ids) for step in steps[1:]} <= {0, 1, 2}
    counters = run.bridge.counters()
    # 2 s: 250 packets and 60 frames, and those from before the first attempt.
    assert 250 <= counters["sensor_packets"] <= 260
    assert 60 <= counters["camera_frames"] <= 64


def test_what_the_camera_saw_while_the_robot_waited_does_not_travel(tmp_path):
    run = Run(tmp_path, steps=2, answered_from=3)
    asked = [step for step in run.time_steps if step.seq <= 3]
    assert [len(step.frame_ids) for step in asked] == [1] * 4
    assert np.diff([step.frame_ids[0] for step in asked[1:]]).tolist() == [15, 15]  # half a second each
    assert all(step.published_ns - step.frame_capture_ns[0] < 34_000_000 for step in asked)


def test_an_attempt_after_a_time_out_begins_with_a_frame_of_the_start(tmp_path):
    run = Run(tmp_path, steps=60, time_limit=20, reset_steps=5)
    firsts = [step for step in run.time_steps if step.is_first and step.seq > 0]
    assert len(firsts) == 3
    for first in firsts:
        assert len(first.frame_ids) == 1
        assert first.published_ns == first.frame_capture_ns[0]  # drawing takes no simulated time
        np.testing.assert_allclose(first.proprioception[0], 1.5707)
    assert len({first.pixels.tobytes() for first in firsts}) == 1  # the target has stayed
