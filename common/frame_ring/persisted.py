"""Which time steps are persisted, as ranges: so that a resent one is neither lost nor counted twice."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

from common.frame_ring.layout import Records


@dataclass
class _Range:
    first: int
    end: int
    slot: int


class PersistedRanges:
    """Set of (bridge incarnation, seq), kept in a table of ``RANGE_DTYPE`` in the ring's file.

    Every change of the table ends with one 8-byte store, and until then the slots' union is the set as it was: a
    process killed at any moment leaves a table that is right.
    """

    def __init__(self, table: Records) -> None:
        """Take over a table, e.g. of zeros, which it then keeps up to date."""
        self._table = table
        self._lengths = table["length"]
        self._ranges: dict[int, list[_Range]] = {}
        self._free = [slot for slot in range(len(table)) if table[slot]["length"] <= 0]
        self._free.reverse()
        for slot in (slot for slot in range(len(table)) if table[slot]["length"] > 0):
            first, length = int(table[slot]["first"]), int(table[slot]["length"])
            entry = _Range(first, first + length, slot)
            self._ranges.setdefault(int(table[slot]["incarnation"]), []).append(entry)
        for incarnation, ranges in self._ranges.items():
            self._ranges[incarnation] = self._without_covered(ranges)

    def contains(self, incarnation: int, seq: int) -> bool:
        """True if that time step is persisted."""
        ranges = self._ranges.get(incarnation, [])
        at = bisect_right(ranges, seq, key=lambda r: r.first) - 1
        return at >= 0 and seq < ranges[at].end

    def counts(self) -> dict[int, int]:
        """Return how many time steps of each incarnation are persisted."""
        return {incarnation: sum(r.end - r.first for r in ranges) for incarnation, ranges in self._ranges.items()}

    def ranges(self, incarnation: int) -> list[tuple[int, int]]:
        """Return the persisted half-open ranges of an incarnation, ascending."""
        return [(r.first, r.end) for r in self._ranges.get(incarnation, [])]

    def add(self, incarnation: int, seq: int) -> None:
        """Add a time step; nothing happens if it is there already."""
        if self.contains(incarnation, seq):
            return
        ranges = self._ranges.setdefault(incarnation, [])
        at = bisect_right(ranges, seq, key=lambda r: r.first)
        before = ranges[at - 1] if at > 0 and ranges[at - 1].end == seq else None
        after = ranges[at] if at < len(ranges) and ranges[at].first == seq + 1 else None
        if not (before or self._free):
            self._drop_oldest()
            self.add(incarnation, seq)  # from the start: what was dropped may be a neighbour
            return
        end = after.end if after else seq + 1
        if before:
            before.end = end
            self._lengths[before.slot] = end - before.first
        else:
            ranges.insert(at, self._new_range(incarnation, seq, end))
        if after:  # only now: its numbers are covered by the other slot
            ranges.remove(after)
            self._release(after.slot)

    def _new_range(self, incarnation: int, first: int, end: int) -> _Range:
        slot = self._free.pop()
        self._table["incarnation"][slot] = incarnation
        self._table["first"][slot] = first
        self._lengths[slot] = end - first
        return _Range(first, end, slot)

    def _drop_oldest(self) -> None:
        """Forget the oldest range: thousands of gaps later nobody resends what lies there."""
        incarnation = min(i for i, ranges in self._ranges.items() if ranges)
        self._release(self._ranges[incarnation].pop(0).slot)
        if not self._ranges[incarnation]:
            del self._ranges[incarnation]

    def _release(self, slot: int) -> None:
        self._lengths[slot] = 0
        self._free.append(slot)

    def _without_covered(self, ranges: list[_Range]) -> list[_Range]:
        """Return sorted ranges, less those that a process killed inside :meth:`add` left covered by another."""
        kept: list[_Range] = []
        for entry in sorted(ranges, key=lambda r: (r.first, -r.end)):
            if kept and entry.end <= kept[-1].end:
                self._release(entry.slot)
            else:
                kept.append(entry)
        return kept
