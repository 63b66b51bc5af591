"""The offset between two clocks over links of known delays: found, followed, and never further off than said."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from common.clock_offset import JUMP_EXCHANGES, Exchange, OffsetEstimate, OffsetEstimator

MS = 1_000_000
PERIOD_S = 0.1
Delay = Callable[[np.random.Generator], float]


def normal(mean_ms: float, deviation_ms: float) -> Delay:
    return lambda rng: max(0.0, rng.normal(mean_ms, deviation_ms)) / 1000


def uniform(mean_ms: float, width_ms: float) -> Delay:
    return lambda rng: rng.uniform(mean_ms - width_ms, mean_ms + width_ms) / 1000


def queueing(least_ms: float, mean_wait_ms: float) -> Delay:
    return lambda rng: (least_ms + rng.exponential(mean_wait_ms)) / 1000


@dataclass
class OtherClock:
    """A clock that is ahead by ``offset_s`` at time 0, gains ``drift_ppm``, and jumps when told."""

    offset_s: float = 3.0
    drift_ppm: float = 50.0
    jumped_s: float = 0.0

    def shows(self, seconds: float) -> float:
        return seconds * (1 + self.drift_ppm * 1e-6) + self.offset_s + self.jumped_s


@dataclass(frozen=True)
class Judged:
    """An estimate beside the truth."""

    seconds: float
    error_ms: float
    bound_ms: float
    drift_error_ppm: float


class Link:
    """Exchanges one after the other over a link; every estimate is judged at the time at which it is made."""

    def __init__(self, up: Delay, down: Delay, seed: int = 0, other: OtherClock | None = None) -> None:
        self.up, self.down = up, down
        self.other = other or OtherClock()
        self.estimator = OffsetEstimator()
        self.seconds = 0.0
        self._rng = np.random.default_rng(seed)

    def exchange(self) -> Exchange:
        there = self.seconds + self.up(self._rng)
        answered = there + 20e-6
        back = answered + self.down(self._rng)
        times = (self.seconds, self.other.shows(there), self.other.shows(answered), back)
        self.seconds = back
        return Exchange(*(round(time * 1e9) for time in times))

    def run(self, seconds: float) -> list[Judged]:
        end, judged = self.seconds + seconds, []
        while self.seconds < end:
            estimate = self.estimator.add(self.exchange())
            judged.append(self.judge(estimate))
            self.seconds += PERIOD_S
        return judged

    def judge(self, estimate: OffsetEstimate) -> Judged:
        offset_ns, bound_ns = estimate.at(round(self.seconds * 1e9))
        true_ns = (self.other.shows(self.seconds) - self.seconds) * 1e9
        drift_error_ppm = estimate.drift * 1e6 - self.other.drift_ppm
        return Judged(self.seconds, (offset_ns - true_ns) / MS, bound_ns / MS, drift_error_ppm)


def worst(judged: list[Judged], after_s: float = 0.0) -> float:
    return max(abs(one.error_ms) for one in judged if one.seconds >= after_s)


# ------------------------------------------------------------------ arithmetic by hand


def test_equal_ways_give_the_offset_exactly():
    # 100 -> 107 on the way (3 of them offset), answered at 109, back at 110 by this clock: 4 + 4 of round trip.
    exchange = Exchange(100, 107, 109, 110)
    assert (exchange.round_trip_ns, exchange.offset_ns, exchange.middle_ns) == (8, 3, 105)


def test_unequal_ways_err_by_half_their_difference():
    # The truth is 1000; 30 there, 10 back.
    exchange = Exchange(0, 1030, 1030, 40)
    assert (exchange.round_trip_ns, exchange.offset_ns, exchange.half_width_ns) == (40, 1010, 20)


def test_the_first_exchange_already_gives_an_estimate_with_half_its_round_trip_as_bound():
    estimate = OffsetEstimator().add(Exchange(0, 1_030_000, 1_030_000, 40_000))
    assert estimate.offset_ns == 1_010_000
    assert estimate.bound_ns == pytest.approx(20_000, abs=1_100)  # and the clocks' ticks
    assert estimate.best_round_trip_ns == 40_000


def test_the_bound_grows_while_nothing_is_heard():
    estimate = OffsetEstimate(
        at_ns=0, offset_ns=5.0, bound_ns=100.0, drift=2e-6, drift_bound=1e-6, best_round_trip_ns=1
    )
    assert estimate.at(1_000_000) == pytest.approx((7.0, 101.0))
    assert estimate.at(-1_000_000) == pytest.approx((3.0, 101.0))


def test_a_round_trip_of_less_than_nothing_is_refused():
    with pytest.raises(ValueError, match="round trip: expected 0 ns or more, got -5000"):
        OffsetEstimator().add(Exchange(0, 100, 10_100, 5_000))


def test_days_between_the_clocks_cost_no_precision():
    """Two computers that were started a month apart."""
    link = Link(uniform(1.0, 0.0), uniform(1.0, 0.0), other=OtherClock(offset_s=2.6e6, drift_ppm=0.0))
    assert worst(link.run(20.0)) < 0.001


# ------------------------------------------------------------------ what is promised


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("delay", [normal(20, 5), uniform(20, 5), queueing(15, 5)], ids=["normal", "uniform", "queue"])
def test_offset_and_drift_are_recovered_within_a_millisecond_over_a_jittery_link(delay, seed):
    """An offset of 3 s and a drift of 50 ppm; both ways 20 ms, give or take 5."""
    link = Link(delay, delay, seed)
    judged = link.run(420.0)
    assert worst(judged, after_s=120.0) < 1.0
    assert all(abs(one.error_ms) <= one.bound_ms for one in judged)
    assert abs(judged[-1].drift_error_ppm) < 5.0
    assert link.estimator.jumps == 0


@pytest.mark.parametrize(
    ("up", "down", "error_ms"),
    [
        (uniform(30, 0), uniform(10, 0), 10.0),
        (uniform(5, 0), uniform(65, 0), -30.0),
        (normal(30, 5), normal(10, 3), 10.0),
        (queueing(2, 20), queueing(2, 0.5), None),
    ],
    ids=["uplink slower", "downlink slower", "with jitter", "a queue one way"],
)
def test_over_an_asymmetric_link_the_stated_bound_covers_the_error(up, down, error_ms):
    link = Link(up, down, seed=1)
    judged = link.run(300.0)
    assert all(abs(one.error_ms) <= one.bound_ms for one in judged)
    assert link.estimator.jumps == 0
    if error_ms is not None:  # half the difference, as it must be: no exchange can tell it from an offset
        assert judged[-1].error_ms == pytest.approx(error_ms, abs=1.0)


def test_the_bound_is_about_half_the_best_round_trip():
    link = Link(uniform(20, 5), uniform(20, 5))
    (*_, last) = link.run(120.0)
    assert link.estimator.estimate.best_round_trip_ns / MS == pytest.approx(30.0, abs=2.0)
    assert last.bound_ms == pytest.approx(15.0, abs=2.0)


def test_a_queue_that_fills_in_one_direction_only_hardly_moves_the_estimate():
    link = Link(queueing(2, 0.3), queueing(2, 0.3))
    link.run(60.0)
    link.up = queueing(2, 60)  # an upload begins: the middles of most exchanges move by 30 ms
    judged = link.run(60.0)
    assert worst(judged) < 0.5
    assert link.estimator.jumps == 0


def test_a_drift_that_changes_slowly_is_followed():
    link = Link(uniform(20, 5), uniform(20, 5))
    link.run(300.0)
    for _ in range(10):  # by 5 ppm in ten minutes, as a computer warms up
        before = link.other.shows(link.seconds)
        link.other.drift_ppm += 0.5
        link.other.offset_s += before - link.other.shows(link.seconds)
        assert worst(link.run(60.0)) < 1.0
    assert link.estimator.jumps == 0


def test_an_outage_leaves_an_estimate_whose_bound_still_holds():
    link = Link(uniform(20, 5), uniform(20, 5))
    link.run(60.0)
    link.seconds += 90.0
    away = link.judge(link.estimator.estimate)
    assert abs(away.error_ms) <= away.bound_ms
    assert worst(link.run(5.0)) < 2.0
    assert link.estimator.jumps == 0


# ------------------------------------------------------------------ jumps


@pytest.mark.parametrize("jump_s", [-3600.0, -0.1, 0.05, 7.5])
def test_a_clock_that_jumps_is_noticed_within_a_few_exchanges_and_found_anew(jump_s):
    link = Link(uniform(20, 5), uniform(20, 5))
    link.run(60.0)
    link.other.jumped_s = jump_s
    link.run(JUMP_EXCHANGES * (PERIOD_S + 0.05))
    assert link.estimator.jumps == 1
    assert link.estimator.last_jump_ns / 1e9 == pytest.approx(jump_s, abs=0.01)
    judged = link.run(180.0)
    assert all(abs(one.error_ms) <= one.bound_ms for one in judged)
    assert worst(judged, after_s=link.seconds - 60.0) < 1.0
    assert link.estimator.jumps == 1


def test_one_odd_exchange_is_no_jump_and_does_not_count():
    link, other = Link(uniform(20, 1), uniform(20, 1)), OtherClock()
    link.run(30.0)
    link.other = OtherClock(jumped_s=1.0)
    for _ in range(JUMP_EXCHANGES - 1):
        link.estimator.add(link.exchange())
    link.other = other
    judged = link.run(30.0)
    assert link.estimator.jumps == 0
    assert worst(judged) < 0.5


def test_a_jump_that_the_link_hides_leaves_the_bound_within_half_a_minute():
    """3 ms on a link whose round trip leaves 15 ms open: nobody can see it at once."""
    link = Link(uniform(20, 5), uniform(20, 5))
    link.run(300.0)
    link.other.jumped_s = 0.003
    judged = link.run(90.0)
    assert all(abs(one.error_ms) <= one.bound_ms for one in judged)


def test_another_computer_s_clock_is_no_jump():
    link = Link(uniform(20, 5), uniform(20, 5))
    link.run(30.0)
    link.estimator.forget()
    link.other = OtherClock(offset_s=-9.0, drift_ppm=-20.0)
    assert worst(link.run(200.0), after_s=150.0) < 1.0
    assert link.estimator.jumps == 0
