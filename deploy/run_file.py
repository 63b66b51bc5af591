"""``RUN_DIR/run.toml``: what was run, where, over which network, with which versions."""

from __future__ import annotations

import platform
import subprocess
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import tomli_w

from common.errors import ConfigError
from common.record import write_atomically
from deploy.network import recorded_table

REPOSITORY = Path(__file__).resolve().parents[1]

IN_PROCESS = "in_process"
"""Mode of a run without processes, network and real time (``experiments.train``)."""

_DISTRIBUTIONS = (
    "dm-control",
    "eclipse-zenoh",
    "msgpack",
    "mujoco",
    "numba",
    "numpy",
    "opencv-python-headless",
    "torch",
)


@dataclass(frozen=True)
class RunFile:
    """The facts about a run that none of its services knows."""

    id: str
    mode: str
    task: str
    algorithm: str
    seed: int
    steps: int
    """Action cycles asked for."""
    pacing: str
    network: str
    """Name of the network's conditions; ``none`` if nothing crosses a network."""
    backend: str
    """How the network is emulated: ``namespaces``, ``netem``, ``relay`` or ``none``."""
    placement: dict[str, str]
    """Service -> host."""
    conditions: dict[str, Any] = field(default_factory=dict)
    """The network's ``[network]`` table; empty if nothing crosses one. On disk, rows of traces are files beside it."""
    versions: dict[str, str] = field(default_factory=dict)
    host_budget: str = ""
    """Name of the computer that the learner's stands for; empty: itself."""
    ended_early: str = ""
    """Why the run was told to end before it had made its steps; empty: it was not."""
    started: datetime = field(default_factory=lambda: datetime.now().astimezone().replace(microsecond=0))

    def write(self, run_dir: Path) -> None:
        """Write ``run_dir/run.toml``, and its network's traces beside it."""
        facts = dict(vars(self))
        tables = {name: facts.pop(name) for name in ("placement", "conditions", "versions")}
        tables["conditions"] = recorded_table(tables["conditions"], run_dir)
        document = {"run": facts, **_without_none(tables)}
        write_atomically(run_dir / "run.toml", tomli_w.dumps(document))

    @classmethod
    def read(cls, run_dir: Path) -> RunFile:
        """Return what :meth:`write` wrote.

        Raises:
            ConfigError: there is none, or it cannot be used.
        """
        path = run_dir / "run.toml"
        try:
            document = tomllib.loads(path.read_text(encoding="utf-8"))
            tables = {name: document.get(name, {}) for name in ("placement", "conditions", "versions")}
            return cls(**document["run"], **tables)
        except FileNotFoundError:
            raise ConfigError(f"{path} is missing") from None
        except OSError as error:
            raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
            raise ConfigError(f"{path}: cannot be used: {error}") from error


def versions() -> dict[str, str]:
    """Versions of this project, of Python and of the packages a run depends on, without importing them."""
    found = {"relod": _own_version(), "python": platform.python_version(), "linux": platform.release()}
    if commit := _commit():
        found["commit"] = commit
    for name in _DISTRIBUTIONS:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:  # the robot's computer may go without some
            found[name] = "not installed"
    return found


def _own_version() -> str:
    try:
        project: str = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    except (OSError, KeyError, tomllib.TOMLDecodeError):
        return "unknown"
    return project


def _commit() -> str:
    """The commit that runs, with ``-dirty`` if files have been changed since; empty outside of a checkout."""
    command = ["git", "-C", str(REPOSITORY), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        # A session of its own, so that Ctrl-C is left to the launcher.
        done = subprocess.run(command, capture_output=True, text=True, timeout=2, check=False, start_new_session=True)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def _without_none(value: Any) -> Any:
    """TOML has no null: leave those keys out."""
    if isinstance(value, Mapping):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    return value
