"""Appending and gathering: what comes out is what the robot saw, or is not called valid."""

import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest

from common.errors import MessageError, RingError
from common.frame_ring import RingReader, RingWriter, crop_shape, draw_crop_offset, drop_overtaken, reader
from tests.common.ring_cases import Bridge, crop_of, task_spec

SPEC = task_spec()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "ring"


def make_ring(path, capacity_rows=64, frames_per_row=1.25, spec=SPEC):
    return RingWriter.create_or_reopen(path, spec, capacity_rows, frames_per_row)


def append_all(ring, experiences):
    for experience in experiences:
        ring.append(experience)


def every_pair(view):
    """Return all valid rows there are, looking far beyond both ends."""
    rows = np.arange(-5, view.rows_appended + 5)
    return rows[view.valid_pairs(rows)]


def assert_right(bridge, experiences, rows, minibatch, crop=((0, 0), (0, 0)), shape=(6, 8)):
    """Compare a minibatch with the bridge's own knowledge, transition by transition."""
    for at, row in enumerate(rows):
        before, now = experiences[row - 1], experiences[row]
        assert now.time_step.seq == before.time_step.seq + 1
        assert now.time_step.attempt == before.time_step.attempt
        np.testing.assert_array_equal(minibatch.frames[at], crop_of(bridge.stack_of(before), *crop[0], *shape))
        np.testing.assert_array_equal(minibatch.next_frames[at], crop_of(bridge.stack_of(now), *crop[1], *shape))
        np.testing.assert_array_equal(minibatch.proprioception[at], before.time_step.proprioception)
        np.testing.assert_array_equal(minibatch.previous_action[at], before.time_step.action)
        np.testing.assert_array_equal(minibatch.action[at], now.time_step.action)
        np.testing.assert_array_equal(minibatch.next_proprioception[at], now.time_step.proprioception)
        assert minibatch.reward[at] == now.time_step.reward
        assert minibatch.terminated[at] == now.time_step.terminated


@pytest.mark.parametrize("channels", [1, 3])
def test_one_transition_by_hand(path, channels):
    spec = task_spec(channels=channels)
    ring, bridge = make_ring(path, spec=spec), Bridge()
    for made in (bridge.start(), bridge.step(new=2, terminated=True)):
        step = made.time_step
        ring.append(replace(made, time_step=replace(step, frames=step.frames[..., :channels])))
    got = RingReader(path).gather(np.array([1]))
    assert got.valid.tolist() == [True]
    expected = np.concatenate([crop_of([i])[..., :channels] for i in (0, 0, 0)], axis=-1)
    np.testing.assert_array_equal(got.minibatch.frames, expected[None])
    expected = np.concatenate([crop_of([i])[..., :channels] for i in (0, 1, 2)], axis=-1)
    np.testing.assert_array_equal(got.minibatch.next_frames, expected[None])
    np.testing.assert_array_equal(got.minibatch.previous_action, [[0, 0]])
    np.testing.assert_array_equal(got.minibatch.action, np.array([[1 / 1024, -1 / 1024]], np.float32))
    np.testing.assert_array_equal(got.minibatch.reward, np.array([-0.5], np.float32))
    np.testing.assert_array_equal(got.minibatch.terminated, np.array([1], np.float32))
    assert got.minibatch.terminated.dtype == np.float32


def test_a_row_keeps_what_the_experience_says(path):
    ring, bridge = make_ring(path), Bridge(incarnation=2**63 + 5)
    append_all(ring, [bridge.start(), bridge.step(truncated=True)])
    first, second = ring.read_rows(np.array([0, 1]))
    assert (first["action_source"], second["action_source"]) == (0, 1)
    assert (first["has_extras"], second["has_extras"]) == (0, 1)
    assert (second["log_probability"], second["policy_version"]) == (-1.5, 7)
    np.testing.assert_array_equal(second["chosen_action"], 2 * second["action"])
    assert (second["incarnation"], second["seq"], second["actor_incarnation"]) == (2**63 + 5, 1, 5)
    assert (second["action_applied_ns"], second["published_ns"]) == (901, 1001)
    assert (second["terminated"], second["truncated"], second["step_index"]) == (0, 1, 1)
    assert ring.last_persisted() == (2**63 + 5, 1)


def test_terminal_and_time_out_rows_hold_the_real_next_frame(path):
    ring, bridge = make_ring(path), Bridge()
    made = [bridge.start(), bridge.step(terminated=True), bridge.start(), bridge.step(truncated=True)]
    made += [bridge.start(), bridge.step()]
    append_all(ring, made)
    assert every_pair(ring).tolist() == [1, 3, 5]
    got = RingReader(path).gather(np.array([1, 3, 5])).minibatch
    assert_right(bridge, made, [1, 3, 5], got)
    np.testing.assert_array_equal(got.terminated, [1, 0, 0])
    np.testing.assert_array_equal(got.next_frames[1], crop_of([2, 2, 3]))


@pytest.mark.parametrize(
    ("frames_per_row", "most_new"),
    [(4.0, 1), (0.5, 2), (1.25, 4)],
    ids=["rows wrap first", "frames wrap first", "more frames than a stack"],
)
def test_gathers_equal_a_naive_reference_through_several_wraps(path, frames_per_row, most_new):
    ring, bridge = make_ring(path, 40, frames_per_row), Bridge()
    view, rng = RingReader(path), np.random.default_rng(1)
    checked = 0
    for _ in range(20):
        append_all(ring, bridge.wander(rng, 13, most_new))
        first, end = view.live_rows()
        rows = every_pair(view)
        assert end == ring.rows_appended == len(bridge.experiences)
        assert all(first < row < end for row in rows)
        # Nothing that could be used is withheld: each row in the live range that continues an attempt.
        steps = [e.time_step for e in bridge.experiences]
        assert rows.tolist() == [row for row in range(first + 1, end) if steps[row].step_index > 0]
        crop = draw_crop_offset(SPEC, rng), draw_crop_offset(SPEC, rng)
        got = view.gather(rows, crop_shape(SPEC), *crop)
        assert got.valid.all()
        assert_right(bridge, bridge.experiences, rows, got.minibatch, crop, crop_shape(SPEC))
        checked += len(rows)
    assert checked > 200
    assert ring.rows_appended > 2 * 40
    assert ring.frames_appended > 2 * ring.layout.capacity_frames or frames_per_row == 4.0


def test_rows_live_as_long_as_their_slot_and_their_oldest_frame(path):
    ring, bridge = make_ring(path, 10, 4.0), Bridge()  # 40 frames: the rows wrap first
    append_all(ring, [bridge.start(), *(bridge.step() for _ in range(14))])
    assert ring.live_rows() == (5, 15)
    assert every_pair(ring).tolist() == list(range(6, 15))
    ring.close()

    # 12 frames for 10 rows of two frames each. The last 12 of 31 frames are 19 to 30. Row r shows 2r - 2 to 2r,
    # so row 11 (20, 21, 22) is the first that is whole, and row 12 ends the first transition.
    ring, bridge = make_ring(path.with_name("frames"), 10, 1.2), Bridge()
    append_all(ring, [bridge.start(), *(bridge.step(new=2) for _ in range(15))])
    assert ring.frames_appended == 31
    assert ring.live_rows() == (11, 16)
    assert every_pair(ring).tolist() == [12, 13, 14, 15]


def test_a_row_that_goes_on_showing_one_frame_dies_with_it(path):
    ring, bridge = make_ring(path, 10, 1.2), Bridge()
    append_all(ring, [bridge.start(), bridge.step(new=0), bridge.step(new=0)])
    append_all(ring, [bridge.step(new=3) for _ in range(4)])  # frames 1 to 12: frame 0 is overwritten
    assert ring.live_rows() == (3, 7)
    assert every_pair(ring).tolist() == [4, 5, 6]


def test_a_lost_experience_is_a_missing_pair(path):
    ring, bridge = make_ring(path), Bridge()
    made = [bridge.start(), *(bridge.step() for _ in range(9))]
    kept = made[:4] + made[5:]  # number 4, with frame 4, is lost
    append_all(ring, kept)
    # Row 4 (TimeStep 5) follows a gap; rows 4 and 5 miss frame 4, so the first whole pair is rows 6 and 7.
    assert every_pair(ring).tolist() == [1, 2, 3, 7, 8]
    assert ring.transitions_appended == 5
    rows = every_pair(ring)
    assert_right(bridge, kept, rows, RingReader(path).gather(rows).minibatch)
    gap = RingReader(path).gather(np.array([3, 4]))
    assert gap.valid.tolist() == [True, False]


def test_a_lost_experience_without_frames_costs_no_more_than_its_pairs(path):
    ring, bridge = make_ring(path), Bridge()
    made = [bridge.start(), bridge.step(), bridge.step(new=0), bridge.step(), bridge.step()]
    append_all(ring, made[:2] + made[3:])
    assert every_pair(ring).tolist() == [1, 3]


def test_a_late_experience_makes_no_pair_across_the_order_but_heals_stacks(path):
    ring, bridge = make_ring(path), Bridge()
    made = [bridge.start(), *(bridge.step() for _ in range(6))]
    order = [made[i] for i in (0, 1, 3, 2, 4, 5, 6)]
    append_all(ring, order)
    # Only 0-1, 4-5 and 5-6 stand side by side; the late frame 2 is there for the stacks of 4, 5 and 6.
    assert every_pair(ring).tolist() == [1, 5, 6]
    assert_right(bridge, order, [1, 5, 6], RingReader(path).gather(np.array([1, 5, 6])).minibatch)


def test_no_transition_crosses_attempts_episodes_or_incarnations(path):
    ring, bridge = make_ring(path), Bridge()
    made = [bridge.start(), bridge.step(), bridge.start(), bridge.step(), bridge.step(terminated=True)]
    made += [bridge.start(), bridge.step()]
    append_all(ring, made)
    bridge.restart()
    made += [bridge.start(), bridge.step()]
    append_all(ring, made[-2:])
    assert every_pair(ring).tolist() == [1, 3, 4, 6, 8]


@pytest.mark.parametrize(
    ("whose", "fields", "is_pair"),
    [
        ("second", {}, True),
        ("second", {"incarnation": 2}, False),
        ("second", {"seq": 3}, False),
        ("second", {"seq": 0}, False),
        ("second", {"episode": 1}, False),
        ("second", {"attempt": 1}, False),
        ("second", {"step_index": 1}, False),
        ("second", {"step_index": 3}, False),
        ("first", {"terminated": True}, False),
        ("first", {"truncated": True}, False),
        ("second", {"terminated": True}, True),
        ("second", {"truncated": True}, True),
    ],
)
def test_a_transition_is_two_consecutive_experiences_of_one_attempt(path, whose, fields, is_pair):
    ring, bridge = make_ring(path, spec=task_spec(camera=False)), Bridge(camera=False)
    bridge.start()
    made = {"first": bridge.step(), "second": bridge.step()}
    step = made[whose].time_step
    made[whose] = replace(made[whose], time_step=replace(step, **fields))
    append_all(ring, made.values())
    assert every_pair(ring).tolist() == ([1] if is_pair else [])
    assert RingReader(path).gather(np.array([0, 1])).valid.tolist() == [False, is_pair]
    assert ring.transitions_appended == is_pair


def test_any_row_number_is_safe_to_ask_for(path):
    ring, bridge = make_ring(path, 10), Bridge()
    append_all(ring, [bridge.start(), *(bridge.step() for _ in range(24))])
    # Rows 15 to 24 are there, so the transitions that end in 16 to 24.
    rows = np.array([-(2**63), -1, 0, 3, 15, 16, 24, 25, 26, 2**63 - 1])
    got = RingReader(path).gather(rows)
    assert got.valid.tolist() == [False] * 5 + [True, True] + [False] * 3
    assert len(drop_overtaken(got).reward) == 2


def test_an_empty_ring_has_no_rows(path):
    ring = make_ring(path)
    view = RingReader(path)
    assert (view.rows_appended, view.live_rows(), view.transitions_appended) == (0, (0, 0), 0)
    assert ring.last_persisted() is None
    assert not view.gather(np.array([1, 2])).valid.any()


@pytest.mark.parametrize("moment", ["before the frames are copied", "after the frames are copied"])
def test_what_the_writer_overtakes_during_a_gather_is_reported(path, monkeypatch, moment):
    ring, bridge = make_ring(path, 20, 1.0), Bridge()
    append_all(ring, [bridge.start(), *(bridge.step() for _ in range(18))])
    view, rows = RingReader(path), np.array([1, 5, 10, 18])
    copy, meanwhile = reader.crop_stacks, [bridge.step() for _ in range(6)]

    def crop_stacks(*arguments):
        if moment.startswith("before"):
            append_all(ring, meanwhile)
            meanwhile.clear()
        copied = copy(*arguments)
        append_all(ring, meanwhile)
        meanwhile.clear()
        return copied

    monkeypatch.setattr(reader, "crop_stacks", crop_stacks)
    got = view.gather(rows)
    # 25 rows and frames, the last 20 are there: from 5 on. Row 5's predecessor and frames 2 to 4 are gone.
    assert got.valid.tolist() == [False, False, True, True]
    kept = drop_overtaken(got)
    assert_right(bridge, bridge.experiences, [10, 18], kept)
    assert drop_overtaken(view.gather(np.array([1, 2]))) is None


class Watched(np.ndarray):
    """An array that looks at the ring whenever something is stored in it."""

    def __setitem__(self, key, value):
        self.look()
        super().__setitem__(key, value)


@pytest.mark.parametrize("part", ["_frames", "_rows"])
def test_what_is_just_being_overwritten_is_not_valid(path, part):
    camera = part == "_frames"
    spec = task_spec(camera)
    ring, bridge = make_ring(path, 20, 1.0, spec), Bridge(camera=camera)
    append_all(ring, [bridge.start(), *(bridge.step() for _ in range(19))])
    view, seen = RingReader(path), []
    assert view.gather(np.array([1])).valid.all()
    watched = getattr(ring, part).view(Watched)
    watched.look = lambda: seen.append(view.gather(np.arange(1, 6)).valid.tolist())
    setattr(ring, part, watched)
    ring.append(bridge.step())
    # Row 20 goes where row 0 was, frame 20 where frame 0 was, and that is shown by rows 0 to 2.
    assert seen == [[False, False, False, True, True] if camera else [False, True, True, True, True]]


def test_whatever_a_concurrent_writer_does_valid_rows_are_right(path):
    ring, bridge = make_ring(path, 30, 1.0), Bridge()
    experiences = [bridge.start(), *(bridge.step(new=i % 3) for i in range(4000))]
    append_all(ring, experiences[:30])
    view, rng = RingReader(path), np.random.default_rng(0)
    view.gather(np.array([29]))  # numba compiles here, not while the writer runs
    writing = threading.Thread(target=append_all, args=(ring, experiences[30:]))
    writing.start()
    valid = invalid = 0
    while writing.is_alive():
        first, end = view.live_rows()
        rows = rng.integers(first, end, 8)
        got = view.gather(rows)
        kept = drop_overtaken(got)
        if kept is not None:
            assert_right(bridge, experiences, rows[got.valid], kept)
        valid, invalid = valid + got.valid.sum(), invalid + (~got.valid).sum()
    writing.join()
    assert valid > 0
    assert invalid > 0


def test_what_does_not_fit_the_task_is_refused_and_leaves_the_ring_as_it_was(path):
    ring, bridge = make_ring(path), Bridge()
    ring.append(bridge.start())
    bad = {
        "proprioception": np.zeros(1, np.float32),
        "action": np.zeros(3, np.float32),
        "frames": np.zeros((1, 2, 2, 3), np.uint8),
        "frame_ids": np.array([1, 2]),
        "episode": 2**64,
        "reward": 1e39,
    }
    good = bridge.step()
    for name, value in bad.items():
        with pytest.raises(MessageError):
            ring.append(replace(good, time_step=replace(good.time_step, **{name: value})))
    assert (ring.rows_appended, ring.frames_appended) == (1, 1)
    append_all(ring, [good, bridge.step()])
    assert_right(bridge, bridge.experiences, [1, 2], RingReader(path).gather(np.array([1, 2])).minibatch)


def test_nothing_is_stored_twice(path):
    ring, bridge = make_ring(path), Bridge()
    made = bridge.start()
    ring.append(made)
    with pytest.raises(RingError, match="already in the ring"):
        ring.append(made)
    assert ring.persisted_count == 1


def test_a_crop_outside_the_frame_is_refused(path):
    ring, bridge = make_ring(path), Bridge()
    append_all(ring, [bridge.start(), bridge.step()])
    for offset in [(-1, 0), (3, 0), (0, 5)]:
        with pytest.raises(ValueError, match="outside"):
            RingReader(path).gather(np.array([1]), (4, 4), offset)


def test_without_camera_there_are_no_frames_and_numba_is_not_imported(path):
    ring, bridge = make_ring(path, 10, spec=task_spec(camera=False)), Bridge(camera=False)
    append_all(ring, [bridge.start(), *(bridge.step() for _ in range(24))])
    assert every_pair(ring).tolist() == list(range(16, 25))
    ring.close()
    program = (
        "import sys, numpy as np\n"
        "from common.frame_ring import RingReader\n"
        "got = RingReader(sys.argv[1]).gather(np.array([16, 24]))\n"
        "assert got.valid.all() and got.minibatch.frames is got.minibatch.next_frames is None\n"
        "assert got.minibatch.reward.tolist() == [-8.0, -12.0]\n"
        "assert not {'numba', 'torch'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", program, path], check=True)
