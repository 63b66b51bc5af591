"""What of the ring the learner gets, and when: what every store promises to replay."""

from __future__ import annotations

from abc import ABC, abstractmethod

from common.messages import Int64Array


class ExperienceStore(ABC):
    """Follows what is appended to the ring, and names the transitions of the next minibatch."""

    @property
    @abstractmethod
    def owed(self) -> float:
        """What the learner has still to do before more experience is of use; in lockstep the actor waits for it."""

    @abstractmethod
    def note_row(self, row: int) -> None:
        """A row was appended to the ring."""

    @abstractmethod
    def next_rows(self, *, again: bool) -> Int64Array | None:
        """Return (B,) numbers of transitions' second rows; None while there is nothing for the learner.

        Args:
            again: True if they replace a minibatch that was lost on its way.
        """

    @abstractmethod
    def note_sent(self, *, again: bool) -> None:
        """What :meth:`next_rows` returned for the same ``again`` is on its way to the learner."""

    @abstractmethod
    def note_new_learner(self) -> None:
        """What was sent went to another learner, which is gone."""

    @abstractmethod
    def counters(self) -> dict[str, float]:
        """Counts for the heartbeat and the record."""
