from __future__ import annotations

import random
import statistics

import pytest

from deploy.network import (
    PRESETS,
    DirectionConditions,
    DropCause,
    NetworkConditions,
    OutageTimes,
    PacketSchedule,
    StreamSchedule,
    direction_random,
)


def _conditions(uplink: DirectionConditions, outage_every_s: float = 0.0, outage_s: float = 0.0) -> NetworkConditions:
    return NetworkConditions(uplink, DirectionConditions(), outage_every_s, outage_s)


def _packets(uplink: DirectionConditions, outage_every_s: float = 0.0, outage_s: float = 0.0) -> PacketSchedule:
    return PacketSchedule(_conditions(uplink, outage_every_s, outage_s), "uplink", random.Random(7))


def _stream(uplink: DirectionConditions, outage_every_s: float = 0.0, outage_s: float = 0.0) -> StreamSchedule:
    return StreamSchedule(_conditions(uplink, outage_every_s, outage_s), "uplink", random.Random(7))


def test_the_ideal_link_delivers_at_once() -> None:
    schedule = _packets(DirectionConditions())
    assert [schedule.offer(t, 1500) for t in (0.0, 0.25, 0.25)] == [0.0, 0.25, 0.25]


def test_a_packet_takes_its_size_over_the_rate_and_then_the_delay() -> None:
    # 8 Mbit/s are 1000 bytes per ms.
    schedule = _packets(DirectionConditions(delay_ms=5, rate_mbit=8))
    assert schedule.offer(1.0, 1500) == pytest.approx(1.0065)


def test_packets_wait_for_those_before_them() -> None:
    schedule = _packets(DirectionConditions(delay_ms=5, rate_mbit=8))
    assert [schedule.offer(1.0, 1000) for _ in range(3)] == pytest.approx([1.006, 1.007, 1.008])
    assert schedule.max_queue_delay_s == pytest.approx(0.002)
    # The queue has been empty since 1.003.
    assert schedule.offer(1.5, 1000) == pytest.approx(1.506)


def test_a_packet_that_would_wait_longer_than_the_queue_is_dropped() -> None:
    schedule = _packets(DirectionConditions(rate_mbit=8, queue_ms=2.5))
    outcomes = [schedule.offer(0.0, 1000) for _ in range(5)]
    # Waiting 0, 1 and 2 ms; then 3 ms, twice, for a dropped packet takes no time.
    assert outcomes[:3] == pytest.approx([0.001, 0.002, 0.003])
    assert outcomes[3:] == [DropCause.QUEUE, DropCause.QUEUE]
    assert schedule.offer(0.001, 1000) == pytest.approx(0.004)


def test_a_packet_that_would_wait_behind_too_many_is_dropped() -> None:
    schedule = _packets(DirectionConditions(rate_mbit=8, queue_packets=2))
    outcomes = [schedule.offer(0.0, 1000) for _ in range(5)]
    # One on the air and two that wait.
    assert outcomes[:3] == pytest.approx([0.001, 0.002, 0.003])
    assert outcomes[3:] == [DropCause.QUEUE, DropCause.QUEUE]
    # At 1.5 ms one of them is on the air and one waits; the next has room, and the one after it has not.
    assert schedule.offer(0.0015, 1000) == pytest.approx(0.004)
    assert schedule.offer(0.0015, 1000) is DropCause.QUEUE
    assert schedule.offer(0.1, 1000) == pytest.approx(0.101)


def test_a_stream_may_wait_for_as_many_segments_as_the_queue_holds() -> None:
    # 1448 bytes take 1.448 ms.
    assert _stream(DirectionConditions(rate_mbit=8)).queue_s(0.0) == pytest.approx(0.2)
    assert _stream(DirectionConditions(rate_mbit=8, queue_packets=10)).queue_s(0.0) == pytest.approx(0.01448)
    assert _stream(DirectionConditions(rate_mbit=8, queue_ms=5, queue_packets=10)).queue_s(0.0) == pytest.approx(0.005)


def test_each_direction_has_its_own_conditions() -> None:
    conditions = NetworkConditions(DirectionConditions(delay_ms=1), DirectionConditions(delay_ms=2))
    assert PacketSchedule(conditions, "uplink", random.Random(0)).offer(0.0, 100) == pytest.approx(0.001)
    assert PacketSchedule(conditions, "downlink", random.Random(0)).offer(0.0, 100) == pytest.approx(0.002)


@pytest.mark.parametrize("name", PRESETS)
def test_packets_are_never_reordered_nor_delivered_before_they_were_sent(name: str) -> None:
    rng = random.Random(1)
    schedule = PacketSchedule(PRESETS[name], "uplink", rng)
    now_s = last_s = 0.0
    for _ in range(20_000):
        now_s += rng.expovariate(1000)
        outcome = schedule.offer(now_s, rng.randrange(40, 1501))
        if not isinstance(outcome, DropCause):
            assert outcome >= now_s
            assert outcome >= last_s
            last_s = outcome


def test_jitter_has_the_standard_deviation_it_was_given() -> None:
    schedule = _packets(DirectionConditions(delay_ms=20, jitter_ms=4))
    delays_ms = []
    for number in range(4000):  # far enough apart not to hold each other up
        outcome = schedule.offer(float(number), 100)
        assert not isinstance(outcome, DropCause)
        delays_ms.append((outcome - number) * 1e3)
    # The standard errors are 0.063 and 0.045 ms.
    assert statistics.mean(delays_ms) == pytest.approx(20, abs=0.3)
    assert statistics.stdev(delays_ms) == pytest.approx(4, abs=0.2)


def test_the_fraction_of_lost_packets_is_the_loss() -> None:
    schedule = _packets(DirectionConditions(loss=0.02))
    lost = [schedule.offer(number / 1000, 1500) for number in range(50_000)].count(DropCause.LOSS)
    # 1000 expected, standard deviation 31.
    assert 870 < lost < 1130


def test_a_lost_packet_has_taken_its_time_on_the_air() -> None:
    schedule = _packets(DirectionConditions(rate_mbit=8, loss=1.0, queue_ms=1.5))
    outcomes = [schedule.offer(0.0, 1000) for _ in range(3)]
    assert outcomes == [DropCause.LOSS, DropCause.LOSS, DropCause.QUEUE]


def test_the_same_seed_gives_the_same_fates_and_another_direction_others() -> None:
    def fates(seed: int, direction: str) -> list[float | DropCause]:
        assert direction in ("uplink", "downlink")
        schedule = PacketSchedule(PRESETS["wifi_bad"], direction, direction_random(seed, direction))  # type: ignore[arg-type]
        return [schedule.offer(number / 100, 1000) for number in range(200)]

    assert fates(3, "uplink") == fates(3, "uplink")
    assert fates(3, "uplink") != fates(4, "uplink")
    assert fates(3, "uplink") != fates(3, "downlink")


@pytest.mark.parametrize(
    ("sent_s", "arrives"),
    [
        (0.0, True),
        (0.25, True),  # an outage every 2 s begins with the second one
        (1.984375, True),  # 1/64 s on its way: there at 2 s - 1/64 + 1/128
        (1.9921875, False),  # 1/128 s of delay: in flight at 2 s
        (2.0, False),
        (2.49, False),
        (2.5, True),
        (3.0, True),
        (4.0, False),
        (4.5, True),
    ],
)
def test_an_outage_loses_what_is_sent_or_in_flight(sent_s: float, arrives: bool) -> None:
    schedule = _packets(DirectionConditions(delay_ms=7.8125), outage_every_s=2.0, outage_s=0.5)
    expected = sent_s + 0.0078125 if arrives else DropCause.OUTAGE
    assert schedule.offer(sent_s, 100) == expected


def test_an_outage_loses_what_is_queued_and_leaves_an_empty_queue() -> None:
    schedule = _packets(DirectionConditions(rate_mbit=8), outage_every_s=1.0, outage_s=0.01)
    # 1000 bytes take 1 ms: of 100 packets sent 50.5 ms before the outage, 50 get through.
    outcomes = [schedule.offer(0.9495, 1000) for _ in range(100)]
    assert outcomes.count(DropCause.OUTAGE) == 50
    assert schedule.offer(1.01, 1000) == pytest.approx(1.011)


def test_outages_are_listed_from_their_beginning_on() -> None:
    outages = OutageTimes(every_s=2.0, length_s=0.5)
    assert outages.until(1.99) == []
    assert outages.until(2.0) == [(2.0, 2.5)]
    assert outages.until(6.2) == [(2.0, 2.5), (4.0, 4.5), (6.0, 6.5)]


@pytest.mark.parametrize(
    ("time_s", "live_s"), [(0, 0), (1.5, 1.5), (2, 2), (2.25, 2), (2.5, 2), (3, 2.5), (4.25, 3.5), (5, 4)]
)
def test_live_time_stands_still_during_an_outage(time_s: float, live_s: float) -> None:
    assert OutageTimes(every_s=2.0, length_s=0.5).to_live(time_s) == live_s


@pytest.mark.parametrize(
    ("start_s", "live_s", "end_s"),
    [(0, 1, 1), (1.5, 0.5, 2.5), (1.5, 1, 3), (2.25, 0, 2.5), (2.25, 1, 3.5), (2.5, 1.5, 4.5), (1, 10, 14.5)],
)
def test_what_takes_a_while_takes_longer_by_the_outages_in_between(start_s: float, live_s: float, end_s: float) -> None:
    assert OutageTimes(every_s=2.0, length_s=0.5).after(start_s, live_s) == end_s


@pytest.mark.parametrize("every_s", [0.1, 0.3, 0.5, 0.7, 20.0])
def test_what_begins_in_an_outage_ends_at_its_end_whatever_the_rounding(every_s: float) -> None:
    outages = OutageTimes(every_s, 0.6 * every_s)
    for number in range(1, 1000):
        inside_s = (number + 0.3) * every_s
        assert outages.after(inside_s, 0.0) == pytest.approx((number + 0.6) * every_s)


def test_a_stream_is_delayed_and_paced_like_packets() -> None:
    schedule = _stream(DirectionConditions(delay_ms=5, rate_mbit=8))
    assert [schedule.offer(1.0, 1000).delivery_s for _ in range(2)] == pytest.approx([1.006, 1.007])
    assert schedule.backlog_s(1.0) == pytest.approx(0.002)
    assert schedule.backlog_s(1.5) == 0


def test_a_lost_segment_comes_later_by_a_round_trip_and_a_quarter() -> None:
    conditions = NetworkConditions(DirectionConditions(delay_ms=20, loss=0.5), DirectionConditions(delay_ms=60))
    schedule = StreamSchedule(conditions, "uplink", random.Random(7))
    segments = [schedule.offer(0.0, 1448) for _ in range(100)]
    assert 30 < sum(segment.retransmitted for segment in segments) < 70
    for segment in segments:
        assert segment.delivery_s == pytest.approx(0.12 if segment.retransmitted else 0.02)


def test_a_link_that_loses_everything_never_delivers() -> None:
    assert _stream(DirectionConditions(loss=1.0)).offer(0.0, 1448).delivery_s == float("inf")


def test_a_stream_waits_for_the_end_of_an_outage() -> None:
    schedule = _stream(DirectionConditions(delay_ms=125), outage_every_s=2.0, outage_s=0.5)
    assert schedule.offer(1.5, 100).delivery_s == 1.625
    # Half of its way before the outage, half after it.
    assert schedule.offer(1.9375, 100).delivery_s == 2.5625
    assert schedule.offer(2.25, 100).delivery_s == 2.625


def test_the_backlog_of_a_stream_does_not_shrink_during_an_outage() -> None:
    schedule = _stream(DirectionConditions(rate_mbit=8), outage_every_s=2.0, outage_s=0.5)
    schedule.offer(1.75, 500_000)  # half a second's worth, of which a quarter is sent before the outage
    assert schedule.backlog_s(2.0) == schedule.backlog_s(2.4) == pytest.approx(0.25)
    assert schedule.backlog_s(2.75) == pytest.approx(0.0)
