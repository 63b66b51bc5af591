"""Stacks from frame ids: the rule, and what a loss, a late or a resent TimeStep does to it."""

from collections import deque
from dataclasses import dataclass

import numpy as np
import pytest

from common.errors import MessageError
from common.frame_stack import FrameStack, Stack


@dataclass(frozen=True)
class Step:
    seq: int
    step_index: int
    attempt: int = 0
    incarnation: int = 1


def add(stack: FrameStack[str], step: Step, *ids: int) -> Stack[str] | None:
    return stack.add(step, ids, [f"f{i}" for i in ids])


def whole(*ids: int) -> Stack[str]:
    return Stack(frames=tuple(f"f{i}" for i in ids), frame_ids=ids, whole=True)


def guess(*ids: int) -> Stack[str]:
    return Stack(frames=tuple(f"f{i}" for i in ids), frame_ids=ids, whole=False)


@pytest.fixture
def stack() -> FrameStack[str]:
    return FrameStack(3)


def test_the_first_frame_of_an_attempt_fills_the_stack_and_later_ones_push_it_out(stack):
    assert add(stack, Step(0, 0), 7) == whole(7, 7, 7)
    assert add(stack, Step(1, 1), 8) == whole(7, 7, 8)
    assert add(stack, Step(2, 2), 9, 10) == whole(8, 9, 10)


def test_no_new_frame_repeats_the_stack(stack):
    add(stack, Step(0, 0), 7)
    assert add(stack, Step(1, 1), 8) == whole(7, 7, 8)
    assert add(stack, Step(2, 2)) == whole(7, 7, 8)
    assert add(stack, Step(3, 3)) == whole(7, 7, 8)


def test_of_more_new_frames_than_the_stack_holds_the_newest_count(stack):
    add(stack, Step(0, 0), 0)
    assert add(stack, Step(1, 1), 1, 2, 3, 4, 5) == whole(3, 4, 5)


def test_an_attempt_that_starts_with_two_frames_repeats_the_first_of_them(stack):
    assert add(stack, Step(0, 0), 0, 1) == whole(0, 0, 1)


def test_an_attempt_never_shows_frames_of_the_one_before(stack):
    for i in range(4):
        add(stack, Step(i, i), i)
    assert add(stack, Step(4, 0, attempt=1), 4) == whole(4, 4, 4)
    assert add(stack, Step(5, 1, attempt=1), 5) == whole(4, 4, 5)


def test_an_attempt_that_starts_without_a_new_frame_repeats_the_newest(stack):
    for i in range(4):
        add(stack, Step(i, i), i)
    assert add(stack, Step(4, 0, attempt=1)) == whole(3, 3, 3)
    assert add(stack, Step(5, 1, attempt=1), 4) == whole(3, 3, 4)


def test_there_is_no_stack_before_the_first_frame(stack):
    assert add(stack, Step(0, 0)) is None
    # Whether frame 0 is the first of the attempt cannot be told from TimeSteps that brought none.
    assert add(stack, Step(1, 1), 0) == guess(0, 0, 0)


def test_lost_frames_are_stood_in_for_by_the_nearest_older_until_they_have_passed(stack):
    add(stack, Step(0, 0), 0)
    add(stack, Step(1, 1), 1)
    # TimeStep 2, which brought frames 2 and 3, is lost.
    assert add(stack, Step(3, 3), 4) == guess(1, 1, 4)
    assert add(stack, Step(4, 4), 5) == guess(1, 4, 5)
    assert add(stack, Step(5, 5), 6) == whole(4, 5, 6)


def test_a_lost_time_step_that_brought_no_frames_leaves_the_next_stack_whole(stack):
    add(stack, Step(0, 0), 0)
    add(stack, Step(1, 1), 1)
    assert add(stack, Step(3, 3), 2) == whole(0, 1, 2)


def test_without_new_frames_after_a_loss_the_stack_is_a_guess(stack):
    add(stack, Step(0, 0), 0)
    assert add(stack, Step(2, 2)) == guess(0, 0, 0)
    assert add(stack, Step(3, 3)) == guess(0, 0, 0)
    assert add(stack, Step(4, 4), 1) == whole(0, 0, 1)


def test_after_a_lost_start_an_attempt_is_whole_once_it_has_a_stack_of_its_own_frames(stack):
    for i in range(4):
        add(stack, Step(i, i), i)
    # TimeStep 4, the first of attempt 1, is lost.
    assert add(stack, Step(5, 1, attempt=1), 5) == guess(5, 5, 5)
    assert add(stack, Step(6, 2, attempt=1), 6) == guess(5, 5, 6)
    assert add(stack, Step(7, 3, attempt=1), 7) == whole(5, 6, 7)


def test_a_late_time_step_gets_its_own_stack_and_heals_the_later_ones(stack):
    add(stack, Step(0, 0), 0)
    add(stack, Step(1, 1), 1)
    assert add(stack, Step(3, 3), 3) == guess(1, 1, 3)
    assert add(stack, Step(2, 2), 2) == whole(0, 1, 2)
    assert add(stack, Step(4, 4), 4) == whole(2, 3, 4)


def test_a_late_time_step_never_shows_frames_that_came_after_it(stack):
    add(stack, Step(0, 0), 0)
    add(stack, Step(4, 1, attempt=1), 3)
    # Of attempt 1 only a frame is known that had not been taken then.
    assert add(stack, Step(3, 0, attempt=1)) is None


def test_a_late_start_tells_where_the_attempt_begins(stack):
    assert add(stack, Step(1, 1), 6) == guess(6, 6, 6)
    assert add(stack, Step(0, 0), 5) == whole(5, 5, 5)
    assert add(stack, Step(2, 2), 7) == whole(5, 6, 7)
    assert add(stack, Step(1, 1), 6) == whole(5, 5, 6)


def test_a_resent_time_step_changes_nothing(stack):
    add(stack, Step(0, 0), 0)
    assert add(stack, Step(1, 1), 1) == whole(0, 0, 1)
    assert add(stack, Step(1, 1), 1) == whole(0, 0, 1)
    assert add(stack, Step(2, 2), 2) == whole(0, 1, 2)


def test_another_incarnation_starts_from_nothing(stack):
    for i in range(3):
        add(stack, Step(i, i), i)
    assert add(stack, Step(3, 3, incarnation=2)) is None
    assert add(stack, Step(4, 0, attempt=1, incarnation=2), 0) == whole(0, 0, 0)


@pytest.mark.parametrize("size", [1, 2, 3, 5])
def test_stacks_equal_those_of_a_queue(size):
    rng = np.random.default_rng(size)
    stack, queue = FrameStack[str](size), deque(maxlen=size)
    frame_id, attempt, step_index = 0, -1, 0
    for seq in range(500):
        new = int(rng.integers(0, 4)) if seq else 1
        ids = list(range(frame_id, frame_id + new))
        frame_id += new
        if seq == 0 or rng.random() < 0.1:
            attempt, step_index = attempt + 1, 0
            first = ids[0] if ids else queue[-1]
            queue.extend([first] * size)
            queue.extend(ids[1:])
        else:
            step_index += 1
            queue.extend(ids)
        assert add(stack, Step(seq, step_index, attempt), *ids) == whole(*queue)


def test_whatever_is_lost_a_stack_called_whole_is_the_right_one():
    rng = np.random.default_rng(0)
    stack, queue = FrameStack[str](3), deque(maxlen=3)
    frame_id, attempt, step_index, counts = 0, -1, 0, {True: 0, False: 0}
    for seq in range(3000):
        new = int(rng.integers(0, 3)) if seq else 1
        ids = list(range(frame_id, frame_id + new))
        frame_id += new
        if seq == 0 or rng.random() < 0.05:
            attempt, step_index = attempt + 1, 0
            queue.extend([ids[0] if ids else queue[-1]] * 3)
            queue.extend(ids[1:])
        else:
            step_index += 1
            queue.extend(ids)
        if rng.random() < 0.15:
            continue
        got = add(stack, Step(seq, step_index, attempt), *ids)
        if got is None:
            continue
        counts[got.whole] += 1
        if got.whole:
            assert got == whole(*queue), seq
    assert min(counts.values()) > 500


def test_memory_is_bounded_and_keeps_the_newest():
    stack = FrameStack[str](3, memory=6)
    for i in range(1000):
        got = add(stack, Step(i, i), i)
    assert got == whole(997, 998, 999)
    assert add(stack, Step(2, 2), 2) is not None
    assert add(stack, Step(1000, 1000), 1000) == whole(998, 999, 1000)
    assert all(len(kept) <= 6 for kept in vars(stack).values() if isinstance(kept, dict))


@pytest.mark.parametrize(("ids", "frames"), [([0, 1], ["a"]), ([1, 1], ["a", "b"]), ([2, 1], ["a", "b"])])
def test_ids_that_do_not_fit_are_refused(stack, ids, frames):
    with pytest.raises(MessageError, match="TimeStep 4"):
        stack.add(Step(4, 4), ids, frames)


def test_a_stack_of_no_frames_is_refused():
    with pytest.raises(ValueError, match="stack_size"):
        FrameStack(0)
