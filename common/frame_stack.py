"""The one rule that turns new camera frames into the stack of an observation; used by actor and replay.

A camera has its own rate, so a TimeStep brings 0, 1, 2 or more new frames, each with an id: consecutive within an
attempt, rising within a bridge incarnation. The stack of a TimeStep is its newest frame and the S - 1 before it; ids
before the first frame of the attempt are replaced by that first frame. The rule is stated on ids alone, so resent, late
and lost TimeSteps change nothing but which frames are there.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Generic, Protocol, TypeVar

from common.errors import MessageError

Frame = TypeVar("Frame")
"""An array in the actor, an absolute frame number in the ring."""


class StepIdentity(Protocol):
    """What tells TimeSteps apart; a :class:`common.messages.TimeStep` has it all."""

    @property
    def incarnation(self) -> int: ...
    @property
    def seq(self) -> int: ...
    @property
    def attempt(self) -> int: ...
    @property
    def step_index(self) -> int: ...


@dataclass(frozen=True)
class Stack(Generic[Frame]):
    """The frames of one observation, newest last."""

    frames: tuple[Frame, ...]
    """S frames."""
    frame_ids: tuple[int, ...]
    """S ids of ``frames``, in the same order."""
    whole: bool
    """True if these are the frames the rule asks for; False if lost ones are stood in for by others."""


class FrameStack(Generic[Frame]):
    """Remembers recent frames of one bridge incarnation and builds each TimeStep's stack from them."""

    def __init__(self, stack_size: int, memory: int = 16) -> None:
        """Args:
        stack_size: S, frames in a stack, at least 1.
        memory: frames (and TimeSteps, and attempts) remembered; how late a TimeStep may be and still be of use.
        """
        if stack_size < 1:
            raise ValueError(f"stack_size: expected at least 1, got {stack_size}")
        self._stack_size = stack_size
        self._memory = max(memory, 2 * stack_size)
        self._incarnation: int | None = None
        self._forget()

    def _forget(self) -> None:
        self._frames: dict[int, Frame] = {}
        self._newest_as_of: dict[int, int] = {}  # TimeStep seq -> id of the newest frame then
        self._oldest_of: dict[int, int] = {}  # attempt -> lowest id known to belong to it
        self._started: dict[int, bool] = {}  # attempts whose first TimeStep came: their lowest id is their first

    def add(self, step: StepIdentity, frame_ids: Iterable[int], frames: Sequence[Frame]) -> Stack[Frame] | None:
        """Take over a TimeStep's new frames and return its stack; None while no frame at all is known.

        After a loss the stack is a best effort: a missing frame is replaced by the nearest older one of the attempt,
        or else by its oldest one there is. A TimeStep may come late or twice; the stack is the one *it* asks for.

        Raises:
            MessageError: the numbers of ids and frames differ, or ids do not increase.
        """
        ids = list(map(int, frame_ids))
        if len(ids) != len(frames):
            raise MessageError(f"TimeStep {step.seq}: {len(ids)} frame ids for {len(frames)} frames")
        if len(ids) > 1 and any(b <= a for a, b in pairwise(ids)):
            raise MessageError(f"TimeStep {step.seq}: frame ids do not increase: {ids}")
        if step.incarnation != self._incarnation:
            self._incarnation = step.incarnation
            self._forget()
        self._frames.update(zip(ids, frames, strict=True))

        newest, certain = self._newest(step, ids)
        if newest is None:
            return None
        is_first = step.step_index == 0 and certain
        if ids or is_first:
            lowest = ids[0] if ids else newest
            self._oldest_of[step.attempt] = min(lowest, self._oldest_of.get(step.attempt, lowest))
        if is_first:
            self._started[step.attempt] = True
        stack = self._build(step.attempt, newest, certain)
        self._trim()
        return stack

    def _newest(self, step: StepIdentity, ids: list[int]) -> tuple[int | None, bool]:
        """Return the id of the newest frame as of this TimeStep, and whether that is certain."""
        newest = ids[-1] if ids else self._newest_as_of.get(step.seq - 1)
        if newest is not None:
            self._newest_as_of[step.seq] = newest
            return newest, True
        # The TimeStep before is missing and may have brought frames: the newest of those before it has to do.
        earlier = [seq for seq in self._newest_as_of if seq < step.seq]
        return (self._newest_as_of[max(earlier)] if earlier else None), False

    def _build(self, attempt: int, newest: int, certain: bool) -> Stack[Frame] | None:
        lowest = self._oldest_of.get(attempt, newest)
        if newest < lowest:
            return None  # All frames known of the attempt came after this TimeStep.
        wanted = list(range(newest - self._stack_size + 1, newest + 1))
        # Where the attempt's first TimeStep is missing, ids below the lowest one seen may belong to it or not.
        known = certain and (attempt in self._started or wanted[0] >= lowest)
        if wanted[0] < lowest:
            wanted = [max(i, lowest) for i in wanted]
        found = wanted if self._frames.keys() >= set(wanted) else self._nearest(wanted, lowest, newest)
        if not found:
            return None
        return Stack(
            frames=tuple(map(self._frames.__getitem__, found)),
            frame_ids=tuple(found),
            whole=known and found == wanted,
        )

    def _nearest(self, wanted: list[int], lowest: int, newest: int) -> list[int]:
        """Return for each wanted id the next older one there is, or else the oldest; nothing if there is none."""
        available = sorted(i for i in self._frames if lowest <= i <= newest)
        return [available[max(bisect_right(available, i) - 1, 0)] for i in wanted] if available else []

    def _trim(self) -> None:
        for remembered in (self._frames, self._newest_as_of, self._oldest_of, self._started):
            # By number, not by age: late frames must not push out the newest ones.
            while len(remembered) > self._memory:
                del remembered[min(remembered)]
