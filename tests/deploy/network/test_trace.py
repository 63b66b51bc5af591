from __future__ import annotations

import math
import random
from pathlib import Path

import pytest

from common.errors import ConfigError
from deploy.network import (
    DirectionConditions,
    DropCause,
    NetworkConditions,
    PacketSchedule,
    StreamSchedule,
    Trace,
    load_network,
    parse_network,
    read_trace,
)

_CSV = "time_s,delay_ms,loss,rate_mbit\n0,4,0,8\n0.5,6,1,8\n\n1.5,2,0,4\n"


def _write(directory: Path, text: str) -> Path:
    path = directory / "link.csv"
    path.write_text(text, encoding="utf-8")
    return path


def _uplink(trace: Trace) -> NetworkConditions:
    return NetworkConditions(DirectionConditions(trace=trace), DirectionConditions())


def test_a_trace_file_has_a_row_per_line_and_lasts_as_long_again_as_its_last_row_but_one(tmp_path: Path) -> None:
    trace = read_trace(_write(tmp_path, _CSV))
    assert trace.time_s == (0, 0.5, 1.5)
    assert (trace.delay_ms, trace.loss, trace.rate_mbit) == ((4, 6, 2), (0, 1, 0), (8, 8, 4))
    assert trace.length_s == 2.5


@pytest.mark.parametrize(
    ("time_s", "looping", "stopping"),
    [(0, 0, 0), (0.49, 0, 0), (0.5, 1, 1), (1.5, 2, 2), (2.49, 2, 2), (2.5, 0, 2), (3.0, 1, 2), (5.1, 0, 2)],
)
def test_a_row_holds_until_the_next_and_the_trace_begins_again_or_keeps_its_last_row(
    time_s: float, looping: int, stopping: int
) -> None:
    columns = {"delay_ms": (1.0, 2.0, 3.0)}
    assert Trace("t", (0, 0.5, 1.5), **columns).row(time_s) == looping
    assert Trace("t", (0, 0.5, 1.5), **columns, end="stop").row(time_s) == stopping


def test_the_mean_over_a_trace_counts_each_row_by_its_length() -> None:
    trace = Trace("t", (0, 0.5, 1.5), delay_ms=(4, 6, 2), rate_mbit=(8, 16, 4))
    one_way = DirectionConditions(trace=trace)
    # (0.5 x 4 + 1 x 6 + 1 x 2) / 2.5 and (0.5 x 8 + 16 + 4) / 2.5 = 9.6 Mbit/s
    assert one_way.mean_delay_ms == pytest.approx(4)
    assert one_way.bytes_per_s == pytest.approx(1.2e6)


def test_packets_meet_the_delay_the_loss_and_the_rate_of_their_time(tmp_path: Path) -> None:
    schedule = PacketSchedule(_uplink(read_trace(_write(tmp_path, _CSV))), "uplink", random.Random(0))
    # 1000 bytes take 1 ms at 8 Mbit/s and 2 ms at 4.
    assert schedule.offer(0.25, 1000) == pytest.approx(0.255)
    assert schedule.offer(0.75, 1000) is DropCause.LOSS
    assert schedule.offer(1.75, 1000) == pytest.approx(1.754)
    assert schedule.offer(2.75, 1000) == pytest.approx(2.755)


def test_what_a_trace_has_no_column_for_is_what_the_table_says() -> None:
    trace = Trace("t", (0, 1), loss=(0, 1))
    one_way = DirectionConditions(delay_ms=7, rate_mbit=8, trace=trace)
    schedule = PacketSchedule(NetworkConditions(one_way), "uplink", random.Random(0))
    assert schedule.offer(0.0, 1000) == pytest.approx(0.008)


def test_a_segment_that_is_lost_while_a_trace_loses_everything_comes_after_that() -> None:
    trace = Trace("t", (0, 1, 2), loss=(0, 1, 0))
    schedule = StreamSchedule(_uplink(trace), "uplink", random.Random(0))
    assert schedule.offer(0.5, 100).delivery_s == 0.5
    # Sent again when something can pass, at 2 s; no delay is added by this trace.
    segment = schedule.offer(1.25, 100)
    assert (segment.delivery_s, segment.retransmitted) == (2.0, True)


def test_a_trace_that_ends_in_a_silence_and_stops_never_delivers_any_more() -> None:
    trace = Trace("t", (0, 1), loss=(0, 1), end="stop")
    assert StreamSchedule(_uplink(trace), "uplink", random.Random(0)).offer(1.5, 100).delivery_s == math.inf


def test_conditions_know_when_the_first_trace_stops() -> None:
    long, short, looping = (
        Trace("long", (0, 30), loss=(0, 0), end="stop"),
        Trace("short", (0, 20), loss=(0, 0), end="stop"),
        Trace("looping", (0, 1), loss=(0, 0)),
    )
    assert NetworkConditions(DirectionConditions(trace=long), DirectionConditions(trace=short)).stops == (40, short)
    assert _uplink(looping).stops is None
    assert NetworkConditions().stops is None


def test_a_table_names_a_trace_next_to_its_file_and_each_direction_may_have_its_own(tmp_path: Path) -> None:
    _write(tmp_path, _CSV)
    path = tmp_path / "net.toml"
    path.write_text(
        '[network]\ntrace_end = "stop"\n[network.uplink]\ntrace = "link.csv"\n'
        '[network.downlink]\ntrace = "link.csv"\ntrace_end = "loop"\n',
        encoding="utf-8",
    )
    conditions = load_network(path)
    assert conditions.uplink.trace == read_trace(tmp_path / "link.csv", end="stop")
    assert conditions.downlink.trace == read_trace(tmp_path / "link.csv", end="loop")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "the first line is '': expected the columns time_s and some of delay_ms"),
        ("delay_ms\n1\n2\n", "the first line is 'delay_ms'"),
        ("time_s,latency\n0,1\n1,1\n", "the first line is 'time_s, latency'"),
        ("time_s,loss,loss\n0,1,1\n1,1,1\n", "the first line is"),
        ("time_s\n0\n1\n", "at least one of the columns delay_ms, loss, rate_mbit"),
        ("time_s,loss\n", "0 rows: expected at least 2"),
        ("time_s,loss\n0,0\n", "1 rows: expected at least 2"),
        ("time_s,loss\n1,0\n2,0\n", "row 1: time_s = 1.0: expected 0"),
        ("time_s,loss\n0,0\n2,0\n2,0\n", "row 3: time_s = 2.0: expected more than 2.0"),
        ("time_s,loss\n0,0\nnan,0\n", "row 2: time_s = nan: expected more than 0.0"),
        ("time_s,loss\n0,0\n1\n", "row 2 has 1 values: expected 2"),
        ("time_s,loss\n0,0\n1,lots\n", "row 2: loss = 'lots': expected a number"),
        ("time_s,loss\n0,0\n1,1.5\n", "row 2: loss = 1.5: expected a fraction between 0 and 1"),
        ("time_s,delay_ms\n0,3\n1,-3\n", "row 2: delay_ms = -3.0: expected milliseconds >= 0"),
        ("time_s,delay_ms\n0,3\n1,nan\n", "row 2: delay_ms = nan: expected milliseconds >= 0"),
        ("time_s,rate_mbit\n0,3\n1,0\n", "row 2: rate_mbit = 0.0: expected Mbit/s > 0 (for a silence: loss = 1)"),
    ],
)
def test_a_malformed_trace_names_the_file_the_row_and_what_was_expected(tmp_path: Path, text: str, reason: str) -> None:
    path = _write(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        parse_network({"trace": "link.csv"}, directory=tmp_path)
    assert str(caught.value).startswith(f"{path}: ")
    assert reason in str(caught.value)


def test_a_trace_that_is_missing_or_binary_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.csv: a trace that cannot be read: No such file"):
        parse_network({"trace": "none.csv"}, directory=tmp_path)
    (tmp_path / "binary.csv").write_bytes(b"time_s,loss\n\xff\xfe\n")
    with pytest.raises(ConfigError, match=r"binary\.csv: not a CSV file"):
        parse_network({"trace": "binary.csv"}, directory=tmp_path)


def test_jitter_above_the_least_delay_of_a_trace_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"jitter_ms = 3: expected at most the least delay in t = 2"):
        DirectionConditions(jitter_ms=3, trace=Trace("t", (0, 1), delay_ms=(5, 2)))
