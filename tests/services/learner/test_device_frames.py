"""Minibatches from a copy of the ring's frames are those from the ring itself, whatever the writer does meanwhile."""

import logging

import numpy as np
import pytest
import torch

from common.frame_ring import RingReader, crop_shape, draw_crop_offset, drop_overtaken
from services.learner import device_frames
from services.learner.device_frames import DeviceRingReader
from tests.common.ring_cases import Bridge, task_spec
from tests.common.test_frame_ring import append_all, assert_right, every_pair, make_ring

SPEC = task_spec()
CPU = torch.device("cpu")
FRAME_BYTES = 6 * 8 * 3
FIELDS = ("proprioception", "previous_action", "action", "reward", "terminated", "next_proprioception")


@pytest.fixture
def path(tmp_path):
    return tmp_path / "ring"


def filled_ring(path, steps, capacity_rows=20, frames_per_row=1.0):
    """Return a ring with the first experience of an attempt and ``steps`` more: row n shows frames n - 2 to n."""
    ring, bridge = make_ring(path, capacity_rows, frames_per_row), Bridge()
    append_all(ring, [bridge.start(), *(bridge.step() for _ in range(steps))])
    return ring, bridge


def assert_the_same(resident, mapped):
    """Compare two gathers: which rows can be used, and all there is of those."""
    np.testing.assert_array_equal(resident.valid, mapped.valid)
    ours, theirs = drop_overtaken(resident), drop_overtaken(mapped)
    assert (ours is None) == (theirs is None)
    if ours is None:
        return
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), strict=True)
    for name in ("frames", "next_frames"):
        frames = getattr(ours, name)
        assert isinstance(frames, torch.Tensor)
        assert frames.is_contiguous()
        np.testing.assert_array_equal(frames.numpy(), getattr(theirs, name), strict=True)


class CountingReader(DeviceRingReader):
    """Notes which slots it copies, in order."""

    def __init__(self, path) -> None:
        self.slots = []
        super().__init__(path, CPU)

    @property
    def frames(self):
        return Noted(super().frames, self.slots)


class Noted:
    """Frames that note which of them are read."""

    def __init__(self, frames, slots) -> None:
        self._frames, self._slots = frames, slots

    def __getitem__(self, chosen):
        self._slots.append((chosen.start, chosen.stop))
        return self._frames[chosen]


# ---------------------------------------------------------------------- the same as from the ring


@pytest.mark.parametrize(
    ("frames_per_row", "most_new"),
    [(4.0, 1), (0.5, 2), (1.25, 4)],
    ids=["rows wrap first", "frames wrap first", "more frames than a stack"],
)
def test_random_rows_are_the_same_through_several_wraps(path, frames_per_row, most_new):
    ring, bridge = make_ring(path, 40, frames_per_row), Bridge()
    resident, mapped, rng = DeviceRingReader(path, CPU), RingReader(path), np.random.default_rng(1)
    kept = dropped = 0
    for _ in range(20):
        append_all(ring, bridge.wander(rng, 13, most_new))
        rows = rng.integers(ring.rows_appended - 60, ring.rows_appended + 5, 32)
        crop = draw_crop_offset(SPEC, rng), draw_crop_offset(SPEC, rng)
        got = resident.gather(rows, crop_shape(SPEC), *crop)
        assert_the_same(got, mapped.gather(rows, crop_shape(SPEC), *crop))
        kept, dropped = kept + got.valid.sum(), dropped + (~got.valid).sum()
    assert resident.on_device
    assert kept > 100
    assert dropped > 100
    assert ring.rows_appended > 2 * 40
    assert ring.frames_appended > 2 * ring.layout.capacity_frames or frames_per_row == 4.0


def test_the_crop_is_the_same_wherever_it_lies(path):
    ring, _ = filled_ring(path, 19)
    resident, mapped, rows = DeviceRingReader(path, CPU), RingReader(path), every_pair(ring)
    for options in [(), ((4, 4),), ((4, 4), (2, 3)), ((4, 4), (2, 3), (0, 4)), ((6, 8), (0, 0)), ((1, 1), (5, 7))]:
        assert_the_same(resident.gather(rows, *options), mapped.gather(rows, *options))


def test_a_crop_outside_the_frame_is_refused_in_the_same_words(path):
    filled_ring(path, 5)
    for offset in [(-1, 0), (3, 0), (0, 5)]:
        messages = []
        for reader in (DeviceRingReader(path, CPU), RingReader(path)):
            with pytest.raises(ValueError, match="outside") as caught:
                reader.gather(np.array([1]), (4, 4), offset)
            messages.append(str(caught.value))
        assert messages[0] == messages[1]


def test_any_row_number_is_safe_to_ask_for(path):
    filled_ring(path, 24, capacity_rows=10)
    resident, mapped = DeviceRingReader(path, CPU), RingReader(path)
    for rows in ([-(2**63), -1, 0, 3, 17, 18, 24, 25, 26, 2**63 - 1], [-1, 10**9], []):
        rows = np.array(rows, np.int64)
        assert_the_same(resident.gather(rows), mapped.gather(rows))


# ---------------------------------------------------------------------- what is copied, and when


def test_a_frame_is_copied_once(path):
    ring, bridge = filled_ring(path, 9)
    reader, rows = CountingReader(path), np.array([5, 9])
    reader.gather(rows)
    assert reader.slots == [(0, 10)]
    reader.gather(rows)
    assert reader.slots == [(0, 10)]
    append_all(ring, [bridge.step(), bridge.step(new=0), bridge.step(new=2)])
    reader.gather(rows)
    assert reader.slots == [(0, 10), (10, 13)]


def test_where_the_frames_wrap_both_sides_are_copied(path):
    ring, bridge = filled_ring(path, 17)
    reader, rows = CountingReader(path), np.array([19])
    reader.gather(rows)
    append_all(ring, [bridge.step() for _ in range(5)])  # frames 18 to 22 of 20
    assert_the_same(reader.gather(rows), RingReader(path).gather(rows))
    assert reader.slots == [(0, 18), (18, 20), (0, 3)]


def test_after_a_long_pause_no_frame_is_copied_that_is_gone(path):
    ring, bridge = filled_ring(path, 3)
    reader = CountingReader(path)
    reader.gather(np.array([1]))
    append_all(ring, [bridge.step() for _ in range(107)])  # frames 4 to 110; the last 20 are from 91 on
    rows = every_pair(ring)
    assert_the_same(reader.gather(rows), RingReader(path).gather(rows))
    assert reader.slots == [(0, 4), (11, 20), (0, 11)]


def test_a_restarted_learner_takes_over_a_full_ring_piece_by_piece(path, monkeypatch):
    monkeypatch.setattr(device_frames, "CHUNK_BYTES", 3 * FRAME_BYTES + 1)
    ring, _ = filled_ring(path, 46)  # frames 27 to 46 are there, from slot 7 on
    reader, rows = CountingReader(path), every_pair(ring)
    assert_the_same(reader.gather(rows), RingReader(path).gather(rows))
    assert reader.slots == [(7, 10), (10, 13), (13, 16), (16, 19), (19, 20), (0, 3), (3, 6), (6, 7)]


def test_of_a_ring_that_is_hardly_used_only_that_is_copied(path):
    ring, _ = filled_ring(path, 4, capacity_rows=1000)
    reader, rows = CountingReader(path), every_pair(ring)
    assert_the_same(reader.gather(rows), RingReader(path).gather(rows))
    assert reader.slots == [(0, 5)]


def test_frames_larger_than_a_piece_are_copied_one_by_one(path, monkeypatch):
    monkeypatch.setattr(device_frames, "CHUNK_BYTES", 1)
    ring, _ = filled_ring(path, 3)
    reader, rows = CountingReader(path), every_pair(ring)
    assert_the_same(reader.gather(rows), RingReader(path).gather(rows))
    assert reader.slots == [(0, 1), (1, 2), (2, 3), (3, 4)]


# ---------------------------------------------------------------------- a writer that goes on


class InterruptedReader(DeviceRingReader):
    """Lets a writer go on before each of its looks at the ring, of which it is told the name."""

    def __init__(self, path, between) -> None:
        self._between = between
        super().__init__(path, CPU)

    def read_pairs(self, rows):
        self._between("read_pairs")
        return super().read_pairs(rows)

    @property
    def frames_appended(self):
        self._between("frames_appended")
        return super().frames_appended

    @property
    def frames(self):
        self._between("frames")
        return super().frames

    def not_overtaken(self, pairs):
        self._between("not_overtaken")
        return super().not_overtaken(pairs)

    def frame_slots(self, numbers):
        self._between("frame_slots")
        return super().frame_slots(numbers)


@pytest.mark.parametrize("seed", range(4))
def test_wherever_the_writer_goes_on_valid_rows_are_right(path, monkeypatch, seed):
    monkeypatch.setattr(device_frames, "CHUNK_BYTES", 3 * FRAME_BYTES)
    ring, bridge = make_ring(path, 30, 1.0), Bridge()
    rng = np.random.default_rng(seed)
    append_all(ring, bridge.wander(rng, 30))

    def go_on(look):
        append_all(ring, bridge.wander(rng, int(rng.choice([0, 0, 0, 1, 2, 9]))))

    reader, kept, dropped = InterruptedReader(path, go_on), 0, 0
    for _ in range(60):
        rows = rng.integers(ring.rows_appended - 30, ring.rows_appended + 5, 8)  # some come during the gather
        crop = draw_crop_offset(SPEC, rng), draw_crop_offset(SPEC, rng)
        got = reader.gather(rows, crop_shape(SPEC), *crop)
        left = drop_overtaken(got)
        if left is not None:
            assert_right(bridge, bridge.experiences, rows[got.valid], left, crop, crop_shape(SPEC))
        kept, dropped = kept + got.valid.sum(), dropped + (~got.valid).sum()
    assert kept > 50
    assert dropped > 50


@pytest.mark.parametrize("moment", ["frames_appended", "frames", "not_overtaken"])
def test_what_the_writer_overtakes_meanwhile_is_dropped_as_from_the_ring(path, moment):
    ring, bridge = filled_ring(path, 18)
    meanwhile = [bridge.step() for _ in range(6)]

    def go_on(look):
        if look == moment:
            append_all(ring, meanwhile)
            meanwhile.clear()

    reader = InterruptedReader(path, go_on)
    rows = np.array([1, 5, 10, 18])
    got = reader.gather(rows)
    # 25 rows and frames, the last 20 are there: from 5 on. Row 5's predecessor and frames 2 to 4 are gone.
    assert (got.valid.tolist(), meanwhile) == ([False, False, True, True], [])
    assert_the_same(got, RingReader(path).gather(rows))
    assert_right(bridge, bridge.experiences, [10, 18], drop_overtaken(got))


class Watched(np.ndarray):
    """An array that looks at the ring whenever something is stored in it."""

    def __setitem__(self, key, value):
        self.look()
        super().__setitem__(key, value)


def test_a_frame_that_is_just_being_overwritten_is_not_used_and_its_successor_is(path):
    ring, bridge = filled_ring(path, 19)
    reader, seen = DeviceRingReader(path, CPU), []
    watched = ring._frames.view(Watched)
    watched.look = lambda: seen.append(reader.gather(np.arange(1, 6)).valid.tolist())
    ring._frames = watched
    for _ in range(3):  # frames 20 to 22 go where 0 to 2 were
        ring.append(bridge.step())
    # Row n and the one before it show frames n - 3 to n.
    assert seen == [
        [False, False, False, True, True],
        [False, False, False, False, True],
        [False, False, False, False, False],
    ]
    rows = every_pair(ring)
    assert rows[-1] == 22
    assert_right(bridge, bridge.experiences, rows, drop_overtaken(reader.gather(rows)))


# ---------------------------------------------------------------------- where the frames cannot be


def assert_on_host(reader, path, rows):
    got, expected = reader.gather(rows), RingReader(path).gather(rows)
    assert not reader.on_device
    assert isinstance(got.minibatch.frames, np.ndarray)
    np.testing.assert_array_equal(got.minibatch.frames, expected.minibatch.frames)
    np.testing.assert_array_equal(got.valid, expected.valid)


def test_frames_that_leave_no_memory_for_updates_stay_on_the_host(path, monkeypatch, caplog):
    filled_ring(path, 9)  # room for 20 frames
    for free, fits in ((2**30 + 20 * FRAME_BYTES - 1, False), (2**30 + 20 * FRAME_BYTES, True)):
        monkeypatch.setattr(device_frames, "free_bytes", lambda device, free=free: free)
        caplog.clear()
        reader = DeviceRingReader(path, CPU)
        assert reader.on_device == fits
        assert ("stay in the computer's memory" in caplog.text) == (not fits)
        if not fits:
            assert "1.1 GB for updates, do not fit into the 1.1 GB free on cpu" in caplog.text
            assert_on_host(reader, path, np.array([3, 9]))


@pytest.mark.parametrize("call", ["empty", "crop_stacks"], ids=["at the start", "later"])
def test_when_the_memory_runs_out_the_frames_stay_on_the_host(path, monkeypatch, caplog, call):
    filled_ring(path, 9)

    def run_out(*arguments, **keywords):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB. GPU 0 has little.")

    with monkeypatch.context() as patched:
        patched.setattr(torch if call == "empty" else device_frames, call, run_out)
        reader = DeviceRingReader(path, CPU)
        assert reader.on_device == (call == "crop_stacks")
        assert_on_host(reader, path, np.array([3, 9]))
    assert "each minibatch is copied to the device: CUDA out of memory; a smaller" in caplog.text
    assert_on_host(reader, path, np.array([3, 9]))  # and does not try again with each minibatch
    assert caplog.text.count("out of memory") == 1


def test_where_frames_are_kept_is_told(path, caplog):
    filled_ring(path, 9)
    with caplog.at_level(logging.INFO):
        DeviceRingReader(path, CPU)
    assert "the frames of the ring are kept on cpu: 0.00 GB" in caplog.text


def test_without_camera_there_is_nothing_to_keep_on_the_device(path, caplog):
    ring, bridge = make_ring(path, 10, spec=task_spec(camera=False)), Bridge(camera=False)
    append_all(ring, [bridge.start(), *(bridge.step() for _ in range(24))])
    with caplog.at_level(logging.INFO):
        reader = DeviceRingReader(path, CPU)
    assert (reader.on_device, caplog.text) == (False, "")
    rows = np.array([3, 16, 24])
    got, expected = reader.gather(rows), RingReader(path).gather(rows)
    assert got.minibatch.frames is got.minibatch.next_frames is None
    np.testing.assert_array_equal(got.valid, expected.valid)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(got.minibatch, name), getattr(expected.minibatch, name), strict=True)
