"""The network's path for minibatches equals the mapped one, bit for bit."""

from dataclasses import replace

import numpy as np
import pytest

from common import codec
from common.errors import MessageError
from common.frame_ring import RingReader, array_minibatch, minibatch_from_arrays
from common.messages import ArrayMinibatch
from tests.common.ring_cases import Bridge, task_spec
from tests.common.test_frame_ring import append_all, every_pair, make_ring

SPEC = task_spec()
FRAME_BYTES = 6 * 8 * 3


@pytest.fixture
def path(tmp_path):
    return tmp_path / "ring"


@pytest.fixture
def ring(path):
    ring, bridge = make_ring(path, 40, 1.0), Bridge()
    append_all(ring, bridge.wander(np.random.default_rng(0), 100))
    return ring


def assert_equal(one, other):
    for name, array in vars(one).items():
        np.testing.assert_array_equal(array, getattr(other, name), strict=True)


@pytest.mark.parametrize("max_bytes", [0, 5000, 7000, 16_000_000])
def test_arrays_and_map_give_the_same_minibatch_however_it_is_split(ring, path, max_bytes):
    rows = np.random.default_rng(1).choice(every_pair(ring), 32)
    parts = array_minibatch(ring, rows, 5, 9, max_bytes)
    mapped = RingReader(path).gather(rows, (4, 4), (2, 3), (0, 4))
    assert mapped.valid.all()
    received = [codec.decode(codec.encode(part), ArrayMinibatch, SPEC.dimensions) for part in parts]
    assert_equal(minibatch_from_arrays(received, (4, 4), (2, 3), (0, 4)), mapped.minibatch)
    assert_equal(minibatch_from_arrays(received), RingReader(path).gather(rows).minibatch)
    assert {(p.learner_incarnation, p.ordinal, p.parts) for p in parts} == {(5, 9, len(parts))}
    # Each frame goes over the network once.
    frames = np.concatenate([part.frames for part in parts])
    assert len(np.unique(frames.reshape(len(frames), -1), axis=0)) == len(frames)
    assert (len(parts) > 1) == (max_bytes < 10_000)


def test_messages_keep_to_their_size(ring):
    rows = every_pair(ring)
    parts = array_minibatch(ring, rows, 0, 0, max_bytes=6000)
    assert len(parts) > 1
    for part in parts:
        assert sum(array.nbytes for array in vars(part).values() if isinstance(array, np.ndarray)) <= 6000
    assert all(len(part.frames) == 1 for part in array_minibatch(ring, rows, 0, 0, max_bytes=0))


def test_rows_overtaken_meanwhile_are_left_out(ring):
    last = ring.rows_appended - 1
    good = every_pair(ring)[-3:]
    parts = array_minibatch(ring, np.array([1, *good, last + 50]), 0, 0)
    assert_equal(minibatch_from_arrays(parts), minibatch_from_arrays(array_minibatch(ring, good, 0, 0)))
    assert array_minibatch(ring, np.array([1, 2]), 0, 0) == []


def test_rows_overtaken_while_they_are_copied_are_left_out(ring, path, monkeypatch):
    rows = every_pair(ring)
    view, bridge = RingReader(path), Bridge(incarnation=2)
    slots = view.frame_slots

    def frame_slots(numbers):
        if not bridge.experiences:
            append_all(ring, [bridge.start(), *(bridge.step() for _ in range(9))])
        return slots(numbers)

    monkeypatch.setattr(view, "frame_slots", frame_slots)
    parts = array_minibatch(view, rows, 0, 0)
    left = rows[ring.valid_pairs(rows)]
    assert 0 < len(left) < len(rows)
    assert_equal(minibatch_from_arrays(parts), RingReader(path).gather(left).minibatch)


def test_without_camera_there_is_one_part_without_frames(path):
    ring, bridge = make_ring(path, 10, spec=task_spec(camera=False)), Bridge(camera=False)
    append_all(ring, [bridge.start(), *(bridge.step() for _ in range(5))])
    rows = np.array([1, 5, 3])
    (part,) = array_minibatch(ring, rows, 0, 0)
    part = codec.decode(codec.encode(part), ArrayMinibatch, task_spec(camera=False).dimensions)
    got = minibatch_from_arrays([part])
    assert got.frames is None
    assert got.next_frames is None
    expected = RingReader(path).gather(rows).minibatch
    for name in ("proprioception", "previous_action", "action", "reward", "terminated", "next_proprioception"):
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name), strict=True)


def test_frame_indices_outside_are_refused(ring):
    parts = array_minibatch(ring, every_pair(ring), 0, 0, max_bytes=7000)
    unique = sum(len(part.frames) for part in parts)
    for name in ("frame_index", "next_frame_index"):
        for wrong in (-1, unique, 2**62):
            index = getattr(parts[0], name).copy()
            index[3, 1] = wrong
            with pytest.raises(MessageError, match=rf"{name}: expected indices from 0 to {unique - 1}, got"):
                minibatch_from_arrays([replace(parts[0], **{name: index}), *parts[1:]])
    with pytest.raises(MessageError, match="indices"):
        minibatch_from_arrays([replace(parts[0], frames=parts[0].frames[:0], parts=1)])


def test_parts_that_do_not_belong_together_are_refused(ring):
    parts = array_minibatch(ring, every_pair(ring), 0, 0, max_bytes=7000)
    other = array_minibatch(ring, every_pair(ring), 0, 1, max_bytes=7000)
    assert len(parts) > 1
    for wrong in ([], parts[:-1], parts[::-1], [*parts[:-1], other[-1]]):
        with pytest.raises(MessageError):
            minibatch_from_arrays(wrong)
