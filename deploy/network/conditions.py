"""How a WiFi-like link between the hosts ``local`` and ``remote`` behaves.

Delay, jitter, loss, rate, queue and trace belong to one direction. Outages belong to the whole link: a radio that is
gone is gone for both. :mod:`deploy.network.table` reads conditions from a file.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from common.errors import ConfigError
from deploy.network.trace import Trace

Host = Literal["local", "remote"]
Direction = Literal["uplink", "downlink"]

HOSTS: tuple[Host, Host] = ("local", "remote")
DIRECTIONS: tuple[Direction, Direction] = ("uplink", "downlink")

SEGMENT_BYTES = 1448
"""What a TCP segment carries at an MTU of 1500."""


def direction_from(host: Host) -> Direction:
    """The direction that traffic sent by ``host`` takes."""
    return "uplink" if host == "local" else "downlink"


@dataclass(frozen=True)
class DirectionConditions:
    """One direction of the link."""

    delay_ms: float = 0.0
    """Mean one-way delay, ms, on top of the time a packet waits in the queue and takes at the rate."""
    jitter_ms: float = 0.0
    """Standard deviation of the delay, ms, before what would be negative becomes 0. Packets are never reordered, so in
    a dense stream a slow packet holds up those behind it and the mean delay rises above ``delay_ms``."""
    loss: float = 0.0
    """Fraction of packets lost on the air, 0..1."""
    rate_mbit: float | None = None
    """Mbit/s of IP packets; None or infinity: unlimited."""
    queue_ms: float = 200.0
    """Longest time a packet may wait for its turn, ms; one that would wait longer is dropped."""
    queue_packets: int = 0
    """Most packets that may wait for their turn; one more is dropped. 0: only ``queue_ms`` bounds the queue."""
    jitter_correlation: float = 0.0
    """Correlation of one packet's delay with the next one's, 0..1 (below 1)."""
    loss_burst_packets: float = 0.0
    """Mean length of a burst, packets; 0: each packet is lost or not whatever befell the others. Bursts are the bad
    state of Gilbert's and Elliott's channel (Elliott 1963); ``loss`` stays the mean over bursts and the rest."""
    loss_in_burst: float = 1.0
    """Fraction of packets lost within a burst."""
    loss_between_bursts: float = 0.0
    """Fraction of packets lost outside of bursts."""
    trace: Trace | None = None
    """Delay, loss and rate over time; what it says, ``delay_ms``, ``loss`` and ``rate_mbit`` must not say too."""

    def __post_init__(self) -> None:
        values = {item.name: getattr(self, item.name) for item in dataclasses.fields(self)}
        for key, value in values.items():
            check_key(key, value, where="network")
        check_together(values, where="network")

    @property
    def mean_delay_ms(self) -> float:
        """Mean of the one-way delay, over a trace's time where there is one, ms."""
        if self.trace is None or self.trace.delay_ms is None:
            return self.delay_ms
        return self.trace.mean(self.trace.delay_ms)

    @property
    def bytes_per_s(self) -> float | None:
        """The rate, bytes/s; the mean of a trace's; None: unlimited."""
        if self.trace is not None and self.trace.rate_mbit is not None:
            return self.trace.mean(self.trace.rate_mbit) * 1e6 / 8
        return bytes_per_s(self.rate_mbit)

    @property
    def silent(self) -> bool:
        """Whether everything is lost, always."""
        losses = self.trace.loss if self.trace and self.trace.loss is not None else (self.loss,)
        return min(losses) == 1

    def to_table(self) -> dict[str, Any]:
        """The keys and values of this direction's table; a trace with its rows."""
        values = {item.name: getattr(self, item.name) for item in dataclasses.fields(self)}
        if self.trace is None:
            del values["trace"]
            return values
        for column in self.trace.columns:
            del values[column]
        return {**values, "trace": self.trace.to_table(), "trace_end": self.trace.end}


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
    congestion_control: str = ""
    """Of both hosts' TCP, e.g. ``cubic``; empty: this computer's. Only in namespaces can it be another."""

    def __post_init__(self) -> None:
        check_outages(self.outage_every_s, self.outage_s, where="network")
        check_congestion_control(self.congestion_control, where="network")

    def direction(self, direction: Direction) -> DirectionConditions:
        return self.uplink if direction == "uplink" else self.downlink

    @property
    def stops(self) -> tuple[float, Trace] | None:
        """When the first trace that does not loop is over, s after the link's start, and which; None: never."""
        stopping = [
            trace for one_way in (self.uplink, self.downlink) if (trace := one_way.trace) and trace.end == "stop"
        ]
        first = min(stopping, key=lambda trace: trace.length_s, default=None)
        return None if first is None else (first.length_s, first)

    def to_table(self) -> dict[str, Any]:
        """The table that ``parse_network`` turns back into equal conditions."""
        directions = {name: self.direction(name).to_table() for name in DIRECTIONS}
        link = {"outage_every_s": self.outage_every_s, "outage_s": self.outage_s}
        chosen = {"congestion_control": self.congestion_control} if self.congestion_control else {}
        return {**directions, **link, **chosen}


DIRECTION_DEFAULTS = {item.name: item.default for item in dataclasses.fields(DirectionConditions)}
"""Key of a direction -> its value where nothing is said."""


def bytes_per_s(rate_mbit: float | None) -> float | None:
    """A rate in bytes/s; None: unlimited."""
    return None if rate_mbit is None or math.isinf(rate_mbit) else rate_mbit * 1e6 / 8


def check_key(key: str, value: object, where: str) -> None:
    """Check the value of one key of a direction, apart from the others."""
    match key:
        case "trace":
            if value is not None and not isinstance(value, Trace):
                raise ConfigError(f"{where}.trace = {value!r}: expected a trace")
        case "rate_mbit":
            expected = "Mbit/s > 0 (unlimited: inf)"
            if value is not None and value != math.inf and _check_number(f"{where}.{key}", value, expected) == 0:
                raise ConfigError(f"{where}.{key} = {value!r}: expected {expected}")
        case "loss" | "loss_in_burst" | "loss_between_bursts":
            _check_number(f"{where}.{key}", value, "a fraction between 0 and 1", upper=1.0)
        case "jitter_correlation":
            expected = "a correlation of at least 0 and less than 1"
            if _check_number(f"{where}.{key}", value, expected, upper=1.0) == 1:
                raise ConfigError(f"{where}.{key} = {value!r}: expected {expected}")
        case "loss_burst_packets":
            expected = "a mean length of at least 1 packet (0: no bursts)"
            if 0 < _check_number(f"{where}.{key}", value, expected) < 1:
                raise ConfigError(f"{where}.{key} = {value!r}: expected {expected}")
        case "queue_packets":
            expected = "a whole number of packets >= 0 (0: any)"
            if not isinstance(value, int) or _check_number(f"{where}.{key}", value, expected) < 0:
                raise ConfigError(f"{where}.{key} = {value!r}: expected {expected}")
        case _:
            _check_number(f"{where}.{key}", value, "milliseconds >= 0")


def check_together(values: Mapping[str, Any], where: str) -> None:
    """Refuse values of one direction that contradict each other. Each has passed :func:`check_key`."""
    trace: Trace | None = values["trace"]
    if trace is not None:
        for column in trace.columns:
            if values[column] != DIRECTION_DEFAULTS[column]:
                raise said_twice(column, values[column], where, f"the trace {trace.name}")
    _check_jitter(values, trace, where)
    if values["queue_packets"] and values["rate_mbit"] in (None, math.inf) and not (trace and trace.rate_mbit):
        raise ConfigError(
            f"{where}.queue_packets = {values['queue_packets']!r}: without rate_mbit nothing ever waits; expected 0"
        )
    losses = trace.loss if trace and trace.loss is not None else (values["loss"],)
    if not values["loss_burst_packets"]:
        for key, default in (("loss_in_burst", 1.0), ("loss_between_bursts", 0.0)):
            if values[key] != default:
                raise ConfigError(f"{where}.{key} = {values[key]!r}: there are no bursts; expected loss_burst_packets")
        return
    if not any(losses):
        raise ConfigError(
            f"{where}.loss_burst_packets = {values['loss_burst_packets']!r}: nothing is lost; expected loss > 0, "
            "the mean over bursts and the rest"
        )
    for loss in losses:
        _check_bursts(loss, values, where)


def said_twice(column: str, value: object, where: str, whose: str) -> ConfigError:
    """The error that a number is given which a trace's column would override."""
    return ConfigError(
        f"{where}.{column} = {value!r}: {whose} has a column {column}, and only one of the two can hold; leave one out"
    )


def _check_jitter(values: Mapping[str, Any], trace: Trace | None, where: str) -> None:
    jitter_ms, correlation = values["jitter_ms"], values["jitter_correlation"]
    if correlation and not jitter_ms:
        raise ConfigError(f"{where}.jitter_correlation = {correlation!r}: there is no jitter; expected jitter_ms > 0")
    least_ms = min(trace.delay_ms) if trace and trace.delay_ms is not None else values["delay_ms"]
    if jitter_ms > least_ms:
        whose = f"the least delay in {trace.name}" if trace and trace.delay_ms is not None else "delay_ms"
        raise ConfigError(
            f"{where}.jitter_ms = {jitter_ms!r}: expected at most {whose} = {least_ms!r}; no delay is negative, so "
            "with more the mean would not be what was asked for"
        )


def _check_bursts(loss: float, values: Mapping[str, Any], where: str) -> None:
    if loss in (0, 1):  # in a trace: nothing is lost for a while, or everything
        return
    inside, outside = values["loss_in_burst"], values["loss_between_bursts"]
    if not outside < loss < inside:
        raise ConfigError(
            f"{where}.loss = {loss!r}: expected more than loss_between_bursts = {outside!r} and less than "
            f"loss_in_burst = {inside!r}, between which it is the mean"
        )
    share = burst_share(loss, inside, outside)
    least = share / (1 - share)
    if values["loss_burst_packets"] < least:
        raise ConfigError(
            f"{where}.loss_burst_packets = {values['loss_burst_packets']!r}: expected at least {least:.3g}, for a loss "
            f"of {loss!r} takes bursts {share:.0%} of the time"
        )


def burst_share(loss: float, inside: float, outside: float) -> float:
    """Fraction of packets that must fall into bursts for the mean loss to be ``loss``."""
    return (loss - outside) / (inside - outside)


def check_outages(every_s: object, length_s: object, where: str) -> None:
    """Refuse outages that are not times, or that leave nothing between them."""
    every = _check_number(f"{where}.outage_every_s", every_s, "seconds >= 0")
    length = _check_number(f"{where}.outage_s", length_s, "seconds >= 0")
    if length > 0 and length >= every:
        raise ConfigError(f"{where}.outage_s = {length_s!r}: expected less than outage_every_s = {every_s!r}")


def check_congestion_control(name: object, where: str) -> None:
    """Refuse what is no name; the hosts find out whether their kernel knows it."""
    if not isinstance(name, str) or not re.fullmatch(r"[a-z0-9_]*", name):
        raise ConfigError(
            f"{where}.congestion_control = {name!r}: expected a name of net.ipv4.tcp_available_congestion_control, "
            "e.g. 'cubic', or '' (this computer's)"
        )


def _check_number(key: str, value: object, expected: str, upper: float = math.inf) -> float:
    # bool is an int in Python, but ``loss = true`` is a mistake.
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(f"{key} = {value!r}: expected {expected}")
    if not math.isfinite(value) or not 0 <= value <= upper:
        raise ConfigError(f"{key} = {value!r}: expected {expected}")
    return float(value)
