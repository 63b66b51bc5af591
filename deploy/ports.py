"""Free TCP ports for a run's services."""

from __future__ import annotations

import contextlib
import errno
import socket
from collections.abc import Iterator, Sequence

from common.errors import ConfigError
from deploy.network.link import LOOPBACK

DEFAULT_BASE_PORT = 7450
_LAST_PORT = 65535
_TRIED_RANGES = 200


@contextlib.contextmanager
def reserved_ports(count: int, base: int | None = None) -> Iterator[range]:
    """Reserve ``count`` consecutive ports among this machine's launchers while the ``with`` block lasts.

    With ``base`` exactly those from ``base`` on, or an error; without, the first free ones from
    :data:`DEFAULT_BASE_PORT` on.
    """
    if base is not None:
        check_base_port(base, count)
    with contextlib.ExitStack() as stack:
        reason = ""
        for attempt in range(1 if base is not None else _TRIED_RANGES):
            first = (DEFAULT_BASE_PORT if base is None else base) + attempt * count
            ports = range(first, first + count)
            reason = _occupied(ports) or _claim(stack, ports)
            if not reason:
                yield ports
                return
        hint = "choose another --base-port" if base is not None else "choose free ones with --base-port"
        raise ConfigError(f"ports {ports[0]} to {ports[-1]} are not free: {reason}; {hint}")


@contextlib.contextmanager
def held_ports(ports: Sequence[int], address: str) -> Iterator[None]:
    """Reserve exactly these ports of an address of this computer while the ``with`` block lasts."""
    with contextlib.ExitStack() as stack:
        if reason := _occupied(ports, address) or _claim(stack, ports):
            raise ConfigError(f"{reason}; choose another --base-port, on both computers")
        yield


def check_base_port(base: int, count: int) -> None:
    """Raise :class:`~common.errors.ConfigError` unless there are ``count`` ports from ``base`` on."""
    if not 1 <= base <= _LAST_PORT + 1 - count:
        raise ConfigError(f"--base-port {base}: expected a port from 1 to {_LAST_PORT + 1 - count}")


def _occupied(ports: Sequence[int], address: str = LOOPBACK) -> str:
    """Which of the ports cannot be listened on; empty if all can."""
    for port in ports:
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address, port))
            except OSError as error:
                in_use = error.errno == errno.EADDRINUSE
                return f"another process listens on {port}" if in_use else f"{port}: {error.strerror}"
    return ""


def _claim(stack: contextlib.ExitStack, ports: Sequence[int]) -> str:
    """Claim the ports against launchers that start at the same moment; empty if it worked.

    The services bind their ports seconds from now. Until then a name in the kernel's abstract socket namespace
    stands for each: it cannot be taken twice, and is gone with this process, however it ends.
    """
    with contextlib.ExitStack() as claims:
        for port in ports:
            claim = claims.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
            try:
                claim.bind(f"\0relod-port-{port}")
            except OSError:
                return f"another launcher is about to use {port}"
        stack.enter_context(claims.pop_all())
    return ""
