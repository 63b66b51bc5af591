from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any

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
    recorded_table,
)
from deploy.network.trace import MAX_ROWS

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


def test_a_file_that_both_directions_name_is_read_once(tmp_path: Path) -> None:
    _write(tmp_path, _CSV)
    conditions = parse_network({"trace": "link.csv", "downlink": {"queue_ms": 3}}, directory=tmp_path)
    assert conditions.uplink.trace is conditions.downlink.trace


def test_the_byte_order_mark_of_a_spreadsheet_is_no_part_of_the_first_column(tmp_path: Path) -> None:
    path = _write(tmp_path, "\ufefftime_s,delay_ms\n0,4\n2,5\n")
    assert path.read_bytes().startswith(b"\xef\xbb\xbftime_s")
    assert read_trace(path) == Trace(str(path), (0, 2), delay_ms=(4, 5))


def test_a_trace_of_a_day_second_by_second_is_taken_and_of_more_rows_than_the_limit_refused(tmp_path: Path) -> None:
    head = "time_s,loss\n"
    day = _write(tmp_path, head + "".join(f"{second},0\n" for second in range(86_400)))
    assert read_trace(day).length_s == 86_400
    most = _write(tmp_path, head + "".join(f"{second},0\n" for second in range(MAX_ROWS)))
    assert len(read_trace(most).time_s) == MAX_ROWS
    with most.open("a", encoding="utf-8") as file:
        file.write(f"{MAX_ROWS},0\n")
    with pytest.raises(ConfigError, match=r"link\.csv: more than 100000 rows: expected at most that many"):
        read_trace(most)
    seconds = tuple(map(float, range(MAX_ROWS + 1)))
    with pytest.raises(ConfigError, match=r"^t: more than 100000 rows"):
        Trace("t", seconds, loss=seconds)


def test_of_a_file_with_too_many_rows_the_rest_is_not_read(tmp_path: Path) -> None:
    rows = "".join(f"{second},0\n" for second in range(MAX_ROWS + 1))
    path = tmp_path / "link.csv"
    # Farther than any buffer from the rows: what cannot be read there would be told instead.
    path.write_bytes(f"time_s,loss\n{rows}".encode() + b"1,1\n" * 1_000_000 + b"\xff\n")
    with pytest.raises(ConfigError, match="more than 100000 rows"):
        read_trace(path)


def test_a_record_has_the_rows_in_files_from_which_equal_conditions_are_read(tmp_path: Path) -> None:
    trace = Trace("/far/away.csv", (0, 0.1, 1 / 3), delay_ms=(4.2, 1e-9, 7), rate_mbit=(38, 2 / 7, 1), end="stop")
    conditions = NetworkConditions(
        DirectionConditions(loss=0.25, trace=trace), DirectionConditions(trace=Trace("t", (0, 1), loss=(0, 1)))
    )
    table = recorded_table(conditions.to_table(), tmp_path)
    assert table["uplink"]["trace"] == {"name": "/far/away.csv", "file": "uplink_trace.csv"}
    assert (tmp_path / "downlink_trace.csv").read_text() == "time_s,loss\n0,0\n1,1\n"
    assert parse_network(table, directory=tmp_path) == conditions


@pytest.mark.parametrize(
    ("table", "reason"),
    [
        ({"file": "link.csv", "end": "stop"}, r"network\.trace\.end = 'stop': expected only name and file"),
        ({"file": 3}, r"network\.trace\.file = 3: expected only name and file, which are texts"),
        ({"name": "t", "file": "none.csv"}, r"none\.csv: a trace that cannot be read"),
    ],
)
def test_a_record_whose_trace_cannot_be_read_is_refused(tmp_path: Path, table: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        parse_network({"trace": table}, directory=tmp_path)


@pytest.mark.parametrize(
    ("table", "reason"),
    [
        (
            {"trace": "link.csv", "delay_ms": 7.0},
            r"^network\.delay_ms = 7\.0: the trace \S*link\.csv has a column delay_ms, .*leave one out",
        ),
        # Also where the number is what holds anyway if nothing is said.
        ({"trace": "link.csv", "loss": 0.0}, r"^network\.loss = 0\.0: the trace \S*link\.csv has a column loss"),
        ({"trace": "link.csv", "uplink": {"rate_mbit": 3}}, r"^network\.uplink\.rate_mbit = 3: the trace \S*link\.csv"),
        ({"downlink": {"trace": "link.csv", "loss": 0.5}}, r"^network\.downlink\.loss = 0\.5: the trace"),
        (
            {"delay_ms": 7, "uplink": {"trace": "link.csv"}, "downlink": {"trace": "link.csv"}},
            r"^network\.delay_ms = 7: the trace of each direction has a column delay_ms",
        ),
    ],
)
def test_a_number_that_a_column_of_the_trace_would_override_is_refused(
    tmp_path: Path, table: dict[str, Any], reason: str
) -> None:
    _write(tmp_path, _CSV)
    with pytest.raises(ConfigError, match=reason):
        parse_network(table, directory=tmp_path)


def test_a_number_that_no_column_replaces_or_that_was_said_of_both_directions_gives_way(tmp_path: Path) -> None:
    _write(tmp_path, _CSV)
    trace = read_trace(tmp_path / "link.csv")
    table = {"preset": "wifi_bad", "jitter_ms": 0, "delay_ms": 7, "uplink": {"trace": "link.csv", "queue_ms": 50}}
    conditions = parse_network(table, directory=tmp_path)
    assert conditions.uplink == DirectionConditions(queue_ms=50, trace=trace)
    assert conditions.downlink == DirectionConditions(delay_ms=7, loss=0.02, rate_mbit=12)
    # A trace of one direction that does not say all of it leaves the rest to the table.
    (tmp_path / "loss.csv").write_text("time_s,loss\n0,0\n1,1\n", encoding="utf-8")
    assert parse_network({"trace": "loss.csv", "delay_ms": 7}, directory=tmp_path).uplink.delay_ms == 7


def test_conditions_with_a_number_and_a_column_of_the_same_are_refused_however_they_are_made() -> None:
    with pytest.raises(ConfigError, match=r"network\.loss = 0\.5: the trace t has a column loss"):
        DirectionConditions(loss=0.5, trace=Trace("t", (0, 1), loss=(0, 1)))


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
