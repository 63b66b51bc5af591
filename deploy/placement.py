"""A mode: which service runs on which host. The services themselves never learn it."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common.config import read_toml
from common.errors import ConfigError
from common.topics import SERVICES
from deploy.network import HOSTS, Host

MODES = Path(__file__).resolve().parent / "modes"
"""Folder of the placement files that have a name."""


@dataclass(frozen=True)
class Placement:
    """The ``[services]`` table of a placement file."""

    mode: str
    """The file's name without ``.toml``."""
    host: Mapping[str, Host]
    """Service -> host, for all four services."""

    def together(self, one: str, other: str) -> bool:
        """True if both services run on one host."""
        return self.host[one] == self.host[other]

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
    return Placement(path.stem, _checked_hosts(read_toml(path), str(path)))


def _checked_hosts(tables: Mapping[str, Any], where: str) -> dict[str, Host]:
    for name in tables:
        if name != "services":
            raise ConfigError(f"{where}: unknown section [{name}]; expected only [services]")
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


def _suggestion(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(known), 1)
    return f"; did you mean {close[0]!r}?" if close else ""
