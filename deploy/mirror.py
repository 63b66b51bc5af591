"""A copy of the other computer's part of a run's record, in ``RUN_DIR/hosts/HOST/``: the small files, kept up to date.

With it, either side shows the whole run's progress and makes its summary, though no directory is shared.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from common.record import write_atomically

CHUNK_BYTES = 256 * 1024
"""Largest piece of a file in one message: a second at 2 Mbit/s."""
HOSTS_FOLDER = "hosts"
RING_COUNTS = "ring.json"
"""What the summary wants to know of the experience ring, which itself is too large to be copied."""
BRIDGE_CONFIGURATION = "config/robot_bridge.toml"
"""What an evaluation of the policy, on the computer that has learnt it, wants to know of the task."""
OUTDATED = "outdated"
"""Says, in the folder of copies, that the services there went on when nobody copied any more."""

_TABLES = ("episodes.csv", "actions.csv")
"""They only grow, but for columns that are new."""
_SINGLE = (*_TABLES, RING_COUNTS, BRIDGE_CONFIGURATION)
_NAMES = re.compile(r"parts/(robot_bridge|actor|replay|learner)-\d{1,20}\.json", re.ASCII)

Fetch = Callable[[str, int], bytes | None]
"""(name, offset) -> the file's next piece; empty at its end; None if there was no answer."""


def is_shared(name: str) -> bool:
    """True for the files that the other computer may read here, and that are taken from there."""
    return name in _SINGLE or _NAMES.fullmatch(name) is not None


def shared_files(run_dir: Path) -> dict[str, int]:
    """Return what there is for the other computer: name -> bytes."""
    paths = [run_dir / name for name in _SINGLE] + sorted(run_dir.glob("parts/*.json"))
    found = {}
    for path in paths:
        name = path.relative_to(run_dir).as_posix()
        if is_shared(name) and path.is_file():
            found[name] = path.stat().st_size
    return found


def read_piece(run_dir: Path, name: str, offset: int) -> bytes:
    """Return the piece of a shared file that begins at ``offset``; empty at its end, or where there is no such file."""
    if not is_shared(name) or offset < 0:
        return b""
    try:
        with (run_dir / name).open("rb") as file:
            file.seek(offset)
            return file.read(CHUNK_BYTES)
    except FileNotFoundError:
        return b""


class Mirror:
    """The copy, on this computer."""

    def __init__(self, folder: Path, fetch: Fetch) -> None:
        self.folder = folder
        self._fetch = fetch

    def update(self, files: Mapping[str, int], *, whole: bool = False) -> bool:
        """Bring the copy up to date with ``files`` of the other computer; True if that was possible.

        Args:
            files: name -> bytes, as :func:`shared_files` says there.
            whole: fetch tables from their beginning, for the last time; otherwise only what has been added.
        """
        return all(self._update(name, size, whole) for name, size in files.items() if is_shared(name))

    def note_outdated(self) -> None:
        """Services may have gone on there since the last copy."""
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / OUTDATED).touch()

    def _update(self, name: str, size: int, whole: bool) -> bool:
        path = self.folder / name
        has = path.stat().st_size if path.exists() else 0
        grows = name in _TABLES and not whole and has <= size
        if has == size and (grows or (name == BRIDGE_CONFIGURATION and not whole)):
            return True
        content = self._read(name, has if grows else 0)
        if content is None:
            return False
        path.parent.mkdir(parents=True, exist_ok=True)
        if grows:
            with path.open("ab") as file:
                file.write(content)
        else:
            write_atomically(path, content.decode("utf-8", "replace"))
        return True

    def _read(self, name: str, offset: int) -> bytes | None:
        content = b""
        while True:
            piece = self._fetch(name, offset + len(content))
            if piece is None:
                return None
            content += piece
            if len(piece) < CHUNK_BYTES:
                return content


def write_ring_counts(run_dir: Path, rows: int, duplicated: int, last_published_ns: int) -> None:
    """Leave what the other computer's summary wants to know of the ring."""
    counts = {"rows": rows, "duplicated": duplicated, "last_published_ns": last_published_ns}
    write_atomically(run_dir / RING_COUNTS, json.dumps(counts) + "\n")


def read_ring_counts(path: Path) -> dict[str, Any]:
    """Return what :func:`write_ring_counts` wrote."""
    counts = json.loads(path.read_text(encoding="utf-8"))
    return {name: int(counts[name]) for name in ("rows", "duplicated", "last_published_ns")}
