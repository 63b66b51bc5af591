"""The fallback without privileges: both hosts share loopback, and a TCP relay stands between them."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Self

from common.errors import ConfigError
from deploy.network.conditions import Direction, Host, NetworkConditions
from deploy.network.errors import LinkFailedError
from deploy.network.link import LOOPBACK, Crossing
from deploy.network.link_process import LinkProcess
from deploy.network.part import NetworkPart


class RelayLink:
    """A relay port for every crossing; what is dialled directly meets no conditions.

    TCP cannot lose bytes, so a loss is emulated by its delay, and congestion control never sees it: see
    :mod:`deploy.network.relay`.
    """

    def __init__(
        self, conditions: NetworkConditions, run_dir: Path, crossings: Iterable[Crossing], seed: int = 0
    ) -> None:
        self._conditions = conditions
        self._process = LinkProcess("deploy.network.relay", conditions, run_dir, seed)
        # Sorted and without repetitions: two services that dial the same port share a relay port.
        self._crossings = sorted(set(crossings), key=dataclasses.astuple)
        self._relay_ports: dict[Crossing, int] = {}

    def __enter__(self) -> Self:
        if name := self._conditions.congestion_control:
            raise ConfigError(
                f"network.congestion_control = {name!r}: the relay's TCP runs over loopback and has no use for it; "
                "expected '', or namespaces as the backend"
            )
        try:
            ready = self._process.start(
                ["--crossings", json.dumps([dataclasses.asdict(crossing) for crossing in self._crossings])]
            )
        except BaseException:
            self._process.stop()
            raise
        self._relay_ports = dict(zip(self._crossings, ready["ports"], strict=True))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.stop()

    def listen_address(self, host: Host) -> str:
        return LOOPBACK

    def dial_address(self, from_host: Host, to_host: Host, port: int) -> tuple[str, int]:
        if from_host == to_host:
            return LOOPBACK, port
        crossing = Crossing(from_host, to_host, port)
        if crossing not in self._relay_ports:
            raise LinkFailedError(f"{crossing} was not among the crossings this relay was opened with")
        return LOOPBACK, self._relay_ports[crossing]

    def command_prefix(self, host: Host) -> list[str]:
        return []

    def kernel_bytes(self) -> dict[Direction, int] | None:
        return None

    def part(self) -> NetworkPart:
        return self._process.part()

    def failure(self) -> str | None:
        return self._process.failure()

    def over(self) -> str | None:
        return self._process.over()
