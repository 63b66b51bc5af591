"""Replay's end of the ring: creates the file and appends experiences."""

from __future__ import annotations

import mmap
import os
from dataclasses import dataclass, fields

import numpy as np

from common.errors import MessageError, RingError
from common.frame_ring import layout
from common.frame_ring.file import create_ring_file, lock_ring_file
from common.frame_ring.layout import RANGE_DTYPE, SOURCES, Records, RingLayout
from common.frame_ring.persisted import PersistedRanges
from common.frame_ring.reader import read_layout
from common.frame_ring.view import RingView
from common.frame_stack import FrameStack, Stack
from common.messages import ActionSource, Experience, Float32Array, TaskSpec, TimeStep
from common.pending_actions import PendingActions, observed_spec

_STOP = SOURCES.index(ActionSource.STOP)
FRAME_MEMORY = 256
"""Frames remembered for building stacks: how late an experience may come and still get a whole stack."""

LARGEST_REAL = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class _StoredStep:
    """A row's identity, for :class:`FrameStack`."""

    incarnation: int
    seq: int
    attempt: int
    step_index: int


class RingWriter(RingView):
    """The only writer of a ring; construct with :meth:`create_or_reopen`.

    A process killed inside :meth:`append` leaves a ring that reopens without the unfinished row. (A computer that
    loses power may leave rows appended since the last :meth:`flush` in any condition.)
    """

    def __init__(self, sizes: RingLayout, mapped: mmap.mmap, file_descriptor: int, pending_actions: int = 0) -> None:
        """Go on writing a mapped ring; takes over the file descriptor, whose lock it keeps until closed."""
        super().__init__(sizes, mapped)
        self._file_descriptor = file_descriptor
        table: Records = np.frombuffer(mapped, RANGE_DTYPE, count=layout.PERSISTED_RANGES, offset=sizes.ranges_offset)
        self._persisted = PersistedRanges(table)
        self._scratch: Records = np.zeros(1, sizes.row_dtype)
        self._stack = FrameStack[int](sizes.frame_stack, FRAME_MEMORY) if sizes.frame_stack else None
        self._sensed_size = sizes.proprioception_size - pending_actions * sizes.action_size
        self._pending = PendingActions(pending_actions, sizes.action_size) if pending_actions else None
        # A frame whose writing was cut off has spoilt its slot: its number is skipped, never used again.
        self._counters[layout.FRAMES_DONE] = self._counters[layout.FRAMES_BEGUN]
        self._recount()

    @classmethod
    def create_or_reopen(
        cls,
        path: str | os.PathLike[str],
        spec: TaskSpec,
        capacity_rows: int,
        frames_per_row: float = 1.25,
        pending_actions: int = 0,
    ) -> RingWriter:
        """Open the ring at ``path``, which is created if it is not there.

        Args:
            path: the ring's file; its directory must exist.
            spec: task whose experiences it holds.
            capacity_rows: experiences before the oldest is overwritten.
            frames_per_row: camera frames reserved for each row.
            pending_actions: of an observation (:mod:`common.pending_actions`); a row's proprioception ends with them.

        Raises:
            RingError: no room on the disk, a ring of another layout, another writer, or no access.
        """
        name = os.fspath(path)
        wanted = RingLayout.of_task(observed_spec(spec, pending_actions), capacity_rows, frames_per_row)
        try:
            if not os.path.exists(name):
                create_ring_file(name, wanted)
            descriptor = os.open(name, os.O_RDWR | os.O_CLOEXEC)
        except OSError as error:
            raise RingError(f"{name}: cannot open the experience ring: {error.strerror}") from error
        try:
            lock_ring_file(name, descriptor)
            sizes = read_layout(name, descriptor)
            if sizes != wanted:
                raise RingError(
                    f"{name}: an experience ring of another layout: {sizes.differences(wanted)}; "
                    "choose another run directory or restore the settings it was made with"
                )
            return cls(sizes, mmap.mmap(descriptor, sizes.file_bytes), descriptor, pending_actions)
        except BaseException:
            os.close(descriptor)
            raise

    @property
    def persisted_count(self) -> int:
        """Experiences persisted since the ring's creation, overwritten ones included."""
        return self.rows_appended

    def contains(self, incarnation: int, seq: int) -> bool:
        """True if the TimeStep ``seq`` of a bridge incarnation was ever appended."""
        return self._persisted.contains(incarnation, seq)

    def persisted_counts(self) -> dict[int, int]:
        """Return how many TimeSteps of each bridge incarnation were ever appended."""
        return self._persisted.counts()

    def persisted_ranges(self, incarnation: int) -> list[tuple[int, int]]:
        """Return the half-open ranges of ``seq`` appended of a bridge incarnation, ascending."""
        return self._persisted.ranges(incarnation)

    def last_persisted(self) -> tuple[int, int] | None:
        """Return (bridge incarnation, seq) of the last appended experience."""
        if not self.rows_appended:
            return None
        last = self._row(self.rows_appended - 1)
        return int(last["incarnation"]), int(last["seq"])

    def append(self, experience: Experience) -> int:
        """Store an experience and return its row number.

        Raises:
            RingError: it is already there; ask :meth:`contains` first.
            MessageError: its sizes are not the task's, or a number is out of range. Nothing is stored.
        """
        step = experience.time_step
        if self.contains(step.incarnation, step.seq):
            raise RingError(f"TimeStep {step.seq} of incarnation {step.incarnation} is already in the ring")
        self._check(experience)
        self._fill_values(experience)
        # What is wrong was refused before the stack remembers the frames: those it remembers will be stored.
        number, first_frame = self.rows_appended, self.frames_appended
        # Of more than S new frames, only the last S are in any stack.
        new = min(len(step.frame_ids), self.layout.frame_stack)
        stack = None
        if self._stack is not None:
            ids = step.frame_ids[len(step.frame_ids) - new :]
            stack = self._stack.add(step, ids, range(first_frame, first_frame + new))
        self._fill_stack(stack, new)
        self._fill_relation(step)

        counters = self._counters
        counters[layout.ROWS_BEGUN] = number + 1
        counters[layout.FRAMES_BEGUN] = first_frame + new
        for at, frame in enumerate(step.pixels[len(step.pixels) - new :], start=first_frame):
            self._frames[at % self.layout.capacity_frames] = frame
        self._rows[number % self.layout.capacity_rows] = self._scratch[0]
        counters[layout.FRAMES_DONE] = first_frame + new
        counters[layout.ROWS_DONE] = number + 1
        self._persisted.add(step.incarnation, step.seq)
        return number

    def flush(self) -> None:
        """Write everything to the disk; may take long."""
        self._mapped.flush()

    def close(self) -> None:
        """Unmap and unlock. What was appended outlives the process without a flush; only a power cut needs one."""
        del self._persisted
        super().close()
        os.close(self._file_descriptor)

    def _last_row(self) -> np.void | None:
        return self._row(self.rows_appended - 1) if self.rows_appended else None

    def _row(self, number: int) -> np.void:
        row: np.void = self._rows[number % self.layout.capacity_rows]
        return row

    def _check(self, experience: Experience) -> None:
        sizes, step, extras = self.layout, experience.time_step, experience.extras
        arrays = [
            ("proprioception", step.proprioception, (self._sensed_size,)),
            ("action", step.action, (sizes.action_size,)),
        ]
        if extras:
            arrays.append(("chosen_action", extras.chosen_action, (sizes.action_size,)))
        for name, array, shape in arrays:
            if array.shape != shape:
                raise MessageError(f"Experience.{name}: expected shape {shape}, got {array.shape}")
        if sizes.frame_stack and step.pixels.shape != (len(step.frame_ids), *sizes.frame_shape):
            raise MessageError(
                f"Experience.frames: expected {len(step.frame_ids)} frames of {sizes.frame_shape}, "
                f"got shape {step.pixels.shape}"
            )

    def _fill_values(self, experience: Experience) -> None:
        """Compose the row in scratch memory: what is wrong with it shows before anything is overwritten."""
        step, extras, row = experience.time_step, experience.extras, self._scratch[0]
        try:
            row["incarnation"], row["seq"] = step.incarnation, step.seq
            row["episode"], row["attempt"], row["step_index"] = step.episode, step.attempt, step.step_index
            row["actor_incarnation"] = experience.actor_incarnation
            row["action_applied_ns"], row["published_ns"] = step.action_applied_ns, step.published_ns
            row["policy_version"] = extras.policy_version if extras else 0
        except OverflowError as error:
            raise MessageError(f"TimeStep {step.seq}: a number does not fit 64 bits: {error}") from error
        reals = {"reward": step.reward, "log_probability": extras.log_probability if extras else 0.0}
        for name, value in reals.items():
            if not abs(value) <= LARGEST_REAL:  # nan too
                raise MessageError(f"TimeStep {step.seq}: {name} {value} is no finite 32-bit number")
            row[name] = value
        row["proprioception"], row["action"] = self._observe(experience), step.action
        row["action_source"] = SOURCES.index(step.action_source)
        row["terminated"], row["truncated"] = step.terminated, step.truncated
        row["has_extras"] = extras is not None
        row["chosen_action"] = extras.chosen_action if extras else 0.0

    def _observe(self, experience: Experience) -> Float32Array:
        """The proprioception as the policy saw it."""
        step, extras = experience.time_step, experience.extras
        if self._pending is None:
            return step.proprioception
        chosen = extras.chosen_action if extras else None
        self._pending.note(step.incarnation, experience.actor_incarnation, step.seq - 1, chosen)
        return self._pending.observe(step, step.proprioception)

    def _fill_stack(self, stack: Stack[int] | None, new: int) -> None:
        """Enter the row's frames in scratch memory."""
        row, before, frames_end = self._scratch[0], self._last_row(), self.frames_appended + new
        bound = before["oldest_frame_bound"] if before is not None else 0
        oldest = min(stack.frames) if stack else frames_end
        row["stack"] = stack.frames if stack else -1
        row["frame_ids"] = stack.frame_ids if stack else -1
        row["oldest_frame"] = oldest
        row["oldest_frame_bound"] = max(bound, oldest) if stack else bound
        row["new_frames"] = new
        row["whole"] = self._stack is None or (stack is not None and stack.whole)

    def _fill_relation(self, step: TimeStep) -> None:
        """Complete the row in scratch memory: what it is to those before."""
        row, before = self._scratch[0], self._last_row()
        if self._pending:
            row["whole"] &= self._pending.is_certain(step)
        row["pair"] = before is not None and self._continues(before, row)
        row["transitions"] = row["pair"] + (before["transitions"] if before is not None else 0)

    def _continues(self, before: np.void, row: np.void) -> bool:
        """True if ``row`` is the experience right after ``before`` in its attempt and both observations are whole."""
        return bool(
            row["whole"]
            and before["whole"]
            and row["seq"] == before["seq"] + 1
            and row["step_index"] == before["step_index"] + 1
            and all(row[name] == before[name] for name in ("incarnation", "episode", "attempt"))
            and not (before["terminated"] or before["truncated"])
            # A stop is no action: what it does to the robot cannot be learnt as the effect of one.
            and row["action_source"] != _STOP
            # With pending actions it is the choice that is learnt from; without one, nothing depended on the policy.
            and (self._pending is None or row["has_extras"])
        )

    def _recount(self) -> None:
        """Take up where the last writer was: what is persisted, the frames of the stack, and what was chosen."""
        end = self.rows_appended
        if end:  # the last one may have been stored but not yet entered into the table
            self._persisted.add(int(self._row(end - 1)["incarnation"]), int(self._row(end - 1)["seq"]))
        first, _ = self.live_rows()
        for number in range(max(first, end - FRAME_MEMORY), end):
            row = self._row(number)
            step = _StoredStep(*(int(row[field.name]) for field in fields(_StoredStep)))
            if self._stack is not None:
                known = self.layout.frame_stack - int(row["new_frames"])
                self._stack.add(step, row["frame_ids"][known:], [int(n) for n in row["stack"][known:]])
            if self._pending is not None:
                chosen = row["chosen_action"].copy() if row["has_extras"] else None
                self._pending.note(step.incarnation, int(row["actor_incarnation"]), step.seq - 1, chosen)
