from __future__ import annotations

import pytest

from deploy.network import DirectionConditions, NetworkConditions, Trace
from deploy.network.check_plan import DELAY, LOSS, RATE
from deploy.network.check_rows import Crossed, Row, compare
from deploy.network.part import DirectionCounts
from deploy.network.probe import Phase, Received, Sent, Transport

_START_NS = 1_000_000_000_000
_MS = 1_000_000


def _number(phase: int, index: int) -> int:
    return Phase(phase, 1, 32, 0.0).block_number(index)


def _crossed(
    one_way: DirectionConditions,
    sent: Sent,
    received: Received,
    transport: Transport = "packets",
    counts: DirectionCounts | None = None,
    outage_every_s: float = 0.0,
    outage_s: float = 0.0,
    lost_take_their_turn: bool = True,
) -> dict[str, Row]:
    conditions = NetworkConditions(one_way, one_way, outage_every_s, outage_s)
    crossed = Crossed(
        conditions,
        "uplink",
        transport,
        _START_NS,
        sent,
        received,
        counts or DirectionCounts(),
        lost_take_their_turn,
    )
    return {row.quantity: row for row in compare(crossed)}


def _delays(delays_ms: list[float], gap_ms: int = 10) -> tuple[Sent, Received]:
    sent = [(_number(DELAY, i), _START_NS + i * gap_ms * _MS) for i in range(len(delays_ms))]
    return sent, [(n, t, t + round(ms * _MS)) for (n, t), ms in zip(sent, delays_ms, strict=True)]


@pytest.mark.parametrize(("measured_ms", "ok"), [(4.55, True), (5.45, True), (4.4, False), (5.6, False)])
def test_a_mean_delay_may_be_off_by_a_tenth(measured_ms: float, ok: bool) -> None:
    row = _crossed(DirectionConditions(delay_ms=5), *_delays([measured_ms - 1, measured_ms + 1]))["mean delay"]
    assert (row.expected, row.measured, row.allowed) == (5, pytest.approx(measured_ms), pytest.approx(0.5))
    assert row.ok is ok


def test_a_small_packet_takes_its_time_at_the_rate() -> None:
    # 60 bytes at 60,000 bytes/s
    rows = _crossed(DirectionConditions(delay_ms=5, rate_mbit=0.48), *_delays([6.0]))
    assert rows["mean delay"].expected == pytest.approx(6)


def test_over_a_relay_a_mean_delay_holds_what_losses_cost() -> None:
    # A lost segment comes a round trip and a quarter later: 25 ms, for one in ten.
    rows = _crossed(DirectionConditions(delay_ms=10, loss=0.1), *_delays([12.5]), transport="stream")
    assert rows["mean delay"].expected == pytest.approx(12.5)


def test_a_delay_is_compared_with_the_trace_at_the_time_of_sending() -> None:
    one_way = DirectionConditions(trace=Trace("t", (0, 0.025), delay_ms=(4, 10), end="stop"))
    row = _crossed(one_way, *_delays([4, 4, 4, 10]))["mean delay"]
    assert row.expected == row.measured == pytest.approx(5.5)


def test_packets_near_an_outage_say_nothing() -> None:
    # Silent from 1 s to 1.1 s; sent every 0.4 s, 0.8 s and 1.2 s are nearer than 0.5 s to it.
    sent, received = _delays([5, 5, 90, 90, 5], gap_ms=400)
    row = _crossed(DirectionConditions(delay_ms=5), sent, received, outage_every_s=5, outage_s=0.1)["mean delay"]
    assert row.measured == pytest.approx(39)  # no outage within 2 s
    row = _crossed(DirectionConditions(delay_ms=5), sent, received, outage_every_s=1, outage_s=0.1)["mean delay"]
    assert row.measured == pytest.approx(5)


def _losses(packets: int, lost: int) -> tuple[Sent, Received]:
    sent = [(_number(LOSS, i), _START_NS + i * _MS) for i in range(packets)]
    return sent, [(n, t, t) for n, t in sent[lost:]]


@pytest.mark.parametrize(("lost", "ok"), [(85, True), (115, True), (75, False), (125, False)])
def test_a_loss_may_be_off_by_a_fifth_of_itself(lost: int, ok: bool) -> None:
    # 3 standard errors of 10,000 packets are 0.3 %, so let the loss be 20 % of 500 packets.
    row = _crossed(DirectionConditions(loss=0.2), *_losses(500, lost))["loss"]
    assert (row.expected, row.measured) == (pytest.approx(20), pytest.approx(lost / 5))
    # 3 x sqrt(0.2 x 0.8 / 500) = 5.4 %
    assert row.allowed == pytest.approx(5.367, abs=0.001)
    row = _crossed(DirectionConditions(loss=0.2), *_losses(50_000, 100 * lost))["loss"]
    assert row.allowed == pytest.approx(4)
    assert row.ok is ok


def test_a_link_that_loses_nothing_may_lose_one_in_two_thousand() -> None:
    assert _crossed(DirectionConditions(), *_losses(2000, 1))["loss"].ok
    assert not _crossed(DirectionConditions(), *_losses(2000, 2))["loss"].ok


def test_a_relay_counts_what_it_would_have_lost() -> None:
    counts = DirectionCounts(packets_in=5000, retransmitted=260)
    row = _crossed(DirectionConditions(loss=0.05), *_delays([5.0]), transport="stream", counts=counts)["loss"]
    assert row.measured == pytest.approx(5.2)
    assert row.ok


def _flood(seconds: float, per_s: int, delivered_share: float) -> tuple[Sent, Received]:
    sent = [(_number(RATE, i), _START_NS + i * 1_000_000_000 // per_s) for i in range(int(seconds * per_s))]
    kept = round(1 / (1 - delivered_share)) if delivered_share < 1 else 0
    return sent, [(n, t, t) for i, (n, t) in enumerate(sent) if not kept or i % kept]


def test_a_rate_is_what_arrived_in_the_time() -> None:
    # 1000 packets of 1428 bytes per second, every fifth one dropped by the queue: 800 x 1428 x 8 = 9.1392 Mbit/s.
    rows = _crossed(DirectionConditions(rate_mbit=9.1392), *_flood(2.5, 1000, 0.8))
    assert rows["rate"].measured == pytest.approx(9.1392, rel=0.005)
    assert rows["rate"].allowed == pytest.approx(0.91392)
    assert rows["rate"].ok
    assert not _crossed(DirectionConditions(rate_mbit=8), *_flood(2.5, 1000, 0.8))["rate"].ok


def test_what_is_lost_has_taken_its_turn_but_in_netem() -> None:
    one_way = DirectionConditions(rate_mbit=9.1392, loss=0.2)
    rate = _crossed(one_way, *_flood(2.5, 1000, 0.8))["rate"]
    assert rate.measured == pytest.approx(9.1392 / 0.8, rel=0.005)
    rate = _crossed(one_way, *_flood(2.5, 1000, 0.8), lost_take_their_turn=False)["rate"]
    assert rate.measured == pytest.approx(9.1392, rel=0.005)


def test_a_sender_that_was_too_slow_is_named_with_the_miss() -> None:
    row = _crossed(DirectionConditions(rate_mbit=20), *_flood(2.5, 1000, 1.0))["rate"]
    assert not row.ok
    assert row.note == "only 11.4 Mbit/s were sent: this computer is too slow or too busy to tell"


def test_of_a_link_that_loses_everything_only_the_loss_can_be_measured() -> None:
    sent = [(_number(phase, i), _START_NS + i * 10 * _MS) for phase in (DELAY, LOSS, RATE) for i in range(100)]
    for one_way in (
        DirectionConditions(delay_ms=5, loss=1, rate_mbit=8),
        DirectionConditions(delay_ms=5, rate_mbit=8, trace=Trace("t", (0, 1), loss=(1, 1))),
    ):
        rows = _crossed(one_way, sent, [])
        assert {quantity: row.ok for quantity, row in rows.items()} == {
            "mean delay": False,
            "loss": True,
            "rate": False,
        }
        assert not any(row.misses for row in rows.values())
        assert rows["loss"].measured == rows["loss"].expected == 100
        came = _crossed(one_way, sent, [(number, time_ns, time_ns) for number, time_ns in sent])
        assert came["mean delay"].misses
        assert came["loss"].misses


def test_nothing_that_came_is_a_miss() -> None:
    sent, _ = _losses(100, 0)
    rows = _crossed(DirectionConditions(delay_ms=5, rate_mbit=8), sent, [])
    assert {quantity: row.ok for quantity, row in rows.items()} == {"mean delay": False, "loss": False, "rate": False}
