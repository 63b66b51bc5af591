"""Minibatches come by credit, in order, once; from the mapped ring or as arrays."""

from dataclasses import fields, replace
from functools import partial

import numpy as np
import pytest
import torch

from common import topics
from common.clock import FakeClock
from common.frame_ring import RING_FILE, RingReader, RingWriter, array_minibatch
from common.messages import RowMinibatch
from common.minibatch import Minibatch
from common.transport import InMemoryNetwork
from services.learner.device_frames import DeviceRingReader
from services.learner.minibatches import MappedMinibatches, ReceivedMinibatches
from tests.common.ring_cases import HEIGHT, MARGIN_X, MARGIN_Y, STACK, WIDTH, Bridge, task_spec
from tests.helpers import TIMEOUT_S, eventually
from tests.services.builders import Peer, SoloService

LEARNER = 77
PREFETCH = 3
SHAPE = (HEIGHT - 2 * MARGIN_Y, WIDTH - 2 * MARGIN_X, STACK * 3)
CAPACITY = 40
FIELDS = [field.name for field in fields(Minibatch) if field.name not in ("frames", "next_frames")]


class Scene:
    """A source of minibatches, and the replay that serves it, with a ring of its own."""

    def __init__(self, directory, source_class, open_ring=RingReader, **options) -> None:
        self.clock = FakeClock()
        self.network = InMemoryNetwork()
        self.service = SoloService(topics.LEARNER, self.network, directory, self.clock, incarnation=LEARNER)
        self.path, self.bridge = directory / RING_FILE, Bridge()
        self.peer = Peer(self.network)
        self.credits = self.peer.messages(topics.CREDIT)
        extra = [self.path, open_ring] if source_class is MappedMinibatches else []
        self.source = source_class(self.service, task_spec(), PREFETCH, *extra, **options)
        self.ring = None

    def fill(self, count) -> None:
        """Append experiences of one attempt: experience n is row n."""
        self.ring = self.ring or RingWriter.create_or_reopen(self.path, task_spec(), CAPACITY)
        for _ in range(count):
            self.ring.append(self.bridge.step() if self.bridge.experiences else self.bridge.start())

    def send_rows(self, ordinal, rows, learner=LEARNER) -> None:
        self.peer.send(topics.ROW_MINIBATCH, RowMinibatch(learner, ordinal, np.array(rows, np.int64)))

    def send_arrays(self, ordinal, rows, max_bytes=10**6, parts=None, **changes) -> None:
        messages = array_minibatch(self.ring, np.array(rows, np.int64), LEARNER, ordinal, max_bytes)
        for message in messages if parts is None else [messages[i] for i in parts]:
            self.peer.send(topics.ARRAY_MINIBATCH, replace(message, **changes))

    def get(self):
        minibatch = self.source.get(TIMEOUT_S)
        assert minibatch is not None
        return minibatch

    def wait_for_credit(self, want_total, received_total) -> None:
        wanted = want_total, received_total
        eventually(
            lambda: len(self.credits) and (self.credits[-1].want_total, self.credits[-1].received_total) == wanted
        )


def started(directory, source_class, *open_ring, **options):
    scene = Scene(directory, source_class, *open_ring, **options)
    scene.source.start()
    yield scene
    scene.source.stop()
    if scene.ring:
        scene.ring.close()


@pytest.fixture(params=["frames in the ring", "frames on the device"])
def mapped(tmp_path, request):
    """A source that maps the ring."""
    on_device = request.param == "frames on the device"
    open_ring = partial(DeviceRingReader, device=torch.device("cpu")) if on_device else RingReader
    yield from started(tmp_path, MappedMinibatches, open_ring)


@pytest.fixture
def received(tmp_path):
    """A source that gets arrays."""
    yield from started(tmp_path, ReceivedMinibatches)


def rows_of(minibatch):
    """Numbers of the second rows: the proprioception says them."""
    return minibatch.next_proprioception[:, 0].astype(int).tolist()


def test_a_ring_with_other_observations_than_the_learner_s_is_refused_with_the_reason(mapped, caplog):
    mapped.ring = RingWriter.create_or_reopen(mapped.path, task_spec(), CAPACITY, pending_actions=2)
    mapped.fill(3)
    mapped.send_rows(0, [1])
    eventually(lambda: mapped.source.dropped == 1)
    assert "observations of 6 numbers, expected 2; is algorithm.pending_actions the same" in caplog.text


# ---------------------------------------------------------------------- credit


def test_a_learner_asks_for_as_many_as_it_prefetches(mapped):
    (credit,) = mapped.credits.wait_for(1)
    assert (credit.learner_incarnation, credit.want_total, credit.received_total) == (LEARNER, PREFETCH, 0)


def test_it_asks_for_another_when_one_is_taken_and_not_when_one_comes(mapped):
    mapped.fill(20)
    mapped.send_rows(0, [3, 4])
    mapped.send_rows(1, [5, 6])
    mapped.wait_for_credit(PREFETCH, 2)
    assert rows_of(mapped.get()) == [3, 4]
    mapped.wait_for_credit(PREFETCH + 1, 2)
    assert rows_of(mapped.get()) == [5, 6]
    mapped.wait_for_credit(PREFETCH + 2, 2)


def test_a_credit_is_sent_again_every_now_and_then(mapped):
    mapped.credits.wait_for(1)
    mapped.clock.advance(0.2)
    again = mapped.credits.wait_for(2)[1]
    assert (again.want_total, again.received_total) == (PREFETCH, 0)


def test_without_a_minibatch_there_is_none_in_time(mapped):
    assert mapped.source.get(0.0) is None


# ---------------------------------------------------------------------- the mapped ring


def test_a_minibatch_is_what_its_rows_hold_cropped_at_random(mapped):
    mapped.fill(30)
    offsets = set()
    for ordinal in range(12):
        rows = np.array([2, 9, 29])
        mapped.send_rows(ordinal, rows)
        minibatch = mapped.get()
        whole = RingReader(mapped.path).gather(rows).minibatch
        assert minibatch.frames.shape == (3, *SHAPE)
        (offset,) = [
            (y, x)
            for y in range(2 * MARGIN_Y + 1)
            for x in range(2 * MARGIN_X + 1)
            if np.array_equal(minibatch.frames, whole.frames[:, y : y + SHAPE[0], x : x + SHAPE[1]])
        ]
        y, x = offset
        # One offset for all of a minibatch, o and o' alike.
        next_frames = whole.next_frames[:, y : y + SHAPE[0], x : x + SHAPE[1]]
        np.testing.assert_array_equal(minibatch.next_frames, next_frames)
        for name in FIELDS:
            np.testing.assert_array_equal(getattr(minibatch, name), getattr(whole, name))
        offsets.add(offset)
    assert len(offsets) > 1


@pytest.mark.parametrize("source_class", [MappedMinibatches, ReceivedMinibatches])
def test_an_algorithm_may_ask_for_the_crop_that_acting_sees(source_class, tmp_path):
    for scene in started(tmp_path, source_class, random_crop=False):
        scene.fill(30)
        rows = np.array([2, 9, 29])
        for ordinal in range(3):
            if source_class is MappedMinibatches:
                scene.send_rows(ordinal, rows)
            else:
                scene.send_arrays(ordinal, rows)
            whole = RingReader(scene.path).gather(rows).minibatch
            middle = whole.frames[:, MARGIN_Y : MARGIN_Y + SHAPE[0], MARGIN_X : MARGIN_X + SHAPE[1]]
            np.testing.assert_array_equal(scene.get().frames, middle)


def test_a_minibatch_comes_once_and_in_order(mapped):
    mapped.fill(20)
    for ordinal, rows in ((0, [1]), (1, [2]), (0, [11]), (1, [12]), (2, [3])):
        mapped.send_rows(ordinal, rows)
    assert [rows_of(mapped.get()) for _ in range(3)] == [[1], [2], [3]]
    assert mapped.source.get(0.0) is None


def test_a_minibatch_that_was_lost_on_the_way_is_not_waited_for(mapped):
    mapped.fill(20)
    mapped.send_rows(0, [1])
    mapped.send_rows(2, [3])
    assert [rows_of(mapped.get()) for _ in range(2)] == [[1], [3]]
    mapped.wait_for_credit(3 + PREFETCH, 3)


def test_another_learners_minibatches_are_left_alone(mapped):
    mapped.fill(20)
    mapped.send_rows(0, [1], learner=LEARNER - 1)
    mapped.send_rows(0, [2], learner=LEARNER + 1)
    mapped.send_rows(0, [3])
    assert rows_of(mapped.get()) == [3]


def test_rows_that_were_overtaken_are_dropped_and_the_rest_is_kept(mapped):
    mapped.fill(CAPACITY + 20)
    mapped.send_rows(0, [5, 30, 19, 40])  # rows before 20 are gone, and row 20 has lost the one before it
    assert rows_of(mapped.get()) == [30, 40]
    assert mapped.source.dropped == 0


@pytest.mark.parametrize("rows", [[3, 5], [0], [60, 61, 10**9], [-1, -5], []], ids=repr)
def test_a_minibatch_of_which_nothing_is_left_is_dropped_and_counted_and_the_next_one_comes(mapped, rows):
    mapped.fill(CAPACITY + 20)
    mapped.send_rows(0, rows)
    mapped.send_rows(1, [30])
    assert rows_of(mapped.get()) == [30]
    assert mapped.source.dropped == 1
    mapped.wait_for_credit(2 + PREFETCH, 2)  # one more is asked for instead


def test_a_ring_that_is_not_there_is_refused_and_asked_for_again(mapped):
    mapped.send_rows(0, [1])
    eventually(lambda: mapped.source.dropped == 1)
    assert mapped.service.refusals.counts == {"minibatch/rows": 1}
    mapped.wait_for_credit(1 + PREFETCH, 1)
    mapped.fill(20)
    mapped.send_rows(1, [2])
    assert rows_of(mapped.get()) == [2]


def test_bytes_that_are_no_minibatch_are_dropped_and_counted(mapped):
    mapped.fill(20)
    mapped.peer.send_bytes(topics.ROW_MINIBATCH, b"noise")
    mapped.send_rows(0, [2])
    assert rows_of(mapped.get()) == [2]
    assert mapped.service.refusals.counts == {"minibatch/rows": 1}


# ---------------------------------------------------------------------- arrays


@pytest.mark.parametrize("max_bytes", [10**6, 1000, 1], ids=["one part", "few parts", "a frame each"])
def test_arrays_make_the_same_minibatch_as_the_ring(received, max_bytes):
    received.fill(30)
    rows = np.array([2, 9, 10, 29])
    received.send_arrays(0, rows, max_bytes)
    minibatch = received.get()
    whole = RingReader(received.path).gather(rows).minibatch
    crops = [
        whole.frames[:, y : y + SHAPE[0], x : x + SHAPE[1]]
        for y in range(2 * MARGIN_Y + 1)
        for x in range(2 * MARGIN_X + 1)
    ]
    assert sum(np.array_equal(minibatch.frames, crop) for crop in crops) == 1
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(minibatch, name), getattr(whole, name))


@pytest.mark.parametrize("parts", [[0], [1, 2], [0, 2], [2], [0, 0]], ids=repr)
def test_a_minibatch_of_which_a_part_is_lost_never_comes_and_the_next_one_does(received, parts):
    received.fill(30)
    received.send_arrays(0, [2, 9, 29], max_bytes=1, parts=parts)
    received.send_arrays(1, [4, 7], max_bytes=1)
    assert rows_of(received.get()) == [4, 7]
    assert received.source.get(0.0) is None


def test_a_minibatch_that_is_sent_again_is_taken(received):
    received.fill(30)
    received.send_arrays(0, [2, 9, 29], max_bytes=1, parts=[0, 1])
    received.send_arrays(0, [3, 8], max_bytes=1)
    assert rows_of(received.get()) == [3, 8]
    assert received.source.get(0.0) is None


def test_parts_that_do_not_fit_each_other_are_refused(received):
    received.fill(30)
    received.send_arrays(0, [2, 9], frame_index=np.full((2, STACK), 99))
    eventually(lambda: received.source.dropped == 1)
    assert received.service.refusals.counts == {"minibatch/arrays": 1}
    received.send_arrays(1, [4])
    assert rows_of(received.get()) == [4]
