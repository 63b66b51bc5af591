"""The link's own part of a run's record: what entered it, what left it, and when it was silent."""

from __future__ import annotations

import dataclasses
import json
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

from deploy.network.conditions import DIRECTIONS, Direction, Host
from deploy.network.schedule import DropCause, OutageTimes


@dataclass
class DirectionCounts:
    """What happened to the traffic of one direction. A packet is a segment where the link is a TCP relay.

    What is neither delivered nor dropped is still on its way.
    """

    packets_in: int = 0
    bytes_in: int = 0
    packets_delivered: int = 0
    bytes_delivered: int = 0
    dropped: dict[str, int] = field(default_factory=lambda: {cause.value: 0 for cause in DropCause})
    """Packets that were not delivered, by cause."""
    retransmitted: int = 0
    """Segments that were lost once and came late for it; only a relay counts them."""
    max_queue_delay_ms: float = 0.0
    """Longest wait for a turn at the rate, ms."""
    max_late_ms: float = 0.0
    """Latest delivery after the scheduled time, ms: the fault of this machine, not of the conditions."""


@dataclass(frozen=True)
class DeviceBytes:
    """The kernel's counters of one host's end of the link, bytes of IP packets."""

    sent: int
    """What the host sent into the link."""
    received: int
    """What the link handed to the host."""


@dataclass(frozen=True)
class Outage:
    """A silence of the link, on ``CLOCK_MONOTONIC``."""

    start_monotonic_ns: int
    end_monotonic_ns: int


@dataclass(frozen=True)
class NetworkPart:
    """Everything the link knows about its run so far."""

    kind: str
    """``namespaces`` or ``netem`` (packets), or ``relay`` (TCP payload)."""
    start_monotonic_ns: int
    """When the link started: outages and schedules count from here."""
    written_monotonic_ns: int
    directions: dict[Direction, DirectionCounts]
    outages: list[Outage]
    """Those that began before the part was written; the last one may be under way."""
    kernel: dict[Host, DeviceBytes]
    """By host; empty where the kernel does not see the link as a device."""

    def to_json(self) -> str:
        return json.dumps(dataclasses.asdict(self), indent=1) + "\n"

    @classmethod
    def read(cls, path: Path) -> NetworkPart:
        """The part last written to ``path``."""
        document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return cls(
            kind=document["kind"],
            start_monotonic_ns=document["start_monotonic_ns"],
            written_monotonic_ns=document["written_monotonic_ns"],
            directions={name: DirectionCounts(**document["directions"][name]) for name in DIRECTIONS},
            outages=[Outage(**outage) for outage in document["outages"]],
            kernel={host: DeviceBytes(**counted) for host, counted in document["kernel"].items()},
        )


def outages_so_far(times: OutageTimes | None, start_ns: int, now_ns: int) -> list[Outage]:
    """The outages that have begun, with the end of the last one no later than ``now_ns``."""
    if times is None:
        return []
    return [
        Outage(start_ns + round(begin_s * 1e9), min(now_ns, start_ns + round(end_s * 1e9)))
        for begin_s, end_s in times.until((now_ns - start_ns) / 1e9)
    ]


class PartWriter:
    """Writes the part when it is entered, every ``period_s``, and a last time when it is left.

    In a thread of its own: a disk that hesitates must not hold up packets.
    """

    def __init__(self, path: Path, collect: Callable[[], NetworkPart], period_s: float = 1.0) -> None:
        self._path = path
        self._collect = collect
        self._period_s = period_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="part", daemon=True)

    def __enter__(self) -> PartWriter:
        self._write()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        self._write()

    def _run(self) -> None:
        while not self._stop.wait(self._period_s):
            self._write()

    def _write(self) -> None:
        scratch = self._path.with_name(self._path.name + ".new")
        scratch.write_text(self._collect().to_json(), encoding="utf-8")
        os.replace(scratch, self._path)
