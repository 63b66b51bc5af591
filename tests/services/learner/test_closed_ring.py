"""The four services as they are, each on a thread: what goes round the ring arrives, whole, once, in order."""

import itertools
import threading
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest
import torch

from common import topics
from common.algorithms import load_algorithm
from common.algorithms.base import Algorithm
from common.algorithms.presets import resolve_config
from common.frame_ring import RING_FILE, RingReader
from common.messages import ActionSource
from common.policies import initial_policy
from common.run_settings import RunSettings
from common.service import Service
from common.transport import InMemoryNetwork
from services.actor.actor import Actor
from services.actor.config import ActorSettings
from services.learner.config import LearnerSettings
from services.learner.device_frames import DeviceRingReader
from services.learner.learner import Learner
from services.learner.minibatches import MappedMinibatches, ReceivedMinibatches
from services.replay.config import ReplaySettings
from services.replay.replay import Replay
from services.robot_bridge.bookkeeping import Totals
from services.robot_bridge.bridge import RobotBridge
from services.robot_bridge.config import RobotBridgeSettings
from services.robot_bridge.tasks import load_task
from services.robot_bridge.tasks.noise_frames import read_frame_id
from tests.services.builders import MemoryRecord, Messages

END_TIMEOUT_S = 120.0
SMALL = {
    "sac": {"hidden_size": 32, "batch_size": 8, "min_size_to_sample": 20, "policy_push_interval": 5},
    "ppo": {"hidden_size": 32, "batch_size": 16, "rollout_length": 50, "epochs": 2, "replay_capacity": 2000},
}
# Frames so small that the crop has no margin: every frame of a minibatch still carries its id.
TINY_FRAMES = {"height": 9, "width": 9, "frames_per_cycle": 1.2, "time_limit": 25, "reset_steps": 3}
TINY_ENCODER = {"encoder_strides": [1, 1, 1, 1]}


def keeping(algorithm_class):
    """The algorithm, keeping the minibatches that it learns from."""

    class Keeping(algorithm_class):
        def __init__(self, *arguments, **keywords) -> None:
            super().__init__(*arguments, **keywords)
            self.minibatches = []

        def update(self, minibatch) -> None:
            self.minibatches.append(minibatch)
            super().update(minibatch)

        def update_in_slices(self, minibatch):
            slices = super().update_in_slices(minibatch)
            if slices is not None:
                self.minibatches.append(minibatch)
            return slices

    return Keeping


@dataclass
class Ring:
    """What is left of a run."""

    bridge: RobotBridge
    actor: Actor
    replay: Replay
    learner: Learner
    algorithm: Algorithm
    time_steps: list
    reader: RingReader

    @property
    def persisted(self) -> int:
        """TimeSteps of the bridge that replay kept."""
        return sum(self.replay.details()["persisted"].values())

    def transitions(self):
        """Records (o, o') of all transitions in the ring."""
        rows = np.arange(1, self.reader.rows_appended)
        rows = rows[self.reader.valid_pairs(rows)]
        return self.reader.read_rows(rows - 1), self.reader.read_rows(rows)


def run_ring(
    directory,
    task_name,
    steps,
    *,
    task=None,
    name="sac",
    algorithm=None,
    access="map",
    frames="host",
    pacing="lockstep",
    drops=None,
    order=topics.SERVICES,
):
    """Run the four services on threads until the bridge has done its steps and everyone has drained."""
    network, errors = InMemoryNetwork(drops), []
    run = RunSettings(id="test", directory=str(directory))
    services = {name: Service(name, run, network.transport(run)) for name in topics.SERVICES}
    time_steps = Messages(network.transport(run), topics.TIME_STEP)
    world = load_task(task_name, "", task or {}, pacing=pacing, rng=np.random.default_rng(0))
    spec = world.spec
    config = resolve_config(name, spec.algorithm_presets[name], {**SMALL[name], **(algorithm or {})})
    learnt = keeping(load_algorithm(name))(spec, config, seed=0, precision="float32")
    policy = initial_policy(spec, config.hidden_size, config.encoder_strides, 0)
    source = MappedMinibatches if access == "map" else ReceivedMinibatches
    open_ring = partial(DeviceRingReader, device=torch.device("cpu")) if frames == "device" else RingReader
    extra = [directory / RING_FILE, open_ring] if access == "map" else []
    make = {
        topics.ROBOT_BRIDGE: partial(
            RobotBridge, task=world, settings=RobotBridgeSettings(steps=steps, pacing=pacing), totals=Totals()
        ),
        topics.ACTOR: partial(Actor, spec=spec, initial=policy, settings=ActorSettings()),
        topics.REPLAY: partial(Replay, spec=spec, algorithm=config, settings=ReplaySettings(access=access)),
        topics.LEARNER: lambda service: Learner(
            service,
            learnt,
            config,
            LearnerSettings(),
            source(service, spec, 2, *extra, random_crop=config.random_crop),
            policy_version=0,
        ),
    }
    made = {}

    def run_service(name):
        service = services[name]
        try:
            service.record = MemoryRecord()
            service.start()
            made[name] = make[name](service)
            made[name].run()
        except Exception as error:  # told on the test's thread
            errors.append((name, error))
            for other in services.values():
                other.stop(f"{name} has failed")
        finally:
            service.close()

    threads = [threading.Thread(target=run_service, args=(name,), daemon=True) for name in order]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(END_TIMEOUT_S)
    assert not errors
    assert not any(thread.is_alive() for thread in threads), {name: s.state for name, s in services.items()}
    once = {time_step.seq: time_step for time_step in time_steps}
    return Ring(
        *(made[name] for name in topics.SERVICES),
        learnt,
        [once[seq] for seq in sorted(once)],
        RingReader(directory / RING_FILE),
    )


def stacks_by_the_rule(time_steps, stack_size):
    """seq -> ids of its stack: its newest frame and those before it, none older than the attempt's first."""
    stacks, newest, first = {}, None, None
    for time_step in time_steps:
        ids = time_step.frame_ids.tolist()
        if time_step.is_first:
            first = ids[0] if ids else newest
        newest = ids[-1] if ids else newest
        stacks[time_step.seq] = tuple(max(newest - back, first) for back in reversed(range(stack_size)))
    return stacks


def carried_ids(stacked):
    """Ids that the frames (h, w, S * 3) of one observation carry."""
    return tuple(read_frame_id(stacked[..., i : i + 3]) for i in range(0, stacked.shape[-1], 3))


def assert_nothing_lost_nothing_twice(ring):
    produced = ring.bridge.counts.produced
    assert ring.persisted == produced
    assert ring.replay.details()["produced_seen"] == {str(ring.time_steps[0].incarnation): produced}
    for service in (ring.actor, ring.replay):
        assert service.counters()["lost"] == 0
    for service in (ring.bridge, ring.actor):
        assert service.counters()["given_up"] == 0
        assert service.counters()["unacknowledged"] == 0
    rows = ring.reader.read_rows(np.arange(produced))
    assert rows["seq"].tolist() == list(range(produced))  # each once, in order


def assert_pairs_follow_the_attempts(ring):
    """Every two TimeSteps that follow each other in an attempt are a transition, and nothing else is."""
    before, after = ring.transitions()
    rows = ring.reader.read_rows(np.arange(ring.reader.rows_appended))
    expected = [b["seq"] for a, b in itertools.pairwise(rows) if a["attempt"] == b["attempt"]]
    assert after["seq"].tolist() == expected
    np.testing.assert_array_equal(before["seq"], after["seq"] - 1)


def assert_what_was_learnt_from_is_what_was_seen(ring):
    """Each sampled transition is one that the bridge published: same stacks, by the ids in the pixels."""
    stacks = stacks_by_the_rule(ring.time_steps, 3)
    published = {}
    for a, b in itertools.pairwise(ring.time_steps):
        if a.attempt == b.attempt:
            published[stacks[a.seq], stacks[b.seq]] = (a, b)
    sampled = 0
    for minibatch in ring.algorithm.minibatches:
        for i in range(len(minibatch.reward)):
            key = carried_ids(np.asarray(minibatch.frames[i])), carried_ids(np.asarray(minibatch.next_frames[i]))
            assert key in published
            a, b = published[key]
            np.testing.assert_array_equal(minibatch.proprioception[i], a.proprioception)
            np.testing.assert_array_equal(minibatch.previous_action[i], a.action)
            np.testing.assert_array_equal(minibatch.action[i], b.action)
            np.testing.assert_array_equal(minibatch.next_proprioception[i], b.proprioception)
            assert minibatch.terminated[i] == b.terminated
            sampled += 1
    assert sampled >= 100


@pytest.mark.parametrize(("access", "frames"), [("map", "host"), ("map", "device"), ("arrays", "host")])
def test_camera_frames_go_round_the_ring(tmp_path, access, frames):
    ring = run_ring(
        tmp_path,
        "noise_frames",
        steps=200,
        task=TINY_FRAMES,
        algorithm={**TINY_ENCODER, "replay_ratio": 0.25},
        access=access,
        frames=frames,
    )
    assert ring.bridge.counters()["steps"] == 200
    assert_nothing_lost_nothing_twice(ring)
    assert_pairs_follow_the_attempts(ring)
    assert_what_was_learnt_from_is_what_was_seen(ring)
    for row in ring.reader.read_rows(np.arange(ring.reader.rows_appended)):
        assert tuple(row["frame_ids"]) == stacks_by_the_rule(ring.time_steps, 3)[row["seq"]]
        pixels = ring.reader.frames[ring.reader.frame_slots(row["stack"])]
        assert [read_frame_id(frame) for frame in pixels] == row["frame_ids"].tolist()


def test_the_learner_does_what_the_replay_ratio_allows_and_the_actor_waits_for_it(tmp_path):
    ring = run_ring(tmp_path, "dot_reacher", steps=400, algorithm={"replay_ratio": 1.0})
    assert_nothing_lost_nothing_twice(ring)
    assert_pairs_follow_the_attempts(ring)
    transitions = ring.replay.counters()["transitions"]
    earned = transitions - 20 + 1
    # At the end, what has been prefetched or is allowed to be owed may be left.
    assert earned - 15 <= ring.algorithm.updates <= earned
    assert ring.replay.counters()["minibatches"] <= earned


def test_the_learners_policies_come_to_act(tmp_path):
    ring = run_ring(tmp_path, "dot_reacher", steps=300, algorithm={"replay_ratio": 0.5})
    rows = ring.reader.read_rows(np.arange(ring.reader.rows_appended))
    acted = rows[rows["has_extras"] == 1]
    versions = acted["policy_version"]
    assert (np.diff(versions) >= 0).all()
    assert versions[0] == 0
    assert versions[-1] >= 10  # of about 25 pushes
    assert ring.learner.counters()["policy_version"] >= versions[-1]


def test_in_lockstep_every_cycle_has_the_policys_own_action_with_its_extras(tmp_path):
    ring = run_ring(tmp_path, "dot_reacher", steps=200, algorithm={"replay_ratio": 0.1})
    rows = ring.reader.read_rows(np.arange(ring.reader.rows_appended))
    acted = rows[rows["step_index"] > 0]
    assert acted["has_extras"].all()
    np.testing.assert_array_equal(acted["action"], np.clip(acted["chosen_action"], -1, 1))
    acted = [t for t in ring.time_steps if not t.is_first]
    assert all(t.action_source is ActionSource.POLICY and t.answered_seq == t.seq - 1 for t in acted)
    counters = ring.bridge.counters()
    assert (counters["late_actions"], counters["unanswered"], counters["overruns"]) == (0, 0, 0)


@pytest.mark.parametrize("access", ["map", "arrays"])
@pytest.mark.parametrize("task_name", ["dot_reacher", "noise_frames"])
def test_ppo_learns_from_each_policys_own_steps_in_order_and_once(tmp_path, task_name, access):
    camera = task_name == "noise_frames"
    ring = run_ring(
        tmp_path,
        task_name,
        steps=330,
        task=TINY_FRAMES if camera else None,
        name="ppo",
        algorithm=TINY_ENCODER if camera else None,
        access=access,
    )
    assert_nothing_lost_nothing_twice(ring)
    rollouts, counters = ring.algorithm.minibatches, ring.replay.counters()
    assert len(rollouts) == ring.algorithm.updates == counters["rollouts"] >= 4
    learnt_rows = np.concatenate([rollout.rows for rollout in rollouts])
    assert (np.diff(learnt_rows) > 0).all()
    for version, rollout in enumerate(rollouts):
        records = ring.reader.read_rows(rollout.rows)
        assert records["pair"].all()
        assert set(records["policy_version"]) == {version}  # a push for each rollout, none overtaken
        np.testing.assert_array_equal(rollout.chosen_action, records["chosen_action"])
        np.testing.assert_array_equal(rollout.log_probability, records["log_probability"])
        np.testing.assert_array_equal(rollout.next_proprioception, records["proprioception"])
        # Where rows follow each other, so do the observations.
        follows = np.flatnonzero(np.diff(rollout.rows) == 1)
        np.testing.assert_array_equal(rollout.proprioception[follows + 1], rollout.next_proprioception[follows])
        if camera:
            np.testing.assert_array_equal(rollout.frames[follows + 1], rollout.next_frames[follows])
    # Every transition was learnt from, waits for its rollout to fill, or was dropped and counted.
    transitions = counters["transitions"]
    waiting = counters["rollout_transitions"] if counters["rollout_transitions"] < 50 else 0
    assert transitions == len(learnt_rows) + waiting + counters["dropped_transitions"]
    # In lockstep the actor waits for the policy: what it had begun when the rollout was complete is all that is lost.
    assert counters["dropped_transitions"] <= 3 * len(rollouts)


@pytest.mark.parametrize("order", [topics.SERVICES[::-1], ("replay", "robot_bridge", "learner", "actor")], ids=" ".join)
def test_the_order_in_which_services_start_does_not_matter(tmp_path, order):
    ring = run_ring(tmp_path, "dot_reacher", steps=60, algorithm={"replay_ratio": 0.1}, order=order)
    assert_nothing_lost_nothing_twice(ring)


LOSSY = {
    topics.TIME_STEP,
    topics.TIME_STEP_RESENT,
    topics.TIME_STEP_HEAD,
    topics.TIME_STEP_ACK,
    topics.ACTION,
    topics.EXPERIENCE,
    topics.EXPERIENCE_RESENT,
    topics.EXPERIENCE_HEAD,
    topics.EXPERIENCE_ACK,
    topics.CREDIT,
    topics.ROW_MINIBATCH,
}


def lose_one_in(count, seed=0):
    """Lose messages at random, of every kind that may be lost."""
    rng, lock = np.random.default_rng(seed), threading.Lock()

    def drops(topic, payload):
        with lock:
            return topic in LOSSY and rng.random() < 1 / count

    return drops


def test_in_real_time_with_a_tenth_of_everything_lost_nothing_is_lost_in_the_end(tmp_path):
    ring = run_ring(
        tmp_path,
        "noise_frames",
        steps=250,
        task={**TINY_FRAMES, "action_cycle_time": 0.01},
        algorithm={**TINY_ENCODER, "replay_ratio": 0.25},
        pacing="realtime",
        drops=lose_one_in(10),
    )
    assert ring.bridge.counters()["steps"] == 250
    assert ring.bridge.counters()["resent"] > 0
    assert ring.actor.counters()["resent"] > 0
    assert_nothing_lost_nothing_twice(ring)
    assert_pairs_follow_the_attempts(ring)


def test_in_lockstep_a_lossy_network_only_costs_time(tmp_path):
    ring = run_ring(tmp_path, "dot_reacher", steps=120, algorithm={"replay_ratio": 0.2}, drops=lose_one_in(40, seed=1))
    assert_nothing_lost_nothing_twice(ring)
    assert_pairs_follow_the_attempts(ring)
