from __future__ import annotations

import random
import statistics

import pytest

from deploy.network import PRESETS, DirectionConditions, NetworkConditions, Trace
from deploy.network.channel import Channel
from deploy.network.check_plan import DELAY, LOSS, RATE, duration_s, loss_error, pause_s, plan


def test_small_packets_are_farther_apart_than_the_jitter_and_as_many_as_the_tolerance_takes() -> None:
    delay = plan(PRESETS["wifi_bad"], "uplink", "packets")[0]
    assert (delay.number, delay.gap_s) == (DELAY, 0.06)
    # 3 standard errors of 15 ms within 2 ms: (45 / 2)^2 = 506.25.
    assert delay.blocks == 507


def test_as_many_packets_show_a_loss_as_make_its_tolerance_three_standard_errors() -> None:
    loss = plan(PRESETS["wifi_office"], "uplink", "packets")[1]
    # 225 x 0.995 / 0.005
    assert (loss.number, loss.blocks) == (LOSS, 44775)
    assert loss.blocks / loss.group * loss.gap_s == pytest.approx(44775 / 8000)


def test_a_link_without_a_rate_is_not_asked_for_it() -> None:
    assert [phase.number for phase in plan(PRESETS["ideal"], "uplink", "packets")] == [DELAY, LOSS]
    assert [phase.number for phase in plan(PRESETS["ideal"], "uplink", "stream")] == [DELAY]
    assert [phase.number for phase in plan(PRESETS["lan"], "uplink", "packets")] == [DELAY, LOSS, RATE]
    assert [phase.number for phase in plan(PRESETS["lan"], "uplink", "stream")] == [DELAY, RATE]


def test_a_rate_is_exceeded_by_a_quarter() -> None:
    rate = plan(PRESETS["lan"], "uplink", "packets")[2]
    assert rate.group * (rate.block_bytes + 28) / rate.gap_s == pytest.approx(1.25 * 12.5e6)


def test_small_packets_fill_neither_a_slow_link_nor_a_short_queue() -> None:
    one_way = DirectionConditions(rate_mbit=0.48, queue_packets=2)
    loss = plan(NetworkConditions(one_way), "uplink", "packets")[1]
    # 60 bytes each, at half of 60,000 bytes/s.
    assert (loss.group, loss.gap_s) == (1, pytest.approx(1 / 500))


def test_each_direction_has_its_own_plan() -> None:
    conditions = NetworkConditions(DirectionConditions(), DirectionConditions(delay_ms=20, jitter_ms=10))
    assert plan(conditions, "uplink", "packets")[0].gap_s == 0.005
    assert plan(conditions, "downlink", "packets")[0].gap_s == 0.04


@pytest.mark.parametrize("transport", ["packets", "stream"])
def test_no_preset_takes_longer_than_40_seconds(transport: str) -> None:
    for conditions in PRESETS.values():
        phases = plan(conditions, "uplink", transport)  # type: ignore[arg-type]
        assert duration_s(phases, pause_s(conditions)) < 40


def test_a_trace_is_followed_from_its_beginning_to_its_end() -> None:
    one_way = DirectionConditions(trace=Trace("t", (0, 5), delay_ms=(3, 4), rate_mbit=(8, 16)))
    delay, _, rate = plan(NetworkConditions(one_way), "uplink", "packets")
    assert delay.blocks * delay.gap_s == pytest.approx(10)
    assert rate.group * (rate.block_bytes + 28) / rate.gap_s == pytest.approx(1.25 * 2e6)


@pytest.mark.parametrize(
    "one_way",
    [
        DirectionConditions(loss=0.1),
        DirectionConditions(loss=0.1, loss_burst_packets=5),
        DirectionConditions(loss=0.1, loss_burst_packets=5, loss_in_burst=0.5, loss_between_bursts=0.02),
    ],
    ids=["independent", "bursts", "partial bursts"],
)
def test_the_standard_error_of_a_loss_is_what_repetitions_scatter_by(one_way: DirectionConditions) -> None:
    fractions = []
    for seed in range(400):
        channel = Channel(one_way, random.Random(seed))
        fractions.append(statistics.fmean(channel.draw_loss(0.0) for _ in range(500)))
    # The standard deviation of 400 is known to 3.5 %; with bursts a little of it is the beginning.
    assert statistics.stdev(fractions) == pytest.approx(loss_error(one_way, 500), rel=0.12)
