"""The ring's observations end with the pending actions, or are not called whole."""

from dataclasses import replace

import numpy as np
import pytest

from common import codec
from common.errors import RingError
from common.frame_ring import RingReader, RingWriter, array_minibatch, minibatch_from_arrays
from common.messages import ArrayMinibatch
from common.pending_actions import observed_spec
from tests.common.ring_cases import Bridge, task_spec
from tests.common.test_frame_ring import append_all, every_pair

SPEC = task_spec()
COUNT = 3


@pytest.fixture
def path(tmp_path):
    return tmp_path / "ring"


def make_ring(path, capacity_rows=64, spec=SPEC, count=COUNT):
    return RingWriter.create_or_reopen(path, spec, capacity_rows, pending_actions=count)


def chosen(seq):
    """What Bridge lets the policy choose on the TimeStep ``seq``: twice the action that led into the next one."""
    return [2 * (seq + 1) / 1024, -2 * (seq + 1) / 1024]


def pending(*seqs):
    """Pending actions that answer these TimeSteps; None: zeros."""
    return np.array([[0, 0] if seq is None else chosen(seq) for seq in seqs], np.float32).reshape(-1)


def one_attempt(bridge, count):
    return [bridge.start(), *(bridge.step() for _ in range(count - 1))]


def without_extras(experience):
    """The same, where the TimeStep before was not answered."""
    return replace(experience, extras=None)


def test_two_transitions_by_hand(path):
    ring = make_ring(path)
    append_all(ring, one_attempt(Bridge(incarnation=9), 5))
    got = RingReader(path).gather(np.array([1, 4]))
    assert got.valid.all()
    # Bridge's own proprioception is the number of the TimeStep, and of the incarnation.
    expected = [[0, 9, *pending(None, None, None)], [3, 9, *pending(2, 1, 0)]]
    np.testing.assert_array_equal(got.minibatch.proprioception, np.array(expected, np.float32))
    expected = [[1, 9, *pending(0, None, None)], [4, 9, *pending(3, 2, 1)]]
    np.testing.assert_array_equal(got.minibatch.next_proprioception, np.array(expected, np.float32))
    np.testing.assert_array_equal(got.minibatch.chosen_action, np.array([chosen(0), chosen(3)], np.float32))


def test_an_attempt_begins_without_pending_actions_whatever_came_before(path):
    ring, bridge = make_ring(path), Bridge()
    first = [*one_attempt(bridge, 4), bridge.step(truncated=True)]
    append_all(ring, [*first, *one_attempt(bridge, 3)])
    rows = ring.read_rows(np.array([4, 5, 6, 7]))["proprioception"][:, 2:]
    expected = [pending(3, 2, 1), pending(None, None, None), pending(5, None, None), pending(6, 5, None)]
    np.testing.assert_array_equal(rows, expected)
    assert every_pair(ring).tolist() == [1, 2, 3, 4, 6, 7]


def test_a_time_step_without_an_answer_is_zeros_and_what_follows_it_no_transition(path):
    ring = make_ring(path)
    experiences = one_attempt(Bridge(), 7)
    experiences[3] = without_extras(experiences[3])
    append_all(ring, experiences)
    rows = ring.read_rows(np.arange(3, 7))["proprioception"][:, 2:]
    np.testing.assert_array_equal(
        rows, [pending(None, 1, 0), pending(3, None, 1), pending(4, 3, None), pending(5, 4, 3)]
    )
    assert every_pair(ring).tolist() == [1, 2, 4, 5, 6]


def test_an_answer_that_came_late_and_was_never_applied_is_pending_all_the_same(path):
    ring = make_ring(path)
    experiences = one_attempt(Bridge(), 4)
    # All three cycles went by with the command that was in force before.
    held = [
        replace(e, time_step=replace(e.time_step, action=np.zeros(2, np.float32), answered_seq=-1)) for e in experiences
    ]
    append_all(ring, held)
    np.testing.assert_array_equal(ring.read_rows(np.array([3]))["proprioception"][0, 2:], pending(2, 1, 0))


def test_after_a_lost_experience_there_is_no_transition_until_all_pending_actions_are_known(path):
    ring = make_ring(path)
    experiences = one_attempt(Bridge(), 10)
    del experiences[4]
    append_all(ring, experiences)
    # Number 4 alone told what was chosen on number 3. Numbers 5 and 6 would have ended with it; row n is number n + 1.
    assert ring.read_rows(np.arange(4, 9))["whole"].tolist() == [0, 0, 1, 1, 1]
    assert every_pair(ring).tolist() == [1, 2, 3, 7, 8]
    rows = ring.read_rows(np.array([6]))["proprioception"][:, 2:]
    np.testing.assert_array_equal(rows, [pending(6, 5, 4)])


def test_after_an_actor_s_restart_the_choices_of_the_one_before_are_not_ascribed_to_it(path):
    ring = make_ring(path)
    experiences = one_attempt(Bridge(), 9)
    # The new actor has not answered number 3, and nobody knows what it chose before.
    restarted = [replace(e, actor_incarnation=6) for e in experiences[4:]]
    append_all(ring, [*experiences[:4], without_extras(restarted[0]), *restarted[1:]])
    rows = ring.read_rows(np.arange(4, 8))
    np.testing.assert_array_equal(
        rows["proprioception"][:, 2:],
        [pending(None, None, None), pending(4, None, None), pending(5, 4, None), pending(6, 5, 4)],
    )
    assert rows["whole"].tolist() == [0, 0, 1, 1]


def reference(experiences, row):
    """Pending actions by looking back through all experiences."""
    seqs = []
    for back in range(COUNT):
        at = row - back
        seqs.append(None if experiences[row].time_step.step_index <= back else experiences[at].time_step.seq - 1)
    return pending(*seqs)


@pytest.mark.parametrize("camera", [True, False])
def test_through_several_wraps_all_observations_equal_a_naive_reference(path, camera):
    ring, bridge = make_ring(path, 20, task_spec(camera=camera)), Bridge(camera=camera)
    view, rng = RingReader(path), np.random.default_rng(1)
    checked = 0
    for _ in range(12):
        append_all(ring, bridge.wander(rng, 9, most_new=1))
        rows = every_pair(view)
        gathered = view.gather(rows)
        assert gathered.valid.all()
        for at, row in enumerate(rows):
            np.testing.assert_array_equal(
                gathered.minibatch.proprioception[at, 2:], reference(bridge.experiences, row - 1)
            )
            np.testing.assert_array_equal(
                gathered.minibatch.next_proprioception[at, 2:], reference(bridge.experiences, row)
            )
            checked += 1
        steps = [e.time_step for e in bridge.experiences]
        first, end = view.live_rows()
        assert rows.tolist() == [row for row in range(first + 1, end) if steps[row].step_index > 0]
    assert checked > 100


@pytest.mark.parametrize("camera", [True, False])
def test_a_writer_that_is_restarted_goes_on_with_what_was_chosen(path, camera):
    spec = task_spec(camera=camera)
    experiences = one_attempt(Bridge(camera=camera), 8)
    experiences[2] = without_extras(experiences[2])
    whole, restarted = path.with_name("whole"), path
    append_all(make_ring(whole, spec=spec), experiences)
    for experience in experiences:
        ring = make_ring(restarted, spec=spec)
        ring.append(experience)
        ring.close()
    one, other = (RingReader(p).read_rows(np.arange(8)) for p in (whole, restarted))
    np.testing.assert_array_equal(one, other)
    assert one["pair"].tolist() == [0, 1, 0, 1, 1, 1, 1, 1]


def test_arrays_and_map_give_the_same_minibatch(path):
    ring = make_ring(path)
    append_all(ring, Bridge().wander(np.random.default_rng(0), 50))
    rows = every_pair(ring)
    size = observed_spec(SPEC, COUNT).dimensions
    parts = [codec.decode(codec.encode(p), ArrayMinibatch, size) for p in array_minibatch(ring, rows, 5, 9)]
    received, mapped = minibatch_from_arrays(parts), RingReader(path).gather(rows).minibatch
    for name, array in vars(mapped).items():
        np.testing.assert_array_equal(array, getattr(received, name), strict=True)


def test_a_ring_of_another_count_is_refused(path):
    make_ring(path).close()
    with pytest.raises(RingError, match=r"another layout: proprioception_size 8 \(wanted 6\)"):
        make_ring(path, count=2)


def test_without_pending_actions_the_ring_is_that_of_the_task_and_what_was_not_answered_is_a_transition(path):
    ring = make_ring(path, count=0)
    assert ring.layout.proprioception_size == 2
    append_all(ring, [without_extras(experience) for experience in one_attempt(Bridge(), 4)])
    assert every_pair(ring).tolist() == [1, 2, 3]
