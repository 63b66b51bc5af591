"""How far another computer's clock is from this one's, how fast they part, and how wrong that can be.

One exchange asks the other clock for its time, as NTP does (RFC 5905, section 8). Whatever each way took, at least the
answer was made between question and return, so each exchange is an interval that holds the true offset, half the
round trip to either side of its middle:

    this clock      asked ──────────────────────── returned
    other clock            received ─ answered                 middle ± half the round trip

* The **estimate** is a line through the middles of the last minutes, the slower an exchange was beyond the fastest, the
  less it counts: what a message waits in a queue is on one way only, and moves the middle by half of it at most.
* The **bound** is what all intervals of the last seconds have in common, each widened by what the line's slope leaves
  open: about half the best round trip. It holds for any asymmetry, which no exchange of messages can tell from an
  offset.
* An interval that has nothing in common with that is a **jump** of one of the clocks (a computer that slept, say); when
  a few follow each other, everything earlier is forgotten.

Pure: no clock, no thread, no network.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

LINE_S = 300.0
"""Exchanges older than this do not shape the line; crystals keep their rate for minutes."""
BOUND_S = 30.0
"""Exchanges older than this do not bound the offset."""
CAPACITY = 3000
"""Exchanges kept: those of the line's time, ten in a second."""
USUAL_DRIFT = 100e-6
"""Standard deviation of the drift between two computers, before anything is known."""
LARGEST_DRIFT = 500e-6
"""Largest drift between two clocks; also the fastest that a kernel slews one."""
UNSEEN_DRIFT = 1e-6
"""What the drift may change by within the line's time, by temperature."""
JUMP_EXCHANGES = 3
"""So many exchanges in a row that contradict all before show that a clock has jumped."""
DOUBTFUL_EXCHANGES = 3
"""Exchanges that are taken to have erred by as much as they could, when the noise is judged."""
ROUNDING_NS = 1000
"""A round trip may seem this much shorter than nothing, because two clocks' ticks differ."""

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Exchange:
    """Question and answer; the first and the last time are this clock's, the two others the other one's."""

    asked_ns: int
    received_ns: int
    answered_ns: int
    returned_ns: int

    @property
    def round_trip_ns(self) -> int:
        """Time that both ways took together."""
        return (self.returned_ns - self.asked_ns) - (self.answered_ns - self.received_ns)

    @property
    def half_width_ns(self) -> float:
        """How far the true offset can be from :attr:`offset_ns`."""
        return max(0.0, self.round_trip_ns / 2)

    @property
    def middle_ns(self) -> int:
        """When, on this clock, the offset was what :attr:`offset_ns` says."""
        return (self.asked_ns + self.returned_ns) // 2

    @property
    def offset_ns(self) -> int:
        """The other clock minus this one, if both ways took the same time."""
        return (self.received_ns - self.asked_ns + self.answered_ns - self.returned_ns) // 2


@dataclass(frozen=True)
class OffsetEstimate:
    """The other clock minus this one, at a time and from then on."""

    at_ns: int
    """This clock's time for which the values below were estimated."""
    offset_ns: float
    bound_ns: float
    """Largest error of ``offset_ns``, whatever the two ways took."""
    drift: float
    """Seconds per second that the other clock gains."""
    drift_bound: float
    """Largest error of ``drift``."""
    best_round_trip_ns: float
    """Of the exchanges that bound the offset."""

    def at(self, now_ns: int) -> tuple[float, float]:
        """Offset and bound at another time of this clock, nanoseconds."""
        passed_ns = now_ns - self.at_ns
        return self.offset_ns + self.drift * passed_ns, self.bound_ns + self.drift_bound * abs(passed_ns)


class OffsetEstimator:
    """Follows the offset to one other clock, exchange by exchange."""

    def __init__(self) -> None:
        self.estimate: OffsetEstimate | None = None
        self.exchanges = 0
        """Exchanges taken, those before a jump too."""
        self.jumps = 0
        """How often a clock has jumped."""
        self.last_jump_ns = 0.0
        """By how much, as far as it is known."""
        self._suspects: list[Exchange] = []
        self._times, self._middles, self._halves = (np.zeros(CAPACITY) for _ in range(3))
        self._count = 0
        self._origin: Exchange | None = None

    def add(self, exchange: Exchange) -> OffsetEstimate:
        """Take one exchange, the newest; return the estimate as of it.

        Raises:
            ValueError: the ways took less than no time: these are not times of two clocks.
        """
        if exchange.round_trip_ns < -ROUNDING_NS:
            raise ValueError(f"round trip: expected 0 ns or more, got {exchange.round_trip_ns}")
        self.exchanges += 1
        if self.estimate is None:
            return self._begin([exchange])
        if self._contradicts(exchange, self.estimate):
            self._suspects.append(exchange)
            if len(self._suspects) < JUMP_EXCHANGES:
                return self.estimate
            before_ns, _ = self.estimate.at(exchange.middle_ns)
            after = self._begin(self._suspects)
            self.jumps += 1
            self.last_jump_ns = after.offset_ns - before_ns
            return after
        self._suspects = []
        self._keep(exchange)
        self.estimate = self._fit()
        return self.estimate

    def forget(self) -> None:
        """Begin anew: the other clock is another one."""
        self.estimate, self._suspects, self._count = None, [], 0

    def _begin(self, exchanges: list[Exchange]) -> OffsetEstimate:
        self._count, self._suspects, self._origin = 0, [], exchanges[0]
        for exchange in exchanges:
            self._keep(exchange)
        self.estimate = self._fit()
        return self.estimate

    @staticmethod
    def _contradicts(exchange: Exchange, estimate: OffsetEstimate) -> bool:
        """True if no offset is in both the exchange's interval and the estimate's."""
        offset_ns, bound_ns = estimate.at(exchange.middle_ns)
        return abs(exchange.offset_ns - offset_ns) > bound_ns + exchange.half_width_ns + ROUNDING_NS

    def _keep(self, exchange: Exchange) -> None:
        # Seconds since the first exchange, and beyond its offset: a float64 is too coarse for days in nanoseconds.
        assert self._origin is not None
        slot = self._count % CAPACITY
        self._times[slot] = (exchange.middle_ns - self._origin.middle_ns) / 1e9
        self._middles[slot] = (exchange.offset_ns - self._origin.offset_ns) / 1e9
        self._halves[slot] = exchange.half_width_ns / 1e9
        self._count += 1

    def _fit(self) -> OffsetEstimate:
        assert self._origin is not None
        kept = min(self._count, CAPACITY)
        now = float(self._times[(self._count - 1) % CAPACITY])
        ages = now - self._times[:kept]
        recent = ages <= LINE_S
        ages, middles, halves = ages[recent], self._middles[:kept][recent], self._halves[:kept][recent]
        offset, drift, drift_error = _line(-ages, middles, halves)
        drift_bound = min(LARGEST_DRIFT, 4.0 * drift_error + UNSEEN_DRIFT)
        bounding = ages <= BOUND_S
        ages, halves = ages[bounding], halves[bounding]
        # The clocks also part within an exchange, between its middle and either end.
        widths = halves * (1.0 + abs(drift) + drift_bound) + drift_bound * ages + ROUNDING_NS / 1e9
        moved = middles[bounding] + drift * ages
        low, high = float((moved - widths).max()), float((moved + widths).min())
        if low > high:
            # The rate has changed lately, by less than a jump: the best exchange alone speaks for now.
            best = int(widths.argmin())
            low, high = float(moved[best] - widths[best]), float(moved[best] + widths[best])
        offset = min(max(offset, low), high)
        return OffsetEstimate(
            at_ns=self._origin.middle_ns + round(now * 1e9),
            offset_ns=self._origin.offset_ns + offset * 1e9,
            bound_ns=max(high - offset, offset - low) * 1e9,
            drift=drift,
            drift_bound=drift_bound,
            best_round_trip_ns=float(halves.min()) * 2e9,
        )


def _line(times: Floats, middles: Floats, halves: Floats) -> tuple[float, float, float]:
    """Value at time 0, slope, and the slope's standard error, of a line through the middles.

    Least squares with the slope's usual size as prior knowledge, so that a few exchanges give no absurd slope.
    """
    excess = halves - halves.min()
    typical = max(float(np.median(excess)), 1e-6)
    weights = 1.0 / (typical**2 + excess**2)
    weights /= weights.mean()
    total = float(weights.sum())
    time = float(weights @ times) / total
    middle = float(weights @ middles) / total
    centred, deviations = times - time, middles - middle
    spread = float(weights @ centred**2)
    together = float(weights @ (centred * deviations))
    # Of a few exchanges, chance may make the noise seem small: it counts as if some had erred by the whole bound.
    doubt = DOUBTFUL_EXCHANGES * float(halves.min()) ** 2
    slope = 0.0
    for _ in range(2):  # the first time, what is drift counts as noise
        noise = max((float(weights @ (deviations - slope * centred) ** 2) + doubt) / total, 1e-14)
        prior = noise / USUAL_DRIFT**2
        slope = together / (spread + prior)
    variance = noise * float(weights**2 @ centred**2) + (prior * USUAL_DRIFT) ** 2
    return middle - slope * time, slope, math.sqrt(variance) / (spread + prior)
