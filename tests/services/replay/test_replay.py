"""Replay keeps each experience once, says what it has, and gives out as many minibatches as are earned and wanted."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from common import topics
from common.algorithms.sac_config import SACConfig
from common.clock import FakeClock
from common.errors import RingError
from common.frame_encoding import FrameEncoding, encode_frames
from common.frame_ring import RING_FILE, RingReader, minibatch_from_arrays
from common.messages import Credit, Experience, Finished, RowMinibatch, StreamHead
from common.transport import InMemoryNetwork
from services.replay.config import ReplaySettings
from services.replay.replay import Replay
from tests.common.ring_cases import Bridge, task_spec
from tests.helpers import TIMEOUT_S, eventually
from tests.services.builders import Peer, SoloService

ACTOR = 5
"""The actor's incarnation in :class:`tests.common.ring_cases.Bridge`."""
LEARNER = 77
CONFIG = SACConfig(batch_size=4, min_size_to_sample=10, replay_capacity=200)


class Scene:
    """Replay, not running, between an actor and a learner that the test plays."""

    def __init__(self, directory, config=CONFIG, pacing="realtime", encoding=FrameEncoding.RAW, **settings) -> None:
        self.clock = FakeClock()
        self.network = InMemoryNetwork()
        self.service = SoloService(topics.REPLAY, self.network, directory, self.clock)
        spec = replace(task_spec(), pacing=pacing, frame_encoding=encoding)
        self.replay = Replay(self.service, spec, config, ReplaySettings(**settings))
        self.peer = Peer(self.network)
        self.acks = self.peer.messages(topics.EXPERIENCE_ACK)
        self.rows = self.peer.messages(topics.ROW_MINIBATCH)
        self.arrays = self.peer.messages(topics.ARRAY_MINIBATCH)

    def send(self, *experiences: Experience, topic=topics.EXPERIENCE) -> None:
        """Let experiences arrive, and replay handle what has come."""
        for experience in experiences:
            self.peer.send(topic, experience)
        self.replay.step()

    def send_head(self, next_seq, oldest_seq=0, stream=ACTOR) -> None:
        self.peer.send(topics.EXPERIENCE_HEAD, StreamHead(stream, oldest_seq, next_seq))
        self.replay.step()

    def ask(self, want_total, received_total=0, learner=LEARNER) -> list[RowMinibatch]:
        """Send a credit; return the minibatches that it brings."""
        before = len(self.rows)
        self.peer.send(topics.CREDIT, Credit(learner, want_total, received_total))
        self.replay.step()
        return self.rows[before:]

    def ack(self):
        """The acknowledgement that is due a tenth of a second later."""
        self.clock.advance(0.1)
        self.replay.step()
        return self.acks[-1]

    def counter(self, name):
        return self.replay.counters()[name]


def ordinals(minibatches):
    return [minibatch.ordinal for minibatch in minibatches]


def attempt(bridge, count):
    """One long attempt: ``count`` experiences, so ``count - 1`` transitions."""
    return [bridge.start()] + [bridge.step() for _ in range(count - 1)]


def from_another_actor(experiences, actor=ACTOR + 1):
    """The same TimeSteps as a later actor sends them: its own incarnation and numbers."""
    return [replace(e, actor_incarnation=actor, seq=seq) for seq, e in enumerate(experiences)]


@pytest.fixture
def scene(tmp_path):
    """Replay with an empty ring."""
    return Scene(tmp_path)


# ---------------------------------------------------------------------- experience


def test_experience_is_kept_in_order_and_acknowledged(scene):
    experiences = attempt(Bridge(), 5)
    scene.send(*experiences[:3])
    assert (scene.acks[-1].stream, scene.acks[-1].next_seq, len(scene.acks[-1].missing)) == (ACTOR, 3, 0)
    scene.send(*experiences[3:])
    assert scene.ack().next_seq == 5
    assert scene.counter("rows") == 5
    assert scene.counter("transitions") == 4
    assert scene.replay.details()["persisted"] == {"1": 5}


def test_what_comes_after_a_gap_waits_and_the_gap_is_named(scene, tmp_path):
    experiences = attempt(Bridge(), 8)
    scene.send(*(experiences[i] for i in (0, 1, 4, 7, 5)))
    assert scene.counter("rows") == 2
    ack = scene.ack()
    assert (ack.next_seq, ack.missing.tolist()) == (2, [[2, 4], [6, 7], [8, 8]])
    scene.send(experiences[3], experiences[2], topic=topics.EXPERIENCE_RESENT)
    ack = scene.ack()
    assert (ack.next_seq, ack.missing.tolist()) == (6, [[6, 7], [8, 8]])
    scene.send(experiences[6])
    assert scene.counter("transitions") == 7  # in order: no pair is missing
    seqs = RingReader(tmp_path / RING_FILE).read_rows(np.arange(8))["seq"]
    assert seqs.tolist() == list(range(8))


def test_acknowledgements_come_ten_times_a_second_at_most(scene):
    experiences = attempt(Bridge(), 6)
    for experience in experiences:
        scene.send(experience)
    assert len(scene.acks) == 1
    assert scene.ack().next_seq == 6
    assert len(scene.acks) == 2


def test_a_copy_is_kept_once(scene):
    experiences = attempt(Bridge(), 3)
    scene.send(*experiences, *experiences, topic=topics.EXPERIENCE)
    assert scene.counter("rows") == 3
    assert scene.counter("duplicates") == 3


def test_what_the_actor_gave_up_is_lost_and_counted_and_no_pair_is_made_across_it(scene):
    experiences = attempt(Bridge(), 8)
    scene.send(*experiences[:2], *experiences[5:])
    scene.send_head(8, oldest_seq=4)
    assert scene.counter("lost") == 2
    assert scene.ack().missing.tolist() == [[4, 5], [8, 8]]
    scene.send(experiences[4])
    assert scene.counter("rows") == 6
    assert scene.replay.details()["produced_seen"] == {"1": 8}
    # 0-1, then 4-5, 5-6, 6-7; the stacks after the gap are whole again when it is 3 frames back: 6-7.
    assert scene.counter("transitions") == 2


def test_a_restarted_actor_does_not_bring_anything_twice(scene):
    experiences = attempt(Bridge(), 12)
    scene.send(*experiences[:8])
    # The actor died before it had told the bridge of 5, 6 and 7: its successor gets them from there again.
    scene.send(*from_another_actor(experiences[5:]))
    assert scene.counter("rows") == 12
    assert scene.counter("duplicates") == 3
    assert scene.counter("lost") == 0
    assert scene.counter("transitions") == 11  # nor is a pair missing where one follows the other
    ack = scene.ack()
    assert (ack.stream, ack.next_seq) == (ACTOR + 1, 7)


def test_an_actor_that_has_been_followed_by_another_is_not_heard(scene):
    experiences = attempt(Bridge(), 4)
    scene.send(*from_another_actor(experiences[:2]))
    scene.send(experiences[2])
    assert scene.counter("rows") == 2
    assert scene.ack().stream == ACTOR + 1


def test_each_bridges_time_steps_are_counted_by_themselves(scene):
    bridge = Bridge()
    attempt(bridge, 4)
    bridge.restart()
    attempt(bridge, 3)
    scene.send(*bridge.experiences)
    assert scene.replay.details()["persisted"] == {"1": 4, "2": 3}
    assert scene.counter("transitions") == 3 + 2


def test_experience_that_cannot_be_kept_is_refused_and_the_rest_goes_on(scene):
    experiences = attempt(Bridge(), 3)
    ids = np.array([1, 1], np.int64)
    frames = np.zeros((2, *experiences[1].time_step.frames.shape[1:]), np.uint8)
    bad = replace(experiences[1].time_step, frame_ids=ids, frame_capture_ns=ids, frames=frames)
    scene.send(experiences[0], replace(experiences[1], time_step=bad), experiences[2])
    assert scene.service.refusals.counts == {"experience": 1}
    assert scene.counter("rows") == 2
    assert scene.ack().next_seq == 3  # resending would not make it better
    assert scene.replay.details()["produced_seen"] == {"1": 3}  # so it shows as lost


@pytest.mark.parametrize("encoding", [FrameEncoding.ZSTD, FrameEncoding.JPEG444])
def test_encoded_frames_are_kept_as_the_actor_has_seen_them(tmp_path, encoding):
    scene = Scene(tmp_path, encoding=encoding)
    experiences = []
    for experience in attempt(Bridge(), 3):
        step = experience.time_step
        noise = np.random.default_rng(step.seq).integers(0, 256, step.frames.shape, np.uint8)
        encoded = replace(step, frames=encode_frames(noise, encoding))
        experiences.append(replace(experience, time_step=encoded))
    damaged = replace(experiences[1].time_step.frames, digest="0" * 16)
    scene.send(replace(experiences[1], time_step=replace(experiences[1].time_step, frames=damaged)))
    assert scene.service.refusals.counts == {"experience": 1}
    scene.send(*experiences)
    assert scene.counter("rows") == 3
    seen = np.concatenate([experience.time_step.pixels for experience in experiences])
    np.testing.assert_array_equal(RingReader(tmp_path / RING_FILE).frames[: len(seen)], seen)
    scene.replay._ring.close()


@pytest.mark.parametrize("topic", [topics.EXPERIENCE, topics.EXPERIENCE_RESENT, topics.EXPERIENCE_HEAD, topics.CREDIT])
def test_bytes_that_are_no_message_are_dropped_and_counted(scene, topic):
    scene.peer.send_bytes(topic, b"\xff" * 20)
    scene.replay.step()
    assert scene.service.refusals.counts == {topic.name: 1}


# ---------------------------------------------------------------------- credit and budget


def test_no_minibatch_goes_out_before_the_minimum_size_and_then_one_for_each_transition(scene):
    bridge = Bridge()
    scene.send(*attempt(bridge, 10))  # 9 transitions
    assert scene.ask(want_total=100) == []
    scene.send(bridge.step())  # the tenth is the first that earns
    assert ordinals(scene.rows) == [0]
    scene.send(bridge.step(), bridge.step())
    assert ordinals(scene.rows) == [0, 1, 2]
    assert scene.counter("minibatches") == 3


def test_a_minibatch_names_transitions_of_the_ring_and_its_learner(scene, tmp_path):
    bridge = Bridge()
    scene.send(*bridge.wander(np.random.default_rng(0), 60))
    minibatches = scene.ask(want_total=20)
    reader = RingReader(tmp_path / RING_FILE)
    assert len(minibatches) == 20
    for minibatch in minibatches:
        assert minibatch.learner_incarnation == LEARNER
        assert len(minibatch.rows) == CONFIG.batch_size
        assert reader.valid_pairs(minibatch.rows).all()


def test_no_more_goes_out_than_is_wanted_in_total(scene):
    scene.send(*attempt(Bridge(), 60))
    assert ordinals(scene.ask(2)) == [0, 1]
    assert scene.ask(2) == []  # the same credit again
    assert ordinals(scene.ask(5, received_total=2)) == [2, 3, 4]
    assert scene.ask(4, received_total=4) == []  # an older one, overtaken on its way
    assert scene.counter("minibatches") == 5


def test_the_replay_ratio_decides_how_many_are_earned(tmp_path):
    scene = Scene(tmp_path, config=replace(CONFIG, replay_ratio=0.25))
    scene.send(*attempt(Bridge(), 50))  # 49 transitions, 40 of them earn
    assert len(scene.ask(1000)) == 10
    assert scene.ack().updates_owed == 0.0


def test_what_is_owed_is_told_to_the_actor(scene):
    scene.send(*attempt(Bridge(), 31))  # 30 transitions, 21 of them earn
    assert scene.ack().updates_owed == 21.0
    scene.ask(4)
    assert scene.ack().updates_owed == 17.0


def test_in_lockstep_what_is_owed_is_told_at_once(tmp_path):
    scene = Scene(tmp_path, pacing="lockstep")
    bridge = Bridge()
    scene.send(*attempt(bridge, 13))
    scene.send(bridge.step())
    scene.ask(3)  # spent, and told before anything else happens
    assert [ack.updates_owed for ack in scene.acks] == [3.0, 4.0, 1.0]


def test_a_learner_that_comes_late_does_not_catch_up_beyond_the_surplus(tmp_path):
    scene = Scene(tmp_path, max_surplus=7.0)
    bridge = Bridge()
    scene.send(*attempt(bridge, 100))
    assert len(scene.ask(1000)) == 7
    scene.send(bridge.step())
    assert len(scene.rows) == 8


def test_resets_and_first_time_steps_earn_nothing(scene):
    bridge = Bridge()
    scene.send(*attempt(bridge, 11))
    assert len(scene.ask(1000)) == 1
    scene.send(*(bridge.start() for _ in range(20)))
    assert len(scene.rows) == 1
    assert scene.counter("owed") == 0.0


def test_a_minibatch_that_was_lost_is_sent_again(scene):
    scene.send(*attempt(Bridge(), 60))
    assert ordinals(scene.ask(2)) == [0, 1]
    scene.clock.advance(0.9)
    assert scene.ask(2, received_total=1) == []  # may still be on its way
    scene.clock.advance(0.2)
    assert ordinals(scene.ask(2, received_total=1)) == [1]
    assert scene.ask(2, received_total=2) == []


def test_a_new_learner_is_served_from_its_own_beginning(scene):
    scene.send(*attempt(Bridge(), 60))
    scene.ask(5, received_total=3)
    minibatches = scene.ask(2, learner=LEARNER + 1)
    assert ordinals(minibatches) == [0, 1]
    assert {m.learner_incarnation for m in minibatches} == {LEARNER + 1}
    assert scene.ask(50, received_total=5, learner=LEARNER) == []  # the old one's last word, late


def test_of_several_credits_the_newest_counts(scene):
    scene.send(*attempt(Bridge(), 60))
    for want in (1, 2, 3):
        scene.peer.send(topics.CREDIT, Credit(LEARNER, want, 0))
    scene.replay.step()
    assert ordinals(scene.rows) == [0, 1, 2]


def test_minibatches_as_arrays_are_those_of_the_ring(tmp_path):
    scene = Scene(tmp_path, access="arrays", message_mib=0.1)
    scene.send(*Bridge().wander(np.random.default_rng(0), 60))
    assert scene.ask(1) == []
    parts = scene.arrays.wait_for(1)
    assert [(p.learner_incarnation, p.ordinal, p.part, p.parts) for p in parts] == [(LEARNER, 0, 0, 1)]
    minibatch = minibatch_from_arrays(parts)
    reader = RingReader(tmp_path / RING_FILE)
    every = np.arange(60)
    every = every[reader.valid_pairs(every)]
    ring = reader.gather(every).minibatch
    for i in range(CONFIG.batch_size):
        (at,) = np.flatnonzero((ring.next_proprioception == minibatch.next_proprioception[i]).all(axis=1))
        for name in ("frames", "next_frames", "proprioception", "previous_action", "action", "reward", "terminated"):
            np.testing.assert_array_equal(getattr(minibatch, name)[i], getattr(ring, name)[at])


class SlowLink:
    """Keeps whoever puts an array minibatch waiting until the test opens it."""

    def __init__(self, scene) -> None:
        self.open = threading.Event()
        self.reached = threading.Event()
        scene.peer.transport.subscribe(topics.ARRAY_MINIBATCH, self._carry)

    def _carry(self, payload) -> None:
        self.reached.set()
        assert self.open.wait(TIMEOUT_S)


def test_a_slow_link_keeps_only_the_minibatches_waiting(tmp_path):
    scene = Scene(tmp_path, access="arrays")
    link = SlowLink(scene)
    bridge = Bridge()
    scene.send(*attempt(bridge, 60))
    scene.ask(3)
    assert link.reached.wait(TIMEOUT_S)
    scene.send(*(bridge.step() for _ in range(40)))
    assert scene.ack().next_seq == 100
    scene.clock.advance(100.0)
    scene.ask(3)
    assert scene.counter("minibatches") == 3  # those on their way are not taken for lost
    link.open.set()
    assert [p.ordinal for p in scene.arrays.wait_for(3)] == [0, 1, 2]

    def sent_again():
        scene.clock.advance(1.0)
        scene.ask(3, received_total=2)
        return len(scene.arrays) > 3

    eventually(sent_again, "the last minibatch once more")
    assert [p.ordinal for p in scene.arrays] == [0, 1, 2, 2]


def test_what_waits_for_a_learner_that_is_gone_is_dropped(tmp_path):
    scene = Scene(tmp_path, access="arrays")
    link = SlowLink(scene)
    scene.send(*attempt(Bridge(), 60))
    scene.ask(4)
    assert link.reached.wait(TIMEOUT_S)
    scene.ask(1, learner=LEARNER + 1)
    link.open.set()
    parts = scene.arrays.wait_for(2)
    assert [(p.learner_incarnation, p.ordinal) for p in parts] == [(LEARNER, 0), (LEARNER + 1, 0)]


# ---------------------------------------------------------------------- restarts


def test_a_restarted_replay_goes_on_with_its_ring(tmp_path):
    bridge = Bridge()
    first = Scene(tmp_path)
    first.send(*attempt(bridge, 40))
    first.replay._ring.close()

    second = Scene(tmp_path)
    assert second.counter("rows") == 40
    assert second.counter("transitions") == 39
    assert second.replay.details()["persisted"] == {"1": 40}
    # What its predecessor had kept and not acknowledged comes again.
    second.send(*bridge.experiences[36:])
    second.send_head(40, oldest_seq=36)
    assert second.counter("rows") == 40
    assert second.counter("lost") == 0
    assert second.ack().next_seq == 40
    second.send(bridge.step())
    assert second.counter("rows") == 41
    assert second.counter("transitions") == 40  # the pair across the restart too


def test_a_restarted_replay_owes_nothing_for_what_it_had_and_serves_at_once(tmp_path):
    bridge = Bridge()
    first = Scene(tmp_path)
    first.send(*attempt(bridge, 40))
    first.replay._ring.close()

    second = Scene(tmp_path)
    assert second.ask(want_total=9, received_total=7) == []
    second.send_head(40, oldest_seq=40)
    second.send(bridge.step())
    assert ordinals(second.rows) == [7]  # where the learner is
    second.send(bridge.step(), bridge.step())
    assert ordinals(second.rows) == [7, 8]


def test_a_learners_map_stays_good_over_a_restart_of_replay(tmp_path):
    bridge = Bridge()
    first = Scene(tmp_path)
    first.send(*attempt(bridge, 20))
    reader = RingReader(tmp_path / RING_FILE)
    first.replay._ring.close()
    second = Scene(tmp_path)
    second.send_head(20, oldest_seq=20)
    second.send(*(bridge.step() for _ in range(10)))
    gathered = reader.gather(np.array([19, 20, 29]))
    assert gathered.valid.all()
    assert gathered.minibatch.next_proprioception[:, 0].tolist() == [19, 20, 29]


def test_a_ring_of_another_layout_is_an_error_that_says_so(tmp_path):
    Scene(tmp_path).replay._ring.close()
    with pytest.raises(RingError, match="another layout"):
        Scene(tmp_path, config=replace(CONFIG, replay_capacity=300))


def test_a_second_replay_on_the_same_ring_is_refused(tmp_path):
    scene = Scene(tmp_path)
    with pytest.raises(RingError, match="another process writes"):
        Scene(tmp_path)
    scene.replay._ring.close()


# ---------------------------------------------------------------------- the end of the run


@pytest.fixture
def running(tmp_path):
    """Replay with its loop running on a thread, all peers there; it has ended at the test's end."""
    scene = Scene(tmp_path)
    scene.service.peers = dict.fromkeys((topics.ROBOT_BRIDGE, topics.ACTOR, topics.LEARNER), "running")
    scene.loop = threading.Thread(target=scene.replay.run)
    scene.loop.start()
    yield scene
    scene.service.peers = {}
    scene.service.stop("end of the test")
    scene.loop.join(TIMEOUT_S)
    assert not scene.loop.is_alive()


def test_the_loop_keeps_acknowledges_and_serves(running):
    for experience in attempt(Bridge(), 30):
        running.peer.send(topics.EXPERIENCE, experience)
    eventually(lambda: running.counter("rows") == 30)
    running.peer.send(topics.CREDIT, Credit(LEARNER, 3, 0))
    assert ordinals(running.rows.wait_for(3)) == [0, 1, 2]


def test_replay_ends_when_everything_the_bridge_produced_is_kept(running):
    experiences = attempt(Bridge(), 10)
    for experience in experiences[:9]:
        running.peer.send(topics.EXPERIENCE, experience)
    running.service.finished_message = Finished(1, 10, "steps")
    eventually(lambda: running.service.state == "draining")
    running.service.peers = dict.fromkeys((topics.ROBOT_BRIDGE, topics.LEARNER), "drained") | {topics.ACTOR: "draining"}
    running.peer.send(topics.EXPERIENCE, experiences[9])
    eventually(lambda: running.service.state == "drained")
    assert running.loop.is_alive()  # the actor still wants its acknowledgement
    running.clock.advance(0.2)
    eventually(lambda: running.acks[-1].next_seq == 10)
    running.service.peers[topics.ACTOR] = "drained"
    running.loop.join(TIMEOUT_S)
    assert not running.loop.is_alive()


def test_replay_ends_when_what_is_missing_will_not_come(running):
    experiences = attempt(Bridge(), 10)
    for experience in experiences[:6]:
        running.peer.send(topics.EXPERIENCE, experience)
    running.service.finished_message = Finished(1, 10, "steps")
    eventually(lambda: running.service.state == "draining")
    running.service.peers = dict.fromkeys(running.service.peers, "drained")
    running.loop.join(TIMEOUT_S)
    assert not running.loop.is_alive()
    assert running.replay.details()["persisted"] == {"1": 6}


def test_an_actor_behind_an_outage_is_waited_for_at_the_end(running):
    experiences = attempt(Bridge(), 10)
    for experience in experiences[:6]:
        running.peer.send(topics.EXPERIENCE, experience)
    eventually(lambda: running.counter("rows") == 6)
    # The link has been silent for 2 s; the bridge's word is the first that comes through again.
    running.service.peers = {topics.ROBOT_BRIDGE: "gone", topics.ACTOR: "gone", topics.LEARNER: "drained"}
    running.service.ages_s = {topics.ACTOR: 2.0}
    running.service.finished_message = Finished(1, 10, "steps")
    for _ in range(3):
        acks = len(running.acks)
        running.clock.advance(0.1)
        running.acks.wait_for(acks + 1)
    assert running.loop.is_alive()
    for experience in experiences[6:]:
        running.peer.send(topics.EXPERIENCE, experience)
    running.loop.join(TIMEOUT_S)
    assert running.replay.details()["persisted"] == {"1": 10}


def test_an_actor_that_is_gone_for_good_is_not_waited_for(running):
    for experience in attempt(Bridge(), 6):
        running.peer.send(topics.EXPERIENCE, experience)
    eventually(lambda: running.counter("rows") == 6)
    running.service.peers = {}
    running.service.finished_message = Finished(1, 10, "steps")
    running.loop.join(TIMEOUT_S)
    assert not running.loop.is_alive()


def test_a_run_without_a_time_step_ends_too(running):
    running.service.peers = {}
    running.service.finished_message = Finished(1, 0, "stopped")
    running.loop.join(TIMEOUT_S)
    assert not running.loop.is_alive()
