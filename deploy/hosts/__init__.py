"""Computers that a learner may run on: what each allows, so that one machine can stand for all of them.

A host's values become plain settings of the services (:mod:`deploy.plan`); no service knows that it is held back.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path

from common.config import build_section, read_toml, setting
from common.errors import ConfigError
from services.learner.config import check_device_name

HOSTS_FOLDER = Path(__file__).resolve().parent
"""Folder of the hosts that have a name."""


@dataclass(frozen=True)
class Host:
    """The ``[host]`` table of a host file; the comments in the files say where the numbers come from."""

    name: str = setting()
    """The file's name without ``.toml``, unless it says another."""
    device: str = setting()
    """Where updates run: ``cpu``, ``cuda`` or ``cuda:N``."""
    threads: int = setting(low=0, high=256)
    """Threads of an update; 0 leaves one core to the rest."""
    inference_s: float = setting(low=0.0, high=10.0)
    """Least time from an observation to its action, if the actor runs on this computer, seconds."""
    updates_per_step: float = setting(low=1e-6, high=1000.0)
    """Updates that the computer manages per action cycle, at most."""
    replay_capacity: int = setting(low=2, high=1_000_000_000)
    """Transitions that fit its memory."""

    def __post_init__(self) -> None:
        check_device_name(self.device)


def host_names() -> list[str]:
    """Names of the hosts in ``deploy/hosts/``."""
    return sorted(path.stem for path in HOSTS_FOLDER.glob("*.toml"))


def load_host(name_or_file: str | Path) -> Host:
    """Return a host of ``deploy/hosts/`` by its name, or that of a host file.

    Raises:
        ConfigError: there is no such host, or its file has a value that cannot be used.
    """
    name = str(name_or_file)
    path = HOSTS_FOLDER / f"{name}.toml"
    if name not in host_names():
        path = Path(name)
        if not path.is_file():
            close = difflib.get_close_matches(name, host_names(), 1)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            raise ConfigError(
                f"host {name!r}: expected one of {', '.join(host_names())}, or the path of a host file{hint}"
            )
    tables = read_toml(path)
    for section in tables:
        if section != "host":
            raise ConfigError(f"{path}: unknown section [{section}]; expected only [host]")
    table = tables.get("host", {})
    if not isinstance(table, dict):  # a key of that name, and no section
        raise ConfigError(f"{path}: host = {table!r}: expected a table")
    return build_section(Host, {"name": path.stem, **table}, f"{path}: [host]")
