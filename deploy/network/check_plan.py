"""What ``deploy.network check`` sends over a link, so that chance decides little of what it finds.

Small packets, far apart, show the delay: farther than the jitter, or the slow ones would hold up those behind them.
Many small packets show the loss. More large packets than the rate allows show the rate. Over a relay, which is a
stream, the third shows both: it counts the segments that it would have lost.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence

from deploy.network.conditions import Direction, DirectionConditions, NetworkConditions, burst_share
from deploy.network.netem_link import packet_limit
from deploy.network.probe import HEADER, Phase, Transport
from deploy.network.schedule import StreamSchedule

DELAY, LOSS, RATE = 1, 2, 3
"""Numbers of the phases."""

HEADERS_BYTES = 28
"""IP and UDP."""
SMALL_BYTES, LARGE_BYTES = HEADER.size + 16, 1400
"""What a block carries over packets."""
SEGMENT_BLOCK_BYTES = 1448
"""Over a stream, a large block is a segment."""
SIGMAS = 3
"""The table's tolerances are to be this many standard errors wide."""
DELAY_TOLERANCE, LOSS_TOLERANCE, RATE_TOLERANCE = 0.10, 0.20, 0.10
"""Relative."""

_CONNECTIONS = 8
_LEAST_GAP_S = 0.005
_LEAST_DELAY_BLOCKS = 400
_MAX_DELAY_PHASE_S = 32.0
_MAX_LOSS_PHASE_S = 20.0
_RATE_PHASE_S = 2.5
RATE_SETTLES_S = 0.5
"""How long the queue takes to fill; what arrives before says nothing about the rate."""
_MAX_PACKETS_PER_S = 8000.0
_EXCESS = 1.25


def plan(conditions: NetworkConditions, direction: Direction, transport: Transport) -> list[Phase]:
    """What to send in one direction."""
    one_way = conditions.direction(direction)
    if transport == "packets":
        return [_delay_packets(one_way), _loss_packets(one_way), *_rate_packets(one_way)]
    return [_delay_blocks(conditions, direction), *_large_blocks(one_way)]


def pause_s(conditions: NetworkConditions) -> float:
    """How long to wait after a phase until everything has arrived, s."""
    slowest_ms = max(
        max(one_way.trace.delay_ms) if one_way.trace and one_way.trace.delay_ms else one_way.delay_ms
        for one_way in (conditions.uplink, conditions.downlink)
    )
    jitter_ms = max(conditions.uplink.jitter_ms, conditions.downlink.jitter_ms)
    queue_ms = max(o.queue_ms if o.bytes_per_s else 0.0 for o in (conditions.uplink, conditions.downlink))
    return 0.2 + (slowest_ms + 4 * jitter_ms + queue_ms) / 1e3


def duration_s(phases: Sequence[Phase], between_s: float) -> float:
    """How long a sender takes, about, s."""
    return sum(min(phase.limit_s, phase.blocks / phase.group * phase.gap_s) + between_s for phase in phases)


def delay_error_s(conditions: NetworkConditions, direction: Direction, transport: Transport, blocks: int) -> float:
    """Standard error of the mean delay over so many blocks, s."""
    one_way = conditions.direction(direction)
    correlation = one_way.jitter_correlation
    variance = (one_way.jitter_ms / 1e3) ** 2 * (1 + correlation) / (1 - correlation)
    if transport == "stream":
        variance += retransmission_s(conditions, direction) ** 2 * _loss_variance(one_way)
    return math.sqrt(variance / max(1, blocks))


def loss_error(one_way: DirectionConditions, packets: int) -> float:
    """Standard error of the fraction lost of so many packets."""
    return math.sqrt(_loss_variance(one_way) / max(1, packets))


def retransmission_s(conditions: NetworkConditions, direction: Direction) -> float:
    """What a lost segment is late by over a relay, s."""
    return StreamSchedule(conditions, direction, random.Random(0)).retransmission_s


def _loss_variance(one_way: DirectionConditions) -> float:
    """Variance of one loss, times the number of packets that tell as much as one independent packet does."""
    loss = one_way.loss if one_way.trace is None or one_way.trace.loss is None else _mean_loss(one_way)
    variance = loss * (1 - loss)
    if one_way.loss_burst_packets and 0 < loss < 1:
        inside, outside = one_way.loss_in_burst, one_way.loss_between_bursts
        share = burst_share(loss, inside, outside)
        leave = 1 / one_way.loss_burst_packets
        # Whether packet k + 1 is in a burst has this correlation with whether packet k is.
        memory = 1 - leave - leave * share / (1 - share)
        variance += 2 * (inside - outside) ** 2 * share * (1 - share) * memory / (1 - memory)
    return variance


def _mean_loss(one_way: DirectionConditions) -> float:
    assert one_way.trace is not None
    assert one_way.trace.loss is not None
    return one_way.trace.mean(one_way.trace.loss)


def _delay_packets(one_way: DirectionConditions) -> Phase:
    gap_s = max(_LEAST_GAP_S, 4 * one_way.jitter_ms / 1e3)
    blocks = _delay_blocks_needed(one_way, NetworkConditions(one_way, one_way), "packets", gap_s)
    return Phase(DELAY, blocks, SMALL_BYTES, gap_s)


def _delay_blocks(conditions: NetworkConditions, direction: Direction) -> Phase:
    one_way = conditions.direction(direction)
    late_s = retransmission_s(conditions, direction) if _loss_variance(one_way) else 0.0
    gap_s = max(_LEAST_GAP_S, 4 * one_way.jitter_ms / 1e3 + 1.5 * late_s) / _CONNECTIONS
    blocks = _delay_blocks_needed(one_way, conditions, "stream", gap_s)
    return Phase(DELAY, blocks, SMALL_BYTES, gap_s, connections=_CONNECTIONS)


def _delay_blocks_needed(
    one_way: DirectionConditions, conditions: NetworkConditions, transport: Transport, gap_s: float
) -> int:
    direction: Direction = "uplink" if one_way is conditions.uplink else "downlink"
    allowed_s = DELAY_TOLERANCE * one_way.mean_delay_ms / 1e3
    error_s = delay_error_s(conditions, direction, transport, 1)
    blocks = math.ceil((SIGMAS * error_s / allowed_s) ** 2) if allowed_s else 0
    if one_way.trace is not None:
        blocks = max(blocks, math.ceil(one_way.trace.length_s / gap_s))
    return max(_LEAST_DELAY_BLOCKS, min(blocks, math.floor(_MAX_DELAY_PHASE_S / gap_s)))


def _loss_blocks_needed(one_way: DirectionConditions) -> int:
    loss = one_way.loss if one_way.trace is None or one_way.trace.loss is None else _mean_loss(one_way)
    if not 0 < loss < 1:
        return 2000
    return math.ceil(_loss_variance(one_way) * (SIGMAS / (LOSS_TOLERANCE * loss)) ** 2)


def _loss_packets(one_way: DirectionConditions) -> Phase:
    packets_per_s = _MAX_PACKETS_PER_S
    if one_way.bytes_per_s is not None:
        # Half of the slowest rate, and half of what netem's limit lets be in flight: the queue must lose none.
        slowest = min(one_way.trace.rate_mbit) * 1e6 / 8 if one_way.trace and one_way.trace.rate_mbit else None
        packets_per_s = min(packets_per_s, 0.5 * (slowest or one_way.bytes_per_s) / (SMALL_BYTES + HEADERS_BYTES))
        if flight_s := (one_way.delay_ms + 3 * one_way.jitter_ms) / 1e3:
            packets_per_s = min(packets_per_s, 0.5 * packet_limit(one_way) / flight_s)
    group = min(8, max(1, one_way.queue_packets // 2)) if one_way.queue_packets else 8
    blocks = min(_loss_blocks_needed(one_way), math.ceil(_MAX_LOSS_PHASE_S * packets_per_s))
    # A computer that is too slow for so many sends fewer, and the tolerance grows.
    limit_s = 1.0 + 2.0 * blocks / packets_per_s
    return Phase(LOSS, blocks, SMALL_BYTES, group / packets_per_s, group, limit_s=limit_s)


def _rate_packets(one_way: DirectionConditions) -> list[Phase]:
    bytes_per_s = one_way.bytes_per_s
    if bytes_per_s is None:
        return []
    fastest = max(one_way.trace.rate_mbit) * 1e6 / 8 if one_way.trace and one_way.trace.rate_mbit else bytes_per_s
    per_s = _EXCESS * fastest / (LARGE_BYTES + HEADERS_BYTES)
    group = max(1, math.ceil(0.002 * per_s))
    if one_way.queue_packets:
        group = max(1, min(group, one_way.queue_packets // 2))
    limit_s = max(_RATE_PHASE_S, RATE_SETTLES_S + min(15.0, 100 * LARGE_BYTES / bytes_per_s))
    return [Phase(RATE, math.ceil(per_s * limit_s), LARGE_BYTES, group / per_s, group, limit_s=limit_s)]


def _large_blocks(one_way: DirectionConditions) -> list[Phase]:
    segments = _loss_blocks_needed(one_way) if _loss_variance(one_way) else 0
    if one_way.bytes_per_s is not None:
        segments_per_s = one_way.bytes_per_s / SEGMENT_BLOCK_BYTES
        limit_s = max(_RATE_PHASE_S, min(_MAX_LOSS_PHASE_S, segments / segments_per_s))
        return [Phase(RATE, math.ceil(2 * limit_s * segments_per_s), SEGMENT_BLOCK_BYTES, 0.0, limit_s=limit_s)]
    if not segments:
        return []
    per_s = _MAX_PACKETS_PER_S / 4
    return [Phase(LOSS, min(segments, math.ceil(_MAX_LOSS_PHASE_S * per_s)), SEGMENT_BLOCK_BYTES, 8 / per_s, 8)]
