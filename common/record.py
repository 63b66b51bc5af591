"""A service's part of the run's record, written by a thread of its own: the disk never delays anyone.

``RUN_DIR/`` afterwards holds, from this file, ``parts/SERVICE-INCARNATION.json`` (the service's counts, replaced
about once a second; a killed service leaves its last ones, and those of :mod:`common.surviving_counts`),
``metrics/SERVICE.csv``, ``tensorboard/SERVICE/`` and the tables a service adds rows to.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import logging
import os
import queue
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from common.surviving_counts import settle, with_surviving_counts

logger = logging.getLogger(__name__)

_QUEUE_LENGTH = 20_000


def write_atomically(path: Path, content: str | bytes) -> None:
    """Replace ``path`` in one step: a reader sees the old content or the new one, never a piece.

    Raises:
        OSError: it cannot be written; nothing is left of the attempt, which may have filled the disk.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)
        temporary.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


def read_parts(directory: Path, service: str = "*") -> list[dict[str, Any]]:
    """All parts of a run's record but those of :func:`unreadable_parts`, oldest incarnation first."""
    parts, _ = _read_parts(directory, service)
    return [with_surviving_counts(parts[path]) for path in sorted(parts, key=lambda path: parts[path]["incarnation"])]


def unreadable_parts(directory: Path, service: str = "*") -> list[Path]:
    """Parts that are empty or damaged, as a computer leaves them that loses its power while they are written."""
    _, unreadable = _read_parts(directory, service)
    return sorted(unreadable)


def settle_parts(directory: Path) -> None:
    """Write what killed services have left in memory into their parts, where a restart of the computer keeps it."""
    parts, _ = _read_parts(directory, "*")
    for path, part in parts.items():
        settle(part, lambda complete, path=path: write_atomically(path, _part_text(complete)))  # type: ignore[misc]


def _read_parts(directory: Path, service: str) -> tuple[dict[Path, dict[str, Any]], list[Path]]:
    parts, unreadable = {}, []
    for path in directory.glob(f"parts/{service}-*.json"):
        try:
            part = json.loads(path.read_text(encoding="utf-8"))
            parts[path] = {**part, "incarnation": int(part["incarnation"])}
        except (OSError, ValueError, TypeError, KeyError):
            unreadable.append(path)
    return parts, unreadable


def _part_text(part: Mapping[str, Any]) -> str:
    return json.dumps(part, indent=1)


@dataclass
class _Table:
    file: TextIO
    writer: Any
    columns: list[str]


class RunRecord:
    """Queue in front of the disk. Every method returns at once; what does not fit is dropped and counted."""

    def __init__(self, directory: Path, service: str, incarnation: int) -> None:
        self.directory = directory
        self.dropped = 0
        """Entries that were not written, because the queue was full or the disk refused."""
        self.part_error: str | None = None
        """Why the newest part could not be written, if it could not."""
        self._service, self._incarnation = service, incarnation
        self._queue: queue.Queue[Callable[[], None] | None] = queue.Queue(_QUEUE_LENGTH)
        self._tables: dict[str, _Table] = {}
        self._events: Any = None
        self._thread = threading.Thread(target=self._run, name="record", daemon=True)

    def start(self) -> None:
        """Begin to write."""
        self._thread.start()

    def close(self, timeout_s: float = 3.0) -> None:
        """Write what is queued, then stop; gives up after ``timeout_s``."""
        if self._thread.is_alive():
            deadline = time.monotonic() + timeout_s
            with contextlib.suppress(queue.Full):
                self._queue.put(None, timeout=timeout_s)
            self._thread.join(max(0.0, deadline - time.monotonic()))

    def part(self, values: Mapping[str, Any]) -> None:
        """Replace this incarnation's part."""
        path = self.directory / "parts" / f"{self._service}-{self._incarnation}.json"
        content = {"service": self._service, "incarnation": self._incarnation, "pid": os.getpid(), **values}
        self._put(lambda: self._write_part(path, content))

    def row(self, table: str, values: Mapping[str, Any]) -> None:
        """Append a row to ``RUN_DIR/<table>.csv``; new columns are added to the table."""
        row = dict(values)
        self._put(lambda: self._write_row(table, row))

    def metrics(self, step: int, wall_s: float, values: Mapping[str, float]) -> None:
        """Record gauges at ``step``: a row of ``metrics/SERVICE.csv`` and points in TensorBoard."""
        row = {"incarnation": self._incarnation, "step": step, "wall_s": round(wall_s, 3), **values}
        self._put(lambda: self._write_metrics(step, row))

    def _put(self, entry: Callable[[], None] | None) -> None:
        try:
            self._queue.put_nowait(entry)
        except queue.Full:
            self.dropped += 1

    def _run(self) -> None:
        while (entry := self._queue.get()) is not None:
            self._write(entry)
        for table in self._tables.values():
            self._write(table.file.close)
        if self._events:
            self._write(self._events.close)

    def _write(self, entry: Callable[[], None]) -> None:
        try:
            entry()
        except Exception as error:
            # Whatever it is, the record must not end with it, and the service even less.
            self.dropped += 1
            if self.dropped == 1:
                logger.error("%s: the record cannot be written: %s", self.directory, error)

    def _write_part(self, path: Path, content: Mapping[str, Any]) -> None:
        try:
            write_atomically(path, _part_text(content))
        except OSError as error:
            self.part_error = f"{path}: {error.strerror}"
            raise
        self.part_error = None

    def _write_row(self, table: str, row: Mapping[str, Any]) -> None:
        if table not in self._tables or not row.keys() <= set(self._tables[table].columns):
            self._tables[table] = self._open_table(table, row)
        open_table = self._tables[table]
        open_table.writer.writerow([row.get(column, "") for column in open_table.columns])
        open_table.file.flush()

    def _open_table(self, table: str, row: Mapping[str, Any]) -> _Table:
        """Open for appending; columns that are new since the table began are added to all its rows."""
        if table in self._tables:
            self._tables.pop(table).file.close()
        path = self.directory / f"{table}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        columns: list[str] = []
        if path.exists():
            with path.open(encoding="utf-8", newline="") as existing:
                rows = list(csv.reader(existing))
            columns = rows[0] if rows else []
            added = [name for name in row if name not in columns]
            if columns and added:
                text = io.StringIO()
                csv.writer(text).writerows([columns + added, *([*old, *[""] * len(added)] for old in rows[1:])])
                write_atomically(path, text.getvalue())
        file = path.open("a", encoding="utf-8", newline="")
        writer = csv.writer(file)
        if not columns:
            writer.writerow(list(row))
        return _Table(file, writer, [*columns, *(name for name in row if name not in columns)])

    def _write_metrics(self, step: int, row: Mapping[str, float]) -> None:
        self._write_row(f"metrics/{self._service}", row)
        self._write_event(step, {name: row[name] for name in row if name not in ("incarnation", "step")})

    def _write_event(self, step: int, values: Mapping[str, float]) -> None:
        """Append points to TensorBoard's file; a SummaryWriter would import torch, and die of a full disk."""
        from tensorboard.compat.proto.event_pb2 import Event
        from tensorboard.compat.proto.summary_pb2 import Summary
        from tensorboard.summary.writer.record_writer import RecordWriter

        if self._events is None:
            path = self.directory / "tensorboard" / self._service / f"events.out.tfevents.{self._incarnation}"
            path.parent.mkdir(parents=True, exist_ok=True)
            self._events = RecordWriter(path.open("wb"))
            self._events.write(Event(wall_time=time.time(), file_version="brain.Event:2").SerializeToString())
        points = [Summary.Value(tag=f"{self._service}/{name}", simple_value=values[name]) for name in values]
        event = Event(wall_time=time.time(), step=step, summary=Summary(value=points))
        self._events.write(event.SerializeToString())
        self._events.flush()
