"""A run's record as it lies on the disk, on one computer or on two, read into one :class:`Record`."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from common.errors import ConfigError, RelodError, RingError
from common.record import settle_parts
from common.topics import ROBOT_BRIDGE
from deploy.action_age import ActionAges
from deploy.actions import ArrivedActions
from deploy.episodes import Episode, EpisodeTable
from deploy.mirror import OUTDATED, RING_COUNTS, read_ring_counts
from deploy.network import NetworkPart
from deploy.parts import RunParts
from deploy.record_folders import folder_with, record_folders
from deploy.run_file import RunFile

RING = "ring"
"""The experience ring's file in a run's folder."""


@dataclass(frozen=True)
class RingContent:
    """What the summary wants to know of the experience ring."""

    rows: int
    """Rows that were ever written: what stands in the ring now, and what it has replaced."""
    duplicated: int
    """Rows whose time step stands in an earlier row."""
    last_published_ns: int
    """When the newest time step in the ring was published; 0 if there is none."""


@dataclass
class Record:
    """Everything a run left behind; what is missing is None and has its warning."""

    parts: RunParts
    run: RunFile | None
    episodes: list[Episode]
    actions: ArrivedActions | None
    ages: ActionAges | None
    ring: RingContent | None
    network: NetworkPart | None
    is_outdated: bool = False
    """Of the other computer there are only copies, and its services may have gone on when those had been made."""
    warnings: list[str] = field(default_factory=list)


def read_record(*run_dirs: Path) -> Record:
    """Read a run's record; what killed services have left in memory is written into it first.

    Args:
        run_dirs: the run's folders, one for each computer. The copies of the other computer's files, where the
            launchers have made some, are read too.

    Raises:
        ConfigError: there is no such folder, or they are not of one run.
    """
    for run_dir in run_dirs:
        _check_folder(run_dir)
    warnings: list[str] = []

    def attempt(read: Callable[[], Any]) -> Any:
        try:
            return read()
        except (RelodError, OSError, ValueError, KeyError, TypeError) as error:
            warnings.append(str(error))
            return None

    for run_dir in run_dirs:
        attempt(lambda run_dir=run_dir: settle_parts(run_dir))  # type: ignore[misc]
    folders = record_folders(*run_dirs)
    _check_one_run(run_dirs)
    table = EpisodeTable(folder_with(folders, "episodes.csv"))
    attempt(table.update)
    actions = attempt(lambda: ArrivedActions.read(folder_with(folders, "actions.csv")))
    unreadable = table.unreadable + (actions.unreadable if actions else 0)
    if unreadable:
        warnings.append(f"{unreadable} rows of episodes.csv and actions.csv could not be read")
    run = attempt(lambda: RunFile.read(folder_with(run_dirs, "run.toml")))
    outdated = [folder for folder in folders if len(run_dirs) == 1 and (folder / OUTDATED).exists()]
    warnings += [
        f"the record of {folder.name} may not be complete here; when its services have ended, copy its run directory "
        f"to this computer: python -m deploy.summary {run_dirs[0]} ITS_COPY"
        for folder in outdated
    ]
    return Record(
        parts=_parts_of_one_run(RunParts.read(*folders), run, warnings),
        run=run,
        episodes=table.episodes,
        actions=actions,
        ages=_read_ages(folder_with(folders, "actions.csv")),
        ring=attempt(lambda: _read_ring_content([folder for folder in folders if folder not in outdated])),
        network=attempt(lambda: _read_network(folder_with(run_dirs, "network.json"))),
        is_outdated=bool(outdated),
        warnings=warnings,
    )


def _check_folder(run_dir: Path) -> None:
    if not run_dir.is_dir():
        raise ConfigError(f"{run_dir}: no such run directory")
    if not (run_dir / "run.toml").exists() and not (run_dir / "parts").is_dir():
        raise ConfigError(f"{run_dir}: expected a run's record, with run.toml or parts/; there is neither")


def _check_one_run(run_dirs: Sequence[Path]) -> None:
    """Folders whose run is not known are taken on trust."""
    ids: dict[str, Path] = {}
    for run_dir in run_dirs:
        with contextlib.suppress(ConfigError):
            ids.setdefault(RunFile.read(run_dir).id, run_dir)
    if len(ids) > 1:
        told = ", ".join(f"{run_dir} is of run {run_id}" for run_id, run_dir in ids.items())
        raise ConfigError(f"expected the folders of one run; {told}")


def _parts_of_one_run(parts: RunParts, run: RunFile | None, warnings: list[str]) -> RunParts:
    """Without the parts of other runs, which somebody has copied into the folder."""
    bridge = parts.newest(ROBOT_BRIDGE)
    expected = run.id if run else bridge.get("run") if bridge else None
    own = []
    for part in parts.parts:
        name = part.get("run", expected)
        if expected is None or name == expected:
            own.append(part)
        else:
            file = f"parts/{part['service']}-{part['incarnation']}.json"
            warnings.append(f"{file} is of run {name!r}, expected {expected!r}: left out")
    return replace(parts, parts=tuple(own))


def _read_ring_content(folders: Sequence[Path]) -> RingContent:
    folder = folder_with(folders, RING)
    if not (folder / RING).exists() and (counts := folder_with(folders, RING_COUNTS) / RING_COUNTS).exists():
        return RingContent(**read_ring_counts(counts))
    return read_ring(folder / RING)


def read_ring(path: Path) -> RingContent:
    """Count what stands twice in the experience ring.

    Raises:
        RingError: there is none, or it cannot be read.
    """
    import numpy as np

    from common.frame_ring import RingReader

    if not path.exists():
        raise RingError(f"{path} is missing")
    reader = RingReader(path)
    try:
        end = reader.rows_appended
        rows = reader.read_rows(np.arange(max(0, end - reader.layout.capacity_rows), end))
    finally:
        reader.close()
    identities = rows[["incarnation", "seq"]]
    newest_ns = int(rows["published_ns"].max()) if len(rows) else 0
    return RingContent(end, len(rows) - len(np.unique(identities)), newest_ns)


def _read_ages(run_dir: Path) -> ActionAges | None:
    try:
        return ActionAges.read(run_dir)
    except ConfigError:
        return None  # `python -m deploy.latency` says why; a run in which nothing was applied misses nothing


def _read_network(run_dir: Path) -> NetworkPart | None:
    path = run_dir / "network.json"
    # A run on one host has no network, and misses nothing.
    return NetworkPart.read(path) if path.exists() else None
