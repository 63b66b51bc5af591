"""A recorded link: delay, loss and rate of one direction as they changed over time.

A trace is a CSV file. Its first line names the columns: ``time_s`` and at least one of ``delay_ms``, ``loss`` and
``rate_mbit``. Each further line holds from its time on until the next one's; the last holds for as long as the one
before it did. What a trace has no column for is what the ``[network]`` table says.
"""

from __future__ import annotations

import csv
import math
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Literal, get_args

from common.errors import ConfigError
from common.record import write_atomically

TraceEnd = Literal["loop", "stop"]
TRACE_ENDS: tuple[TraceEnd, ...] = get_args(TraceEnd)
"""``loop``: the trace begins again. ``stop``: the run ends with it; until it has, the last values hold."""

_TIME = "time_s"
_NAME, _FILE = "name", "file"
_EXPECTED = {
    "delay_ms": "milliseconds >= 0",
    "loss": "a fraction between 0 and 1",
    "rate_mbit": "Mbit/s > 0 (for a silence: loss = 1)",
}
TRACE_COLUMNS = tuple(_EXPECTED)
MAX_ROWS = 100_000
"""Most rows of a trace: a day, second by second. They are read within half a second."""


@dataclass(frozen=True)
class Trace:
    """The values of one direction over time, from the link's start on."""

    name: str
    """What errors and records call it: the path it was read from."""
    time_s: tuple[float, ...]
    """When each row begins to hold, s; the first is 0."""
    delay_ms: tuple[float, ...] | None = None
    """Row -> mean one-way delay, ms; None: the trace does not say."""
    loss: tuple[float, ...] | None = None
    """Row -> fraction of packets lost, 0..1."""
    rate_mbit: tuple[float, ...] | None = None
    """Row -> Mbit/s of IP packets."""
    end: TraceEnd = "loop"

    def __post_init__(self) -> None:
        if self.end not in TRACE_ENDS:
            raise ConfigError(f"{self.name}: trace_end = {self.end!r}: expected {' or '.join(TRACE_ENDS)}")
        if len(self.time_s) < 2:
            raise ConfigError(f"{self.name}: {len(self.time_s)} rows: expected at least 2")
        if len(self.time_s) > MAX_ROWS:
            raise _too_long(self.name)
        if self.time_s[0] != 0:
            raise ConfigError(f"{self.name}: row 1: {_TIME} = {self.time_s[0]!r}: expected 0")
        for number, (before, here) in enumerate(zip(self.time_s, self.time_s[1:], strict=False), start=2):
            if not before < here < math.inf:
                raise ConfigError(f"{self.name}: row {number}: {_TIME} = {here!r}: expected more than {before!r}")
        if not self.columns:
            raise ConfigError(f"{self.name}: expected at least one of the columns {', '.join(TRACE_COLUMNS)}")
        for column, values in self.columns.items():
            self._check_column(column, values)

    @property
    def columns(self) -> dict[str, tuple[float, ...]]:
        """What the trace says over time: name of the column -> its values."""
        return {column: values for column in TRACE_COLUMNS if (values := getattr(self, column)) is not None}

    @property
    def length_s(self) -> float:
        """How long the recording is, s."""
        return 2 * self.time_s[-1] - self.time_s[-2]

    def row(self, time_s: float) -> int:
        """The row that holds at ``time_s``; after the end of a trace that does not loop, the last one."""
        if self.end == "loop":
            time_s %= self.length_s
        return max(0, bisect_right(self.time_s, time_s) - 1)

    def row_ends_s(self, time_s: float) -> float:
        """When the row that holds at ``time_s`` gives way to the next one, s; never: infinity."""
        row = self.row(time_s)
        last = row == len(self.time_s) - 1
        if self.end == "stop":
            return math.inf if last else self.time_s[row + 1]
        passed_s = time_s - time_s % self.length_s
        return passed_s + (self.length_s if last else self.time_s[row + 1])

    def mean(self, column: Sequence[float]) -> float:
        """Mean over time of one of the columns."""
        ends_s = (*self.time_s[1:], self.length_s)
        lengths_s = (end_s - begin_s for begin_s, end_s in zip(self.time_s, ends_s, strict=True))
        return sum(value * length_s for value, length_s in zip(column, lengths_s, strict=True)) / self.length_s

    def to_table(self) -> dict[str, Any]:
        """The table that :func:`parse_trace` turns back into an equal trace, ``end`` aside."""
        return {
            "name": self.name,
            **{name: list(values) for name, values in ({_TIME: self.time_s} | self.columns).items()},
        }

    def _check_column(self, column: str, values: Sequence[float]) -> None:
        if len(values) != len(self.time_s):
            raise ConfigError(f"{self.name}: {column} has {len(values)} rows and {_TIME} {len(self.time_s)}")
        for number, value in enumerate(values, start=1):
            good = 0 <= value <= 1 if column == "loss" else 0 <= value < math.inf
            if not good or (column == "rate_mbit" and value == 0):
                raise ConfigError(f"{self.name}: row {number}: {column} = {value!r}: expected {_EXPECTED[column]}")


def parse_trace(
    value: object, end: TraceEnd, where: str, directory: Path, read: Callable[[Path, TraceEnd], Trace]
) -> Trace:
    """A trace from the value of the key ``trace``: the path of a CSV file, or a table.

    A table has the rows (:meth:`Trace.to_table`), or their file in a run's record (:func:`keep_rows`).

    Args:
        value: what the key holds.
        end: what happens when the trace is over.
        where: the key, for errors.
        directory: what a relative path starts from.
        read: :func:`read_trace`, or one that remembers.
    """
    if isinstance(value, str):
        return read(directory / value, end)
    if isinstance(value, Mapping):
        return _from_record(value, end, where, directory, read) if _FILE in value else _from_table(value, end, where)
    raise ConfigError(f"{where} = {value!r}: expected the path of a CSV file with the columns {_columns_text()}")


def read_trace(path: Path, end: TraceEnd = "loop") -> Trace:
    """Read a CSV file."""
    try:
        # Spreadsheets begin a file in UTF-8 with a byte order mark.
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = (line for line in csv.reader(file) if line)
            header = [name.strip() for name in next(lines, [])]
            rows = list(islice(lines, MAX_ROWS + 1))
    except OSError as error:
        raise ConfigError(f"{path}: a trace that cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path}: not a CSV file: {error}") from error
    known = (_TIME, *TRACE_COLUMNS)
    if _TIME not in header or len(set(header)) != len(header) or not set(header) <= set(known):
        raise ConfigError(f"{path}: the first line is {', '.join(header)!r}: expected the columns {_columns_text()}")
    if len(rows) > MAX_ROWS:  # the rest was not even read
        raise _too_long(str(path))
    for number, row in enumerate(rows, start=1):
        if len(row) != len(header):
            raise ConfigError(f"{path}: row {number} has {len(row)} values: expected {len(header)}")
    texts = zip(*rows, strict=True) if rows else [()] * len(header)
    columns = {
        name: _numbers(column, lambda index, name=name: f"{path}: row {index + 1}: {name}")  # type: ignore[misc]
        for name, column in zip(header, texts, strict=True)
    }
    return Trace(str(path), end=end, **columns)


def keep_rows(table: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Write the rows of a trace's table to a CSV file, and return the table that has the file's name instead.

    TOML takes long to read that many numbers.
    """
    columns = {name: values for name, values in table.items() if name != _NAME}
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in zip(*columns.values(), strict=True))]
    write_atomically(path, "\n".join(lines) + "\n")
    return {_NAME: table[_NAME], _FILE: path.name}


def _from_record(
    table: Mapping[str, Any], end: TraceEnd, where: str, directory: Path, read: Callable[[Path, TraceEnd], Trace]
) -> Trace:
    for key, value in table.items():
        if key not in (_NAME, _FILE) or not isinstance(value, str):
            raise ConfigError(f"{where}.{key} = {value!r}: expected only {_NAME} and {_FILE}, which are texts")
    trace = read(directory / table[_FILE], end)
    return replace(trace, name=table.get(_NAME, trace.name))


def _from_table(table: Mapping[str, Any], end: TraceEnd, where: str) -> Trace:
    columns: dict[str, tuple[float, ...]] = {}
    for key, values in table.items():
        if key == _NAME:
            continue
        if key not in (_TIME, *TRACE_COLUMNS):
            raise ConfigError(f"{where}.{key}: unknown key, expected {_NAME}, {_columns_text()}")
        if not isinstance(values, Sequence) or isinstance(values, str):
            raise ConfigError(f"{where}.{key} = {values!r}: expected a list of numbers")
        columns[key] = _numbers(values, lambda index, key=key: f"{where}.{key}[{index}]")  # type: ignore[misc]
    return Trace(str(table.get(_NAME, where)), end=end, **{_TIME: (), **columns})


def _numbers(values: Sequence[object], where: Callable[[int], str]) -> tuple[float, ...]:
    """Values as numbers; ``where`` names the one with an index, for errors."""
    numbers = []
    for index, value in enumerate(values):
        try:
            if isinstance(value, bool) or not isinstance(value, int | float | str):
                raise ValueError
            numbers.append(float(value))
        except ValueError:
            raise ConfigError(f"{where(index)} = {value!r}: expected a number") from None
    return tuple(numbers)


def _too_long(name: str) -> ConfigError:
    return ConfigError(
        f"{name}: more than {MAX_ROWS} rows: expected at most that many; leave out some, for each holds until the next"
    )


def _columns_text() -> str:
    return f"{_TIME} and some of {', '.join(TRACE_COLUMNS)}"
