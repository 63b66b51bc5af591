"""What came over a link, beside what its ``[network]`` table promises. Pure: from the probes' records to a verdict."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from deploy.network.check_plan import (
    DELAY,
    DELAY_TOLERANCE,
    HEADERS_BYTES,
    LARGE_BYTES,
    LOSS,
    LOSS_TOLERANCE,
    RATE,
    RATE_SETTLES_S,
    RATE_TOLERANCE,
    SEGMENT_BLOCK_BYTES,
    SIGMAS,
    SMALL_BYTES,
    delay_error_s,
    loss_error,
    retransmission_s,
)
from deploy.network.conditions import Direction, DirectionConditions, NetworkConditions, bytes_per_s
from deploy.network.part import DirectionCounts
from deploy.network.probe import Received, Sent, Transport, phase_of
from deploy.network.schedule import OutageTimes

OWN_DELAY_MS = 0.2
"""What this machine may take to hand packets to and fro, ms: the tolerance of delays shorter than ten times this."""
_LEAST_LOSS_TOLERANCE = 0.0005
"""Of thousands of packets, one may get lost in a machine that is busy."""
_OUTAGE_MARGIN_S = 0.5
"""Nearer than this to an outage, a packet says nothing about loss or delay."""
_SAMPLES = 1000


@dataclass(frozen=True)
class Row:
    """One number of the table, and what was measured."""

    quantity: str
    direction: Direction
    unit: str
    expected: float
    measured: float | None
    """None: nothing came."""
    allowed: float
    """How far off it may be."""
    note: str = ""
    """What a miss may come from, apart from the link."""
    silent: bool = False
    """Whether the table lets nothing through, so that there can be nothing to measure."""

    @property
    def ok(self) -> bool:
        """Whether it is as the table says."""
        return self.measured is not None and abs(self.measured - self.expected) <= self.allowed

    @property
    def misses(self) -> bool:
        """Whether it is not as the table says; what cannot be measured is neither."""
        return not self.ok and not (self.silent and self.measured is None)


@dataclass(frozen=True)
class Crossed:
    """What was sent in one direction, and what came of it."""

    conditions: NetworkConditions
    direction: Direction
    transport: Transport
    start_ns: int
    """When the link started, on the real-time clock."""
    sent: Sent
    received: Received
    counts: DirectionCounts
    """The link's own."""
    lost_take_their_turn: bool = True
    """Whether what is lost has taken its time at the rate; netem loses it before."""


def compare(crossed: Crossed) -> list[Row]:
    """Each quantity of one direction."""
    rows = [_delay(crossed)]
    rows.append(_loss_of_packets(crossed) if crossed.transport == "packets" else _loss_of_segments(crossed))
    if crossed.conditions.direction(crossed.direction).bytes_per_s is not None:
        rows.append(_rate(crossed))
    return rows


def _delay(crossed: Crossed) -> Row:
    one_way = crossed.conditions.direction(crossed.direction)
    size_bytes = SMALL_BYTES + (HEADERS_BYTES if crossed.transport == "packets" else 0)
    late_s = retransmission_s(crossed.conditions, crossed.direction) if crossed.transport == "stream" else 0.0
    expected_ms, measured_ms = [], []
    for number, sent_ns, came_ns in crossed.received:
        time_s = (sent_ns - crossed.start_ns) / 1e9
        if phase_of(number) == DELAY and not _near_outage(crossed.conditions, time_s):
            now = _at(one_way, time_s)
            on_air_s = size_bytes / now.bytes_per_s if now.bytes_per_s else 0.0
            # Over a relay, what would be lost comes late.
            late_ms = late_s * now.loss * 1e3 if now.loss < 1 else 0.0
            expected_ms.append(now.delay_ms + on_air_s * 1e3 + late_ms)
            measured_ms.append((came_ns - sent_ns) / 1e6)
    expected = statistics.fmean(expected_ms) if expected_ms else one_way.mean_delay_ms
    error_ms = 1e3 * delay_error_s(crossed.conditions, crossed.direction, crossed.transport, len(measured_ms))
    return Row(
        quantity="mean delay",
        direction=crossed.direction,
        unit="ms",
        expected=expected,
        measured=statistics.fmean(measured_ms) if measured_ms else None,
        allowed=max(DELAY_TOLERANCE * expected, SIGMAS * error_ms, OWN_DELAY_MS),
        silent=one_way.silent,
    )


def _loss_of_packets(crossed: Crossed) -> Row:
    one_way = crossed.conditions.direction(crossed.direction)
    came = {number for number, _, _ in crossed.received}
    times_s, lost = [], 0
    for number, sent_ns in crossed.sent:
        time_s = (sent_ns - crossed.start_ns) / 1e9
        if phase_of(number) == LOSS and not _near_outage(crossed.conditions, time_s):
            times_s.append(time_s)
            lost += number not in came
    return _loss_row(crossed.direction, one_way, times_s, lost, len(times_s))


def _loss_of_segments(crossed: Crossed) -> Row:
    """By the relay's own count: nothing is missing at the other end."""
    one_way = crossed.conditions.direction(crossed.direction)
    times_s = [(sent_ns - crossed.start_ns) / 1e9 for _, sent_ns in crossed.sent]
    return _loss_row(crossed.direction, one_way, times_s, crossed.counts.retransmitted, crossed.counts.packets_in)


def _loss_row(
    direction: Direction, one_way: DirectionConditions, times_s: Sequence[float], lost: int, packets: int
) -> Row:
    expected = _mean(_at(one_way, time_s).loss for time_s in _thinned(times_s)) if times_s else one_way.loss
    return Row(
        quantity="loss",
        direction=direction,
        unit="%",
        expected=100 * expected,
        measured=100 * lost / packets if packets else None,
        allowed=100 * max(LOSS_TOLERANCE * expected, SIGMAS * loss_error(one_way, packets), _LEAST_LOSS_TOLERANCE),
    )


def _rate(crossed: Crossed) -> Row:
    """By what arrived in the time, and what was lost after it had taken its own."""
    one_way = crossed.conditions.direction(crossed.direction)
    packets = crossed.transport == "packets"
    size_bytes = LARGE_BYTES + HEADERS_BYTES if packets else SEGMENT_BLOCK_BYTES
    sent_ns = [sent_ns for number, sent_ns in crossed.sent if phase_of(number) == RATE]
    expected = one_way.bytes_per_s or 0.0
    measured, note = None, ""
    if sent_ns:
        begin_s = (sent_ns[0] - crossed.start_ns) / 1e9 + RATE_SETTLES_S + one_way.mean_delay_ms / 1e3
        end_s = (sent_ns[-1] - crossed.start_ns) / 1e9
        came_s = [
            time_s
            for number, _, came_ns in crossed.received
            if phase_of(number) == RATE and begin_s <= (time_s := (came_ns - crossed.start_ns) / 1e9) < end_s
        ]
        outages = OutageTimes.from_conditions(crossed.conditions)
        live_s = end_s - begin_s if outages is None else outages.to_live(end_s) - outages.to_live(begin_s)
        moments = [_at(one_way, begin_s + (end_s - begin_s) * index / _SAMPLES) for index in range(_SAMPLES)]
        expected = _mean(moment.bytes_per_s or 0.0 for moment in moments)
        lost = _mean(moment.loss for moment in moments) if packets and crossed.lost_take_their_turn else 0.0
        if came_s and live_s > 0 and lost < 1:
            measured = len(came_s) * size_bytes / live_s / (1 - lost)
        offered = len(sent_ns) * size_bytes * 1e9 / max(1, sent_ns[-1] - sent_ns[0])
        if offered < expected:
            note = f"only {offered * 8 / 1e6:.1f} Mbit/s were sent: this computer is too slow or too busy to tell"
    return Row(
        quantity="rate",
        direction=crossed.direction,
        unit="Mbit/s",
        expected=expected * 8 / 1e6,
        measured=None if measured is None else measured * 8 / 1e6,
        allowed=RATE_TOLERANCE * expected * 8 / 1e6,
        note=note,
        silent=one_way.silent,
    )


@dataclass(frozen=True)
class _Moment:
    delay_ms: float
    loss: float
    bytes_per_s: float | None


def _at(one_way: DirectionConditions, time_s: float) -> _Moment:
    """What the table says of one moment."""
    delay_ms, loss, rate_mbit = one_way.delay_ms, one_way.loss, one_way.rate_mbit
    if (trace := one_way.trace) is not None:
        row = trace.row(time_s)
        delay_ms = delay_ms if trace.delay_ms is None else trace.delay_ms[row]
        loss = loss if trace.loss is None else trace.loss[row]
        rate_mbit = rate_mbit if trace.rate_mbit is None else trace.rate_mbit[row]
    return _Moment(delay_ms, loss, bytes_per_s(rate_mbit))


def _near_outage(conditions: NetworkConditions, time_s: float) -> bool:
    outages = OutageTimes.from_conditions(conditions)
    return outages is not None and outages.touch(max(0.0, time_s - _OUTAGE_MARGIN_S), time_s + _OUTAGE_MARGIN_S)


def _thinned(times_s: Sequence[float]) -> Sequence[float]:
    return times_s[:: max(1, len(times_s) // _SAMPLES)]


def _mean(values: Iterable[float]) -> float:
    return statistics.fmean(values)
