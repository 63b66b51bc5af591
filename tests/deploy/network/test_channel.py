from __future__ import annotations

import itertools
import math
import random
import statistics

import pytest

from deploy.network import DirectionConditions, Trace
from deploy.network.channel import Channel, centre


def _losses(one_way: DirectionConditions, count: int) -> list[bool]:
    channel = Channel(one_way, random.Random(11))
    return [channel.draw_loss(0.0) for _ in range(count)]


def _runs(losses: list[bool]) -> list[int]:
    """Lengths of the runs of losses."""
    return [len(list(run)) for lost, run in itertools.groupby(losses) if lost]


@pytest.mark.parametrize(("delay_ms", "jitter_ms"), [(20, 15), (3, 2), (5, 5), (20, 1)])
def test_the_mean_delay_is_the_delay_though_none_is_negative(delay_ms: float, jitter_ms: float) -> None:
    channel = Channel(DirectionConditions(delay_ms=delay_ms, jitter_ms=jitter_ms), random.Random(3))
    delays_ms = [channel.draw_delay_s(0.0) * 1e3 for _ in range(20_000)]
    assert min(delays_ms) >= 0
    # The standard error is jitter / 141.
    assert statistics.mean(delays_ms) == pytest.approx(delay_ms, abs=jitter_ms / 35)


def test_the_centre_of_a_cut_off_distribution_is_what_its_formula_says() -> None:
    # At c = s: c Φ(1) + s φ(1) = 0.841345 + 0.241971.
    assert centre(1.083316, 1.0) == pytest.approx(1.0, abs=1e-5)
    assert centre(3.0, 0.0) == 3.0


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
def test_consecutive_delays_have_the_correlation_and_all_the_jitter(correlation: float) -> None:
    one_way = DirectionConditions(delay_ms=50, jitter_ms=5, jitter_correlation=correlation)
    channel = Channel(one_way, random.Random(5))
    delays_ms = [channel.draw_delay_s(0.0) * 1e3 for _ in range(40_000)]
    assert statistics.correlation(delays_ms[:-1], delays_ms[1:]) == pytest.approx(correlation, abs=0.02)
    # 40,000 x (1 - 0.9) / (1 + 0.9) = 2,100 independent ones: a standard error of 5 / sqrt(2 x 2,100) = 0.08.
    assert statistics.stdev(delays_ms) == pytest.approx(5, abs=0.3)


def test_losses_without_bursts_are_independent() -> None:
    losses = _losses(DirectionConditions(loss=0.2), 50_000)
    assert sum(losses) / 50_000 == pytest.approx(0.2, abs=0.006)
    # A run of independent losses goes on with probability 0.2: its mean length is 1 / 0.8.
    assert statistics.mean(_runs(losses)) == pytest.approx(1.25, abs=0.03)


def test_bursts_have_their_mean_length_and_keep_the_mean_loss() -> None:
    losses = _losses(DirectionConditions(loss=0.1, loss_burst_packets=8), 400_000)
    runs = _runs(losses)
    # About 5,000 runs with a standard deviation of 7.5: standard errors of 0.11 packets and 0.0018.
    assert statistics.mean(runs) == pytest.approx(8, abs=0.4)
    assert sum(losses) / len(losses) == pytest.approx(0.1, abs=0.007)


def test_a_burst_may_lose_only_some_and_the_rest_a_few() -> None:
    one_way = DirectionConditions(loss=0.05, loss_burst_packets=20, loss_in_burst=0.5, loss_between_bursts=0.01)
    losses = _losses(one_way, 400_000)
    assert sum(losses) / len(losses) == pytest.approx(0.05, abs=0.005)
    after_loss = [later for earlier, later in itertools.pairwise(losses) if earlier]
    # Bursts hold (0.05 - 0.01) / 0.49 = 8.16 % of the packets and 81.6 % of the losses. After a loss the next packet is
    # in a burst with 0.816 x 0.95 + 0.184 x 0.00444 = 0.776, so it is lost with 0.776 x 0.5 + 0.224 x 0.01 = 0.390.
    assert statistics.mean(after_loss) == pytest.approx(0.390, abs=0.02)


def test_the_first_packet_may_be_in_a_burst() -> None:
    one_way = DirectionConditions(loss=0.5, loss_burst_packets=1000)
    first = [Channel(one_way, random.Random(seed)).draw_loss(0.0) for seed in range(400)]
    assert sum(first) / 400 == pytest.approx(0.5, abs=0.1)


def test_bursts_follow_the_loss_of_a_trace() -> None:
    one_way = DirectionConditions(loss_burst_packets=4, trace=Trace("t", (0, 1, 2), loss=(0, 0.4, 1)))
    channel = Channel(one_way, random.Random(2))
    assert not any(channel.draw_loss(0.5) for _ in range(100))
    assert statistics.mean(channel.draw_loss(1.5) for _ in range(40_000)) == pytest.approx(0.4, abs=0.02)
    assert all(channel.draw_loss(2.5) for _ in range(100))


def test_a_link_is_passable_again_when_its_trace_stops_losing_everything() -> None:
    channel = Channel(DirectionConditions(trace=Trace("t", (0, 1, 2), loss=(1, 1, 0.5))), random.Random(0))
    assert channel.passable_s(0.25) == 2.0
    assert channel.passable_s(2.5) == 2.5
    assert channel.passable_s(3.25) == 5.0
    assert Channel(DirectionConditions(loss=1), random.Random(0)).passable_s(1.0) == math.inf
