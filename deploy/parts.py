"""The services' parts of a run's record, added up over the incarnations of each service."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common.record import read_parts, unreadable_parts
from common.topics import REPLAY, ROBOT_BRIDGE, SERVICES

Part = Mapping[str, Any]


@dataclass(frozen=True)
class RunParts:
    """All parts, oldest incarnation first."""

    parts: tuple[Part, ...]
    unreadable: tuple[tuple[str, int], ...] = ()
    """Service and incarnation of the parts that are empty or damaged: what depends on their counts is None."""

    @classmethod
    def read(cls, *record_dirs: Path) -> RunParts:
        """Return the parts that are there; a service that never got so far has none.

        Where several folders have a part of one incarnation, the one that was written last counts.
        """
        newest: dict[tuple[str, int], Part] = {}
        for part in (part for folder in record_dirs for part in read_parts(folder)):
            if part.get("service") in SERVICES:
                known = newest.get((part["service"], part["incarnation"]))
                if known is None or float(part.get("wall_s", 0.0)) > float(known.get("wall_s", 0.0)):
                    newest[part["service"], part["incarnation"]] = part
        unreadable = {_whose(path) for folder in record_dirs for path in unreadable_parts(folder)} - newest.keys()
        return cls(
            tuple(sorted(newest.values(), key=lambda part: int(part["incarnation"]))),
            tuple(sorted(whose for whose in unreadable if whose[0] in SERVICES)),
        )

    def of(self, service: str) -> list[Part]:
        """The parts of one service."""
        return [part for part in self.parts if part["service"] == service]

    def newest(self, service: str) -> Part | None:
        """The part of the newest incarnation."""
        return next(reversed(self.of(service)), None)

    def latest(self, service: str, counter: str) -> float | None:
        """A counter that goes on over incarnations: the newest one that was reported."""
        values = self._values(service, counter) if self.knows_newest(service) else []
        return values[-1] if values else None

    def greatest(self, service: str, counter: str) -> float | None:
        """A counter that never falls over incarnations."""
        return max(self._values(service, counter), default=None) if self.knows_newest(service) else None

    def total(self, service: str, counter: str) -> float | None:
        """A counter that begins anew with each incarnation."""
        values = self._values(service, counter) if self.knows_all(service) else []
        return sum(values) if values else None

    def knows_newest(self, service: str) -> bool:
        """False if the part of the service's newest incarnation is unreadable."""
        unreadable = max((incarnation for name, incarnation in self.unreadable if name == service), default=-1)
        newest = self.newest(service)
        return unreadable < (int(newest["incarnation"]) if newest else 0)

    def knows_all(self, service: str) -> bool:
        """False if the part of any of the service's incarnations is unreadable."""
        return all(name != service for name, _ in self.unreadable)

    def bytes_sent(self) -> dict[str, Counter[str]]:
        """Service -> topic -> payload bytes sent."""
        return self._bytes("bytes_sent")

    def bytes_received(self) -> dict[str, Counter[str]]:
        """Service -> topic -> payload bytes that arrived."""
        return self._bytes("bytes_received")

    def _bytes(self, name: str) -> dict[str, Counter[str]]:
        counts: dict[str, Counter[str]] = {service: Counter() for service in SERVICES}
        for part in self.parts:
            counts[part["service"]].update(part.get(name, {}))
        return counts

    def _values(self, service: str, counter: str) -> list[float]:
        counters = (part.get("counters", {}) for part in self.of(service))
        return [values[counter] for values in counters if values.get(counter) is not None]


def elapsed_s(parts: RunParts) -> float | None:
    """From the first start of the bridge to its last word, seconds; the time it was away included."""
    bridges = parts.of(ROBOT_BRIDGE)
    if not bridges or not parts.knows_all(ROBOT_BRIDGE):
        return None
    first, last = bridges[0], bridges[-1]
    between_s = (int(last["incarnation"]) - int(first["incarnation"])) / 1e9
    return round(between_s + float(last.get("wall_s", 0.0)), 3)


def produced(parts: RunParts) -> int | None:
    """TimeSteps published, over all incarnations of the bridge.

    The bridge's own count. Of one that was killed on another computer, only its last part is here, up to a second
    old: what replay knows to have existed is then more.
    """
    counts: Counter[str] = Counter()
    for part in parts.of(ROBOT_BRIDGE):
        counts[str(part["incarnation"])] = int(part.get("counters", {}).get("produced", 0))
    all_ended = all(part.get("state") == "stopped" for part in parts.of(ROBOT_BRIDGE))
    if not counts or not parts.knows_all(ROBOT_BRIDGE) or not (all_ended or parts.knows_all(REPLAY)):
        return None
    for part in parts.of(REPLAY):  # each knows only what it has seen itself
        for incarnation, seen in part.get("produced_seen", {}).items():
            counts[incarnation] = max(counts[incarnation], int(seen))
    return counts.total()


def persisted(parts: RunParts) -> int | None:
    """Distinct TimeSteps that replay has stored."""
    counts = newest_detail(parts, REPLAY, "persisted") if parts.knows_newest(REPLAY) else None
    if counts is None:
        # A run that was stopped before replay had opened its ring: of nothing, nothing was stored.
        return 0 if produced(parts) == 0 else None
    return sum(int(count) for count in counts.values())


def newest_detail(parts: RunParts, service: str, name: str) -> Any:
    """A detail as the newest incarnation that knows it says; None if none does."""
    return next((part[name] for part in reversed(parts.of(service)) if part.get(name) is not None), None)


def clock_jumps(parts: RunParts) -> dict[str, int]:
    """Service -> how often it saw the bridge's clock jump against its own; without those that never did."""
    counts: Counter[str] = Counter()
    for part in parts.parts:
        counts[part["service"]] += int(part.get("clock", {}).get("jumps", 0))
    return {service: count for service, count in counts.items() if count}


def service_notes(parts: RunParts) -> list[str]:
    """What the newest incarnations say of their end that is no failure."""
    newest = (parts.newest(service) for service in SERVICES)
    return [f"{part['service']} {part['note']}" for part in newest if part is not None and part.get("note")]


def service_failures(parts: RunParts) -> list[dict[str, Any]]:
    """Incarnations that failed, or never said that they had stopped, or whose word cannot be read."""
    unknown = "its part of the record is empty or damaged: its counts are unknown"
    failures: list[dict[str, Any]] = [
        {"service": service, "incarnation": incarnation, "failure": unknown}
        for service, incarnation in parts.unreadable
    ]
    for part in parts.parts:
        failure = part.get("failure")
        if failure is None and part.get("state") != "stopped":
            failure = f"last heard of as {part.get('state')!r}: killed, or still running"
        if failure is not None:
            failures.append({"service": part["service"], "incarnation": part["incarnation"], "failure": failure})
    return failures


def _whose(path: Path) -> tuple[str, int]:
    """Service and incarnation of the part in a file; of no service if the name does not tell."""
    service, _, incarnation = path.stem.partition("-")
    return (service, int(incarnation)) if incarnation.isdecimal() else ("", 0)
