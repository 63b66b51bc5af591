"""What chance and a trace decide about the packets of one direction: delay, loss and rate. Pure, like the schedules."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

from deploy.network.conditions import DirectionConditions, burst_share, bytes_per_s


@dataclass(frozen=True)
class _Moment:
    """What holds for a while: for ever, or for one row of a trace."""

    centre_s: float
    """Mean of the normal distribution of delays, before what is negative becomes 0, s."""
    loss: float
    bytes_per_s: float
    """Infinite: unlimited."""
    enter_burst: float
    """Probability that the next packet is the first of a burst."""


class Channel:
    """One direction's chances, drawn packet by packet from one stream of random numbers.

    Delays are an autoregression of first order: each has a normal distribution, and the given correlation with the one
    before. Losses come from the two states of Gilbert's and Elliott's channel where bursts are asked for, and are
    independent otherwise. Packets that never reach the air draw nothing.
    """

    def __init__(self, one_way: DirectionConditions, rng: random.Random) -> None:
        self._rng = rng
        self._trace = one_way.trace
        self._jitter_s = one_way.jitter_ms / 1e3
        self._correlation = one_way.jitter_correlation
        self._deviation: float | None = None
        self._bursts = one_way.loss_burst_packets > 0
        self._loss_in_burst = one_way.loss_in_burst
        self._loss_between = one_way.loss_between_bursts
        self._leave_burst = 1 / one_way.loss_burst_packets if self._bursts else 1.0
        self._in_burst: bool | None = None
        self.limited = one_way.bytes_per_s is not None
        """Whether there is a rate at all."""
        self._moments = _moments(one_way, self._leave_burst)
        self._silent = one_way.silent

    def bytes_per_s(self, time_s: float) -> float:
        """The rate, bytes/s; infinite: unlimited."""
        return self._at(time_s).bytes_per_s

    def draw_delay_s(self, time_s: float) -> float:
        """The delay of a packet that is sent at ``time_s``, s."""
        centre_s = self._at(time_s).centre_s
        if not self._jitter_s:
            return centre_s
        normal = self._rng.gauss(0.0, 1.0)
        if self._deviation is not None:
            normal = self._correlation * self._deviation + math.sqrt(1 - self._correlation**2) * normal
        self._deviation = normal
        return max(0.0, centre_s + self._jitter_s * normal)

    def draw_loss(self, time_s: float) -> bool:
        """Whether a packet that is sent at ``time_s`` is lost."""
        moment = self._at(time_s)
        if not self._bursts:
            return moment.loss > 0 and self._rng.random() < moment.loss
        in_burst = self._next_state(moment)
        if moment.loss in (0, 1):  # for a while nothing is lost, or everything
            return moment.loss == 1
        return self._rng.random() < (self._loss_in_burst if in_burst else self._loss_between)

    def passable_s(self, time_s: float) -> float:
        """The first time from ``time_s`` on at which not everything is lost; never: infinity."""
        if self._silent:
            return math.inf
        if self._trace is None:
            return time_s
        while not math.isinf(time_s) and self._at(time_s).loss == 1:
            # However the sum is rounded, time goes on.
            time_s = max(self._trace.row_ends_s(time_s), math.nextafter(time_s, math.inf))
        return time_s

    def _next_state(self, moment: _Moment) -> bool:
        draw = self._rng.random()
        if self._in_burst is None:
            share = moment.enter_burst / (moment.enter_burst + self._leave_burst)
            self._in_burst = draw < share
        elif self._in_burst:
            self._in_burst = draw >= self._leave_burst
        else:
            self._in_burst = draw < moment.enter_burst
        return self._in_burst

    def _at(self, time_s: float) -> _Moment:
        return self._moments[0 if self._trace is None else self._trace.row(time_s)]


def _moments(one_way: DirectionConditions, leave_burst: float) -> list[_Moment]:
    trace = one_way.trace
    rows = 1 if trace is None else len(trace.time_s)
    delays_ms = trace.delay_ms if trace and trace.delay_ms is not None else (one_way.delay_ms,) * rows
    losses = trace.loss if trace and trace.loss is not None else (one_way.loss,) * rows
    rates = trace.rate_mbit if trace and trace.rate_mbit is not None else (one_way.rate_mbit,) * rows
    moments = []
    for delay_ms, loss, rate_mbit in zip(delays_ms, losses, rates, strict=True):
        enter_burst = 0.0
        if one_way.loss_burst_packets and 0 < loss < 1:
            share = burst_share(loss, one_way.loss_in_burst, one_way.loss_between_bursts)
            enter_burst = leave_burst * share / (1 - share)
        rate = bytes_per_s(rate_mbit)
        moments.append(
            _Moment(
                centre_s=centre(delay_ms, one_way.jitter_ms) / 1e3,
                loss=loss,
                bytes_per_s=math.inf if rate is None else rate,
                enter_burst=enter_burst,
            )
        )
    return moments


def centre(mean: float, deviation: float) -> float:
    """Where a normal distribution with this deviation must be centred to have this mean once it is cut off at 0.

    With Φ and φ the standard normal distribution and density, max(0, X) of X ~ N(c, s²) has the mean
    c Φ(c/s) + s φ(c/s).
    ``deviation`` is at most ``mean``, as :class:`DirectionConditions` ensures.
    """
    if not deviation:
        return mean
    position = mean
    for _ in range(20):  # Newton's method: the derivative is Φ(c/s)
        ratio = position / deviation
        below = 0.5 * (1 + math.erf(ratio / math.sqrt(2)))
        excess = position * below + deviation * math.exp(-(ratio**2) / 2) / math.sqrt(2 * math.pi) - mean
        position -= excess / below
        if abs(excess) < 1e-12 * mean:
            break
    return position
