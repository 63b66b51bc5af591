"""Where a run's files are: in its run directory or, of a run on two computers, among those of the other one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from common.errors import ConfigError
from deploy.mirror import HOSTS_FOLDER
from deploy.run_file import RunFile


def record_folders(*run_dirs: Path) -> list[Path]:
    """Return the run directories, then the copies of the other computer's files in them."""
    return [*run_dirs, *(path for run_dir in run_dirs for path in sorted(run_dir.glob(f"{HOSTS_FOLDER}/*/")))]


def folder_with(folders: Sequence[Path], name: str) -> Path:
    """Return the first folder that has the file; the first of all if none does."""
    return next((folder for folder in folders if (folder / name).exists()), folders[0])


def find_file(run_dir: Path, name: str, service: str, otherwise: str) -> Path:
    """Return the run's file ``name``, which is there where ``service`` ran.

    Raises:
        ConfigError: there is none; tells the computer that has it, or ``otherwise`` if that should be this one.
    """
    path = folder_with(record_folders(run_dir), name) / name
    if path.exists():
        return path
    host = _other_host_of(run_dir, service)
    if host is None:
        raise ConfigError(f"{path} is missing: {otherwise}")
    raise ConfigError(
        f"{path} is missing: the {service} ran on the computer {host!r}; copy the file from the run directory there"
    )


def _other_host_of(run_dir: Path, service: str) -> str | None:
    """Return the host of a service that did not run on this computer; None if it did, or nobody knows."""
    configurations = run_dir / "config"
    # Each side's launcher writes the configurations of its own services.
    if not configurations.is_dir() or (configurations / f"{service}.toml").exists():
        return None
    try:
        return RunFile.read(run_dir).placement.get(service)
    except ConfigError:  # of a run that was put together by hand
        return None
