"""A mode: which service runs on which host. The services themselves never learn it."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from common.config import read_toml
from common.errors import ConfigError
from common.topics import SERVICES
from deploy.computers import checked_address
from deploy.network import HOSTS, Host

MODES = Path(__file__).resolve().parent / "modes"
"""Folder of the placement files that have a name."""


@dataclass(frozen=True)
class Placement:
    """A placement file."""

    mode: str
    """The file's name without ``.toml``."""
    host: Mapping[str, Host]
    """``[services]``: service -> host, for all four services."""
    addresses: Mapping[Host, str] = field(default_factory=dict)
    """``[endpoints]``: host -> IPv4 address of the computer that it is; may be empty."""

    def together(self, one: str, other: str) -> bool:
        """True if both services run on one host."""
        return self.host[one] == self.host[other]

    def services_on(self, host: Host) -> list[str]:
        """The services of one host, in the order of the ring."""
        return [service for service in SERVICES if self.host[service] == host]

    @property
    def spans_hosts(self) -> bool:
        """True if anything crosses the network."""
        return len(set(self.host.values())) > 1


def mode_names() -> list[str]:
    """Names of the modes in ``deploy/modes/``."""
    return sorted(path.stem for path in MODES.glob("*.toml"))


def load_placement(name_or_path: str) -> Placement:
    """Return the placement of a mode in ``deploy/modes/``, or of a placement file."""
    path = MODES / f"{name_or_path}.toml"
    if name_or_path not in mode_names():
        path = Path(name_or_path)
        if not path.is_file():
            raise ConfigError(
                f"mode {name_or_path!r}: expected one of {', '.join(mode_names())}, or the path of a placement file"
                f"{_suggestion(name_or_path, mode_names())}"
            )
    tables = read_toml(path)
    return Placement(path.stem, _checked_hosts(tables, str(path)), _checked_addresses(tables, str(path)))


def _checked_hosts(tables: Mapping[str, Any], where: str) -> dict[str, Host]:
    for name in tables:
        if name not in ("services", "endpoints"):
            raise ConfigError(f"{where}: unknown section [{name}]; expected [services] and, if you like, [endpoints]")
    services = tables.get("services", {})
    if not isinstance(services, Mapping):
        raise ConfigError(f"{where}: services = {services!r}: expected a table")
    for service, host in services.items():
        if service not in SERVICES:
            hint = _suggestion(service, SERVICES)
            raise ConfigError(f"{where}: unknown service {service!r}; expected {', '.join(SERVICES)}{hint}")
        if host not in HOSTS:
            raise ConfigError(f"{where}: {service} = {host!r}: expected one of {', '.join(HOSTS)}")
    missing = [service for service in SERVICES if service not in services]
    if missing:
        raise ConfigError(f"{where}: [services] names no host for {', '.join(missing)}")
    return {service: services[service] for service in SERVICES}


def _checked_addresses(tables: Mapping[str, Any], where: str) -> dict[Host, str]:
    endpoints = tables.get("endpoints", {})
    if not isinstance(endpoints, Mapping):
        raise ConfigError(f"{where}: endpoints = {endpoints!r}: expected a table")
    return {
        host: checked_address(host, address, f"{where}: [endpoints] {host} = {address!r}")
        for host, address in endpoints.items()
    }


def _suggestion(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(known), 1)
    return f"; did you mean {close[0]!r}?" if close else ""
