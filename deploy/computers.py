"""The hosts ``local`` and ``remote`` as two real computers, each with an address on a real network."""

from __future__ import annotations

import errno
import ipaddress
import socket
from collections.abc import Mapping
from typing import Any

from common.errors import ConfigError
from deploy.network import HOSTS, Host, NoLink


class TwoComputers(NoLink):
    """The network between the computers as it is: nothing is emulated, nothing is counted."""

    def __init__(self, addresses: Mapping[Host, str]) -> None:
        self._addresses = addresses

    def listen_address(self, host: Host) -> str:
        return self._addresses[host]

    def dial_address(self, from_host: Host, to_host: Host, port: int) -> tuple[str, int]:
        return self._addresses[to_host], port


def other_host(host: Host) -> Host:
    """Return the other one."""
    return HOSTS[1 - HOSTS.index(host)]


def checked_address(host: Any, address: Any, where: str) -> str:
    """Return an address that a computer can be reached at; ``where`` begins the error."""
    if host not in HOSTS:
        raise ConfigError(f"{where}: unknown host {host!r}; expected {' or '.join(HOSTS)}")
    try:
        parsed = ipaddress.IPv4Address(address) if isinstance(address, str) else None
    except ValueError:
        parsed = None
    if parsed is None or parsed.is_unspecified or parsed.is_multicast:
        raise ConfigError(
            f"{where}: expected the computer's IPv4 address, such as 192.168.1.10; `ip -4 address` shows it there"
        )
    return str(parsed)


def check_pair(addresses: Mapping[Host, str]) -> None:
    """Raise :class:`~common.errors.ConfigError` unless both hosts have addresses that can reach each other."""
    for host in HOSTS:
        if host not in addresses:
            raise ConfigError(
                f"no address for {host!r}: expected it in the mode file's [endpoints] or as --endpoint {host}=ADDRESS"
            )
    if len(set(addresses.values())) < len(HOSTS):
        raise ConfigError(
            f"endpoints local = remote = {addresses[HOSTS[0]]}: expected the addresses of two computers; to try both "
            "sides on one, give 127.0.0.1 and 127.0.0.2"
        )
    loopback = [host for host in HOSTS if ipaddress.IPv4Address(addresses[host]).is_loopback]
    if len(loopback) == 1:
        inner, outer = loopback[0], other_host(loopback[0])
        raise ConfigError(
            f"endpoints {inner} = {addresses[inner]} and {outer} = {addresses[outer]}: a computer is reached at a "
            f"loopback address only by itself; expected the address that {inner} has in the network of {outer}"
        )


def check_is_ours(host: Host, address: str) -> None:
    """Raise :class:`~common.errors.ConfigError` unless ``address`` is one of this computer's."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        try:
            probe.bind((address, 0))
        except OSError as error:
            if error.errno != errno.EADDRNOTAVAIL:
                raise
            raise ConfigError(
                f"endpoint {host} = {address}: not an address of this computer; is this the computer {host!r}? "
                "`ip -4 address` shows what it has"
            ) from error
