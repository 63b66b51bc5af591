"""The ``[network]`` table: how a WiFi-like link between the hosts ``local`` and ``remote`` behaves.

Delay, jitter, loss, rate and queue belong to one direction. Outages belong to the whole link: a radio that is
gone is gone for both.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from common.config import read_toml
from common.errors import ConfigError

Host = Literal["local", "remote"]
Direction = Literal["uplink", "downlink"]

HOSTS: tuple[Host, Host] = ("local", "remote")
DIRECTIONS: tuple[Direction, Direction] = ("uplink", "downlink")


def direction_from(host: Host) -> Direction:
    """The direction that traffic sent by ``host`` takes."""
    return "uplink" if host == "local" else "downlink"


def _check_direction_key(key: str, value: object, where: str) -> None:
    if key == "rate_mbit" and value is None:
        return
    if key == "loss":
        _check_number(f"{where}.loss", value, "a fraction between 0 and 1", upper=1.0)
    elif key == "rate_mbit":
        _check_number(f"{where}.{key}", value, "Mbit/s >= 0 (0: unlimited)")
    else:
        _check_number(f"{where}.{key}", value, "milliseconds >= 0")


def _check_outages(every_s: object, length_s: object, where: str) -> None:
    every = _check_number(f"{where}.outage_every_s", every_s, "seconds >= 0")
    length = _check_number(f"{where}.outage_s", length_s, "seconds >= 0")
    if length > 0 and length >= every:
        raise ConfigError(f"{where}.outage_s = {length_s!r}: expected less than outage_every_s = {every_s!r}")


def _check_number(key: str, value: object, expected: str, upper: float = math.inf) -> float:
    # bool is an int in Python, but ``loss = true`` is a mistake.
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(f"{key} = {value!r}: expected {expected}")
    if not math.isfinite(value) or not 0 <= value <= upper:
        raise ConfigError(f"{key} = {value!r}: expected {expected}")
    return float(value)


@dataclass(frozen=True)
class DirectionConditions:
    """One direction of the link."""

    delay_ms: float = 0.0
    """Mean one-way delay, ms, on top of the time a packet waits in the queue and takes at the rate."""
    jitter_ms: float = 0.0
    """Standard deviation of the delay, ms. Packets are never reordered, so in a dense stream a slow packet
    holds up those behind it and the mean delay rises above ``delay_ms``."""
    loss: float = 0.0
    """Fraction of packets lost on the air, 0..1."""
    rate_mbit: float | None = None
    """Mbit/s of IP packets; 0 or None: unlimited."""
    queue_ms: float = 200.0
    """Longest time a packet may wait for its turn, ms; one that would wait longer is dropped."""

    def __post_init__(self) -> None:
        for item in dataclasses.fields(self):
            _check_direction_key(item.name, getattr(self, item.name), where="network")

    @property
    def bytes_per_s(self) -> float | None:
        """The rate, bytes/s; None: unlimited."""
        return self.rate_mbit * 1e6 / 8 if self.rate_mbit else None


@dataclass(frozen=True)
class NetworkConditions:
    """Both directions, and the outages they share."""

    uplink: DirectionConditions = field(default_factory=DirectionConditions)
    """From ``local`` to ``remote``."""
    downlink: DirectionConditions = field(default_factory=DirectionConditions)
    """From ``remote`` to ``local``."""
    outage_every_s: float = 0.0
    """From the start of one outage to the start of the next, s. The first starts this long after the link."""
    outage_s: float = 0.0
    """How long nothing gets through, s; 0: no outages."""

    def __post_init__(self) -> None:
        _check_outages(self.outage_every_s, self.outage_s, where="network")

    def direction(self, direction: Direction) -> DirectionConditions:
        return self.uplink if direction == "uplink" else self.downlink

    def to_table(self) -> dict[str, Any]:
        """The table that ``parse_network`` turns back into equal conditions."""
        return dataclasses.asdict(self)


def _both(direction: DirectionConditions, outage_every_s: float = 0.0, outage_s: float = 0.0) -> NetworkConditions:
    return NetworkConditions(direction, direction, outage_every_s, outage_s)


PRESETS: dict[str, NetworkConditions] = {
    "ideal": _both(DirectionConditions()),
    "wifi_office": _both(DirectionConditions(delay_ms=3.0, jitter_ms=2.0, loss=0.005, rate_mbit=40.0)),
    "wifi_bad": _both(DirectionConditions(delay_ms=20.0, jitter_ms=15.0, loss=0.02, rate_mbit=12.0)),
    "outage": _both(DirectionConditions(delay_ms=3.0, rate_mbit=20.0), outage_every_s=20.0, outage_s=1.0),
}
"""Named conditions, the same in each direction."""

_DIRECTION_KEYS = tuple(f.name for f in dataclasses.fields(DirectionConditions))
_OUTAGE_KEYS = ("outage_every_s", "outage_s")


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
    return parse_network(document["network"], where=f"{path}: network")


def parse_network(table: Mapping[str, Any], where: str = "network") -> NetworkConditions:
    """Conditions from a ``[network]`` table.

    ``preset`` gives the values to start from (default: ``ideal``), keys of the table itself override both
    directions, and those of ``[network.uplink]`` and ``[network.downlink]`` override one. ``where`` begins
    the key in errors.
    """
    _check_table(table, where, ("preset", *DIRECTIONS, *_DIRECTION_KEYS, *_OUTAGE_KEYS))
    preset = table.get("preset", "ideal")
    if not isinstance(preset, str) or preset not in PRESETS:
        raise ConfigError(f"{where}.preset = {preset!r}: expected {_preset_names()}")
    start = PRESETS[preset]
    shared = {key: table[key] for key in _DIRECTION_KEYS if key in table}
    directions = {}
    for name in DIRECTIONS:
        overrides = table.get(name, {})
        _check_table(overrides, f"{where}.{name}", _DIRECTION_KEYS)
        # A wrong value is reported under the key that set it, so the shared keys are checked before the
        # overrides.
        base = _replace_direction(start.direction(name), shared, where)
        directions[name] = _replace_direction(base, overrides, f"{where}.{name}")
    every_s = table.get("outage_every_s", start.outage_every_s)
    length_s = table.get("outage_s", start.outage_s)
    _check_outages(every_s, length_s, where)
    return NetworkConditions(directions["uplink"], directions["downlink"], every_s, length_s)


def _replace_direction(base: DirectionConditions, changes: Mapping[str, Any], where: str) -> DirectionConditions:
    for key, value in changes.items():
        _check_direction_key(key, value, where)
    return dataclasses.replace(base, **changes)


def _preset_names() -> str:
    return f"one of the presets {', '.join(PRESETS)}"


def _check_table(table: object, where: str, known: tuple[str, ...]) -> None:
    if not isinstance(table, Mapping):
        raise ConfigError(f"{where} = {table!r}: expected a table")
    for key, value in table.items():
        if key in known:
            continue
        hint = "; outages belong to both directions: set them in [network]" if key in _OUTAGE_KEYS else ""
        raise ConfigError(f"{where}.{key} = {value!r}: unknown key, expected one of {', '.join(known)}{hint}")
