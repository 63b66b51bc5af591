"""``actions.csv``: how long answers took, and how soon they came again after an outage of the network.

All times are on the bridge's monotonic clock, which is also the emulated network's.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.messages import Int64Array
from deploy.network.part import NetworkPart


@dataclass(frozen=True)
class ArrivedActions:
    """One row per TimeStep that was answered, whether its first answer could still be applied or not."""

    published_ns: Int64Array
    """(n,) when the TimeStep that the action answers was published."""
    arrived_ns: Int64Array
    """(n,) when the action arrived."""
    unreadable: int
    """Rows that were no rows."""

    @classmethod
    def read(cls, run_dir: Path) -> ArrivedActions | None:
        """Return the table of a run; None if it has none."""
        published, arrived, unreadable = [], [], 0
        try:
            with (run_dir / "actions.csv").open(encoding="utf-8", errors="replace", newline="") as file:
                for row in csv.DictReader(file):
                    try:
                        pair = int(row["published_ns"]), int(row["arrived_ns"])
                    except (KeyError, TypeError, ValueError):
                        unreadable += 1
                    else:
                        published.append(pair[0])
                        arrived.append(pair[1])
        except FileNotFoundError:
            return None
        return cls(np.array(published, np.int64), np.array(arrived, np.int64), unreadable)

    def observation_to_action_ms(self) -> dict[str, float] | None:
        """Median and 99th percentile from publication to arrival; None without actions."""
        if not len(self.arrived_ns):
            return None
        p50, p99 = np.percentile((self.arrived_ns - self.published_ns) / 1e6, [50, 99])
        return {"p50": round(float(p50), 3), "p99": round(float(p99), 3)}

    def first_after(self, link_up_ns: int) -> int | None:
        """When the first action arrived that answers an observation taken at ``link_up_ns`` or later."""
        fresh = self.arrived_ns[self.published_ns >= link_up_ns]
        return int(fresh.min()) if len(fresh) else None


@dataclass(frozen=True)
class OutageEnd:
    """The end of an outage."""

    end_s: float
    """Link up again, seconds since the link started."""
    first_action_s: float | None
    """From then until an action arrived that answers an observation taken after it; None: the run ended first."""

    def to_table(self) -> dict[str, float | None]:
        """As in ``summary.json``."""
        return {"end_s": self.end_s, "first_action_s": self.first_action_s}


def outage_ends(actions: ArrivedActions, network: NetworkPart, last_published_ns: int) -> list[OutageEnd]:
    """The outages that ended while the run was going on.

    Args:
        actions: of the run.
        network: the link's part of the record.
        last_published_ns: when the run's last known TimeStep was published.
    """
    if not len(actions.published_ns):
        return []
    first_published_ns = int(actions.published_ns.min())
    ends = []
    for outage in network.outages:
        up_ns = outage.end_monotonic_ns
        if first_published_ns <= up_ns < last_published_ns:
            arrived_ns = actions.first_after(up_ns)
            ends.append(
                OutageEnd(
                    end_s=_seconds(up_ns - network.start_monotonic_ns),
                    first_action_s=None if arrived_ns is None else _seconds(arrived_ns - up_ns),
                )
            )
    return ends


def last_published_ns(actions: ArrivedActions, persisted_ns: int) -> int:
    """The newest publication that is known of: answered by an action, or of what was persisted; 0 if none is."""
    return max(int(actions.published_ns.max()) if len(actions.published_ns) else 0, persisted_ns)


def _seconds(nanoseconds: int) -> float:
    return round(nanoseconds / 1e9, 4)
