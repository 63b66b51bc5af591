"""The sections that several services' configuration files share."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from common.config import setting
from common.errors import ConfigError

_NAME = re.compile(r"[A-Za-z0-9_.-]+")


@dataclass(frozen=True)
class RunSettings:
    """``[run]``: which run this service belongs to."""

    id: str = setting()
    """Name of the run: the second part of every key expression. All services of a run share it."""
    directory: str = setting()
    """Folder of the run's record, ``RUN_DIR``."""
    robot: str = setting("robot0")
    """Name of the robot: the third part of every key expression."""
    seed: int = setting(0, low=0, high=2**31 - 1)
    """Seed of the task, the initial networks and the updates. What a restart must not repeat (exploration, sampling)
    is seeded with the service's start time as well."""

    def __post_init__(self) -> None:
        for name in ("id", "robot"):
            if not _NAME.fullmatch(getattr(self, name)):
                raise ConfigError(f"{name} = {getattr(self, name)!r}: expected letters, digits, '_', '-' or '.'")


@dataclass(frozen=True)
class TransportSettings:
    """``[transport]``: where this service listens, and which of its peers it connects to.

    The services form a full mesh; of each pair one side connects, so a run's files name every pair once. Endpoints
    are ``tcp/ADDRESS:PORT``, one per lane, because bulk data must not delay real-time data on its connection.
    """

    listen_real_time: str = setting()
    listen_bulk: str = setting()
    connect_real_time: list[str] = setting([])
    connect_bulk: list[str] = setting([])
    socket_buffer_kib: int = setting(0, low=0, high=65536)
    """Send buffer of a connection, KiB; 0 leaves it to the system. A small one keeps old data out of the kernel."""
    shared_memory: bool = setting(False)
    """Zenoh's shared memory; only where all services are on one host, for it would bypass an emulated network."""


@dataclass(frozen=True)
class ClockSettings:
    """``[clock]``: makes this service's clock another one than its computer's, to try on one computer what two are.

    Not for the bridge on an emulated network, whose outages are recorded by the computer's own clock.
    """

    offset_s: float = setting(0.0, low=0.0, high=1e6)
    """How much later it shows, seconds."""
    drift_ppm: float = setting(0.0, low=-500.0, high=500.0)
    """How much faster it goes, microseconds per second."""


@dataclass(frozen=True)
class AlgorithmSettings:
    """``[algorithm]``: what learns. Other keys of the section override the preset's, e.g. ``batch_size = 64``."""

    name: str = setting("sac")
    preset: str = setting("")
    """A preset of the algorithm; empty takes the one the task asks for."""
    overrides: dict[str, Any] = setting(rest=True)


@dataclass(frozen=True)
class JournalSettings:
    """Settings of a numbered stream's sender."""

    journal_s: float = setting(60.0, low=1.0, high=3600.0)
    """Unacknowledged messages older than this are given up (and counted as lost), seconds."""
    journal_mib: int = setting(512, low=1, high=65536)
    """Memory that unacknowledged messages may take, MiB; the oldest are given up first."""
    resend_kib_per_s: float = setting(8192.0, low=1.0)
    """Fastest pace at which gaps are resent, KiB/s: the most that repairs may take of the network link."""
