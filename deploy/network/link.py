"""What a launcher needs from the network between two hosts on one machine, however it is made."""

from __future__ import annotations

from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

from deploy.network.conditions import Direction, Host
from deploy.network.part import NetworkPart

LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class Crossing:
    """Some service on ``from_host`` connects to ``port`` of a service on ``to_host``, another host."""

    from_host: Host
    to_host: Host
    port: int
    """TCP port that the service on ``to_host`` listens on."""

    def __post_init__(self) -> None:
        if self.from_host == self.to_host:
            raise ValueError(f"a crossing joins two hosts, and {self.port} stays on {self.from_host}")


class NetworkLink(Protocol):
    """The network between ``local`` and ``remote``; open from ``__enter__`` to ``__exit__``.

    Start a service with ``command_prefix(host) + command``, let it listen on ``listen_address(host)`` and
    connect to ``dial_address(...)``, and what crosses from host to host meets the network's conditions.
    Each port must be used by one service only, whatever its host.
    """

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def listen_address(self, host: Host) -> str:
        """The address that services on ``host`` listen on."""
        ...

    def dial_address(self, from_host: Host, to_host: Host, port: int) -> tuple[str, int]:
        """Address and port by which a service on ``from_host`` reaches ``port`` on ``to_host``."""
        ...

    def command_prefix(self, host: Host) -> list[str]:
        """What to put before a command so that it runs on ``host``. The command keeps its process id."""
        ...

    def kernel_bytes(self) -> dict[Direction, int] | None:
        """Bytes of IP packets that entered the link, counted by the kernel; None where it does not."""
        ...

    def part(self) -> NetworkPart | None:
        """The link's part of the record: about a second old while open, final after; None without a link."""
        ...

    def failure(self) -> str | None:
        """Why the open link carries nothing any more; None while all is well."""
        ...

    def over(self) -> str | None:
        """Why the run ends with the open link as it now is, all being well: a trace that stops; None if it goes on."""
        ...


class NoLink:
    """No emulated network: every host is this machine, and nothing delays anything."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def listen_address(self, host: Host) -> str:
        return LOOPBACK

    def dial_address(self, from_host: Host, to_host: Host, port: int) -> tuple[str, int]:
        return LOOPBACK, port

    def command_prefix(self, host: Host) -> list[str]:
        return []

    def kernel_bytes(self) -> dict[Direction, int] | None:
        return None

    def part(self) -> NetworkPart | None:
        return None

    def failure(self) -> str | None:
        return None

    def over(self) -> str | None:
        return None
