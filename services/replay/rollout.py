"""The on-policy store: what the newest policy has done, in order, each transition once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from common.frame_ring import RingView
from common.messages import Int64Array
from services.replay.store import ExperienceStore


class RolloutStore(ExperienceStore):
    """Collects the transitions that one policy version chose the actions of, until they are a rollout.

    The actor goes on while the learner updates. What an older version than the newest still does, and what a version
    does after its rollout is complete, is dropped and counted. Those transitions stay in the ring, for the record.
    """

    def __init__(self, ring: RingView, length: int, learner_version: Callable[[], int]) -> None:
        """Collect what is appended from now on; whether what is there has been learnt from, nobody knows.

        Args:
            ring: where the transitions are.
            length: transitions in a rollout.
            learner_version: the newest policy version that the learner has told of.
        """
        self._ring, self._length, self._learner_version = ring, length, learner_version
        self._version = 0
        """The newest policy version that acted."""
        self._rows: list[int] = []
        self._sent = False
        self._completed = self._dropped = 0

    @property
    def owed(self) -> float:
        """Transitions of a complete rollout that the learner has not yet answered with a new policy."""
        return float(self._length) if self._is_complete and self._learner_version() <= self._version else 0.0

    def note_row(self, row: int) -> None:
        """See :class:`ExperienceStore`."""
        (record,) = self._ring.read_rows(np.array([row], np.int64))
        if not (record["pair"] and record["has_extras"]):
            return  # No transition, or one in which the policy had no choice.
        version = int(record["policy_version"])
        # What the ring no longer holds cannot be learnt from: nobody would ever answer it with a new policy.
        if version > self._version or self._is_overtaken:
            self._begin(max(version, self._version))
        if version < self._version or self._is_complete:
            self._dropped += 1
            return
        self._rows.append(row)
        self._completed += self._is_complete

    def next_rows(self, *, again: bool) -> Int64Array | None:
        """See :class:`ExperienceStore`; the same rollout, if ``again``."""
        return np.array(self._rows, np.int64) if self._is_complete and (again or not self._sent) else None

    def note_sent(self, *, again: bool) -> None:
        """See :class:`ExperienceStore`."""
        self._sent = True

    def note_new_learner(self) -> None:
        """See :class:`ExperienceStore`: it gets the rollout that its predecessor has not answered."""
        self._sent = False

    def counters(self) -> dict[str, float]:
        """See :class:`ExperienceStore`."""
        return {
            "owed": self.owed,
            "rollouts": self._completed,
            "rollout_transitions": len(self._rows),
            "dropped_transitions": self._dropped,
        }

    @property
    def _is_complete(self) -> bool:
        return len(self._rows) == self._length

    @property
    def _is_overtaken(self) -> bool:
        return bool(self._rows) and not self._ring.valid_pairs(np.array(self._rows[:1], np.int64)).all()

    def _begin(self, version: int) -> None:
        if not (self._is_complete and self._sent):
            self._dropped += len(self._rows)
        self._version, self._rows, self._sent = version, [], False
