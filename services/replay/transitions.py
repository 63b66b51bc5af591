"""The off-policy store: random transitions of all that the ring holds, as many as the replay ratio allows."""

from __future__ import annotations

import numpy as np

from common.algorithms.config import OffPolicyConfig
from common.frame_ring import RingWriter
from common.messages import Int64Array
from services.replay.sampler import TransitionSampler, UpdateBudget
from services.replay.store import ExperienceStore


class TransitionStore(ExperienceStore):
    """Draws from the ring within the update budget."""

    def __init__(self, ring: RingWriter, config: OffPolicyConfig, max_surplus: float, rng: np.random.Generator) -> None:
        """Draw from ``ring``; what is in it earns nothing. See :class:`UpdateBudget`, :class:`TransitionSampler`."""
        self._ring, self._batch_size = ring, config.batch_size
        self._counted = ring.transitions_appended
        self._budget = UpdateBudget(config.replay_ratio, config.min_size_to_sample, max_surplus, self._counted)
        self._sampler = TransitionSampler(rng)

    @property
    def owed(self) -> float:
        """Updates earned and not spent."""
        return self._budget.owed

    def note_row(self, row: int) -> None:
        """See :class:`ExperienceStore`."""
        transitions = self._ring.transitions_appended
        self._budget.add(transitions - self._counted)
        self._counted = transitions

    def next_rows(self, *, again: bool) -> Int64Array | None:
        """See :class:`ExperienceStore`; others than before, if ``again``."""
        return self._sampler.sample(self._ring, self._batch_size) if self._budget.owed >= 1.0 else None

    def note_sent(self, *, again: bool) -> None:
        """See :class:`ExperienceStore`; what replaces a lost minibatch has been paid for."""
        if not again:
            self._budget.spend()

    def note_new_learner(self) -> None:
        """See :class:`ExperienceStore`: nothing that was sent is missed."""
        return

    def counters(self) -> dict[str, float]:
        """See :class:`ExperienceStore`."""
        return {"owed": self.owed}
