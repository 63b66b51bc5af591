"""The ``[network]`` table: conditions by the name of a preset, or from a TOML file."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from common.config import read_toml
from common.errors import ConfigError
from deploy.network.conditions import (
    DIRECTION_DEFAULTS,
    DIRECTIONS,
    Direction,
    DirectionConditions,
    NetworkConditions,
    check_congestion_control,
    check_key,
    check_outages,
    check_together,
    said_twice,
)
from deploy.network.presets import PRESETS
from deploy.network.trace import TRACE_COLUMNS, TRACE_ENDS, Trace, TraceEnd, keep_rows, parse_trace, read_trace

_TRACE_END = "trace_end"
_DIRECTION_KEYS = (*(item.name for item in dataclasses.fields(DirectionConditions)), _TRACE_END)
_LINK_KEYS = ("outage_every_s", "outage_s", "congestion_control")


def load_network(name_or_path: str | Path) -> NetworkConditions:
    """Conditions by the name of a preset, or from the ``[network]`` table of a TOML file."""
    if str(name_or_path) in PRESETS:
        return PRESETS[str(name_or_path)]
    path = Path(name_or_path)
    if not path.is_file():
        raise ConfigError(f"network = {str(name_or_path)!r}: expected {_preset_names()}, or the path of a TOML file")
    document = read_toml(path)
    if "network" not in document:
        raise ConfigError(f"{path}: expected a table [network], found {', '.join(document) or 'nothing'}")
    return parse_network(document["network"], where=f"{path}: network", directory=path.parent)


def parse_network(table: Mapping[str, Any], where: str = "network", directory: Path = Path()) -> NetworkConditions:
    """Conditions from a ``[network]`` table.

    ``preset`` gives the values to start from (default: ``ideal``), keys of the table itself override both
    directions, and those of ``[network.uplink]`` and ``[network.downlink]`` override one. ``where`` begins
    the key in errors; a trace's relative path starts from ``directory``.
    """
    _check_table(table, where, ("preset", *DIRECTIONS, *_DIRECTION_KEYS, *_LINK_KEYS))
    preset = table.get("preset", "ideal")
    if not isinstance(preset, str) or preset not in PRESETS:
        raise ConfigError(f"{where}.preset = {preset!r}: expected {_preset_names()}")
    start = PRESETS[preset]
    shared = {key: table[key] for key in _DIRECTION_KEYS if key in table}
    read = functools.cache(read_trace)  # both directions may name one file
    directions: dict[Direction, DirectionConditions] = {}
    for name in DIRECTIONS:
        overrides = table.get(name, {})
        _check_table(overrides, f"{where}.{name}", _DIRECTION_KEYS)
        directions[name] = _direction(
            start.direction(name),
            (shared, where),
            (overrides, f"{where}.{name}"),
            lambda value, end, where: parse_trace(value, end, where, directory, read),
        )
    for keys, where_end, traces in (
        (shared, where, [one_way.trace for one_way in directions.values()]),
        *((table.get(name, {}), f"{where}.{name}", [directions[name].trace]) for name in DIRECTIONS),
    ):
        if _TRACE_END in keys and not any(traces):
            raise ConfigError(f"{where_end}.{_TRACE_END} = {keys[_TRACE_END]!r}: there is no trace; expected trace")
    for column in TRACE_COLUMNS:
        if column in shared and all(column in _columns(one_way.trace) for one_way in directions.values()):
            raise said_twice(column, shared[column], where, "the trace of each direction")
    every_s = table.get("outage_every_s", start.outage_every_s)
    length_s = table.get("outage_s", start.outage_s)
    check_outages(every_s, length_s, where)
    congestion_control = table.get("congestion_control", start.congestion_control)
    check_congestion_control(congestion_control, where)
    return NetworkConditions(directions["uplink"], directions["downlink"], every_s, length_s, congestion_control)


def _direction(
    start: DirectionConditions,
    shared: tuple[Mapping[str, Any], str],
    own: tuple[Mapping[str, Any], str],
    read: Callable[[object, TraceEnd, str], Trace],
) -> DirectionConditions:
    """``start`` with what was said of both directions, then of this one.

    Args:
        start: what holds where nothing is said.
        shared: (keys, where they stand) of both directions.
        own: the same of this one.
        read: returns the trace for (value of the key ``trace``, what happens at its end, where it stands).
    """
    # The end of a trace may be said of both directions, and the traces of each: the ends first.
    end = "loop"
    for changes, where in (shared, own):
        end = changes.get(_TRACE_END, end)
        if end not in TRACE_ENDS:
            raise ConfigError(f"{where}.{_TRACE_END} = {end!r}: expected {' or '.join(TRACE_ENDS)}")
    values = {item.name: getattr(start, item.name) for item in dataclasses.fields(start)}
    given: dict[str, str] = {}
    """Number -> where it stands, unless the trace stands closer to the direction."""
    for changes, where in (shared, own):
        # A wrong value is reported under the key that set it, so each is checked before it is overridden.
        for key, value in changes.items():
            if key == _TRACE_END:
                continue
            if key == "trace":
                value = read(value, end, f"{where}.trace")
            check_key(key, value, where)
            values[key] = value
        given = {} if "trace" in changes else given
        given |= {key: where for key in changes if key in TRACE_COLUMNS}
    for column in _columns(values["trace"]):
        if column in given:
            raise said_twice(column, values[column], given[column], f"the trace {values['trace'].name}")
        values[column] = DIRECTION_DEFAULTS[column]
    check_together(values, own[1])
    return DirectionConditions(**values)


def recorded_table(table: Mapping[str, Any], directory: Path) -> dict[str, Any]:
    """The table of :meth:`NetworkConditions.to_table` for a record in ``directory``, with files there for traces.

    With that directory, :func:`parse_network` turns it back into equal conditions.
    """
    recorded = dict(table)
    for name in DIRECTIONS:
        one_way = table.get(name, {})
        if "trace" in one_way:
            recorded[name] = {**one_way, "trace": keep_rows(one_way["trace"], directory / f"{name}_trace.csv")}
    return recorded


def _columns(trace: Trace | None) -> Collection[str]:
    return trace.columns if trace else ()


def _preset_names() -> str:
    return f"one of the presets {', '.join(PRESETS)}"


def _check_table(table: object, where: str, known: tuple[str, ...]) -> None:
    if not isinstance(table, Mapping):
        raise ConfigError(f"{where} = {table!r}: expected a table")
    for key, value in table.items():
        if key in known:
            continue
        hint = "; it belongs to both directions: set it in [network]" if key in _LINK_KEYS else ""
        raise ConfigError(f"{where}.{key} = {value!r}: unknown key, expected one of {', '.join(known)}{hint}")
