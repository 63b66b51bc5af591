from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from common.errors import ConfigError
from deploy.network import PRESETS, DirectionConditions, NetworkConditions, Trace, load_network, parse_network


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("ideal", DirectionConditions()),
        ("lan", DirectionConditions(delay_ms=0.2, rate_mbit=100)),
        ("wifi_good", DirectionConditions(delay_ms=1.5, jitter_ms=0.5, loss=0.002, rate_mbit=80)),
        ("wifi_office", DirectionConditions(delay_ms=3, jitter_ms=2, loss=0.005, rate_mbit=40)),
        ("wifi_bad", DirectionConditions(delay_ms=20, jitter_ms=15, loss=0.02, rate_mbit=12)),
        ("outage", DirectionConditions(delay_ms=3, rate_mbit=20)),
    ],
)
def test_a_preset_is_the_same_in_both_directions(name: str, expected: DirectionConditions) -> None:
    conditions = load_network(name)
    assert conditions.uplink == conditions.downlink == expected


def test_the_outage_preset_is_silent_for_1_s_every_20_s() -> None:
    assert (load_network("outage").outage_every_s, load_network("outage").outage_s) == (20, 1)


@pytest.mark.parametrize("conditions", PRESETS.values(), ids=PRESETS)
def test_a_table_made_from_conditions_gives_them_back(conditions: NetworkConditions) -> None:
    assert parse_network(conditions.to_table()) == conditions


def test_congestion_control_belongs_to_the_link_and_is_a_name() -> None:
    conditions = parse_network({"preset": "wifi_bad", "congestion_control": "cubic"})
    assert conditions.congestion_control == "cubic"
    assert parse_network(conditions.to_table()) == conditions
    with pytest.raises(ConfigError, match=r"network.congestion_control = 'a; b': expected a name"):
        parse_network({"congestion_control": "a; b"})
    with pytest.raises(ConfigError, match=r"network.uplink.congestion_control = 'cubic'.*set it in \[network\]"):
        parse_network({"uplink": {"congestion_control": "cubic"}})


def test_a_file_overrides_a_preset_in_both_directions_and_then_in_one(tmp_path: Path) -> None:
    path = tmp_path / "net.toml"
    path.write_text(
        '[network]\npreset = "wifi_office"\ndelay_ms = 5\noutage_every_s = 10\noutage_s = 0.5\n'
        "[network.uplink]\nrate_mbit = 8.5\n[other]\nkey = 1\n"
    )
    conditions = load_network(path)
    assert conditions.uplink == DirectionConditions(5, 2, 0.005, 8.5)
    assert conditions.downlink == DirectionConditions(5, 2, 0.005, 40)
    assert (conditions.outage_every_s, conditions.outage_s) == (10, 0.5)


def test_an_empty_table_is_the_ideal_link() -> None:
    assert parse_network({}) == PRESETS["ideal"]


@pytest.mark.parametrize("rate_mbit", [math.inf, None])
def test_no_rate_is_an_unlimited_rate(rate_mbit: float | None) -> None:
    assert DirectionConditions(rate_mbit=rate_mbit).bytes_per_s is None


def test_a_rate_of_8_mbit_is_a_million_bytes_per_second() -> None:
    assert DirectionConditions(rate_mbit=8).bytes_per_s == 1e6


@pytest.mark.parametrize(
    ("table", "key", "value", "expected"),
    [
        ({"preset": "wifi_x"}, "network.preset", "'wifi_x'", "wifi_office"),
        ({"preset": 3}, "network.preset", "3", "wifi_office"),
        ({"delay": 3}, "network.delay", "3", "delay_ms"),
        ({"delay_ms": -1}, "network.delay_ms", "-1", ">= 0"),
        ({"jitter_ms": math.nan}, "network.jitter_ms", "nan", ">= 0"),
        ({"queue_ms": math.inf}, "network.queue_ms", "inf", ">= 0"),
        ({"loss": 1.5}, "network.loss", "1.5", "between 0 and 1"),
        ({"loss": True}, "network.loss", "True", "between 0 and 1"),
        ({"rate_mbit": "fast"}, "network.rate_mbit", "'fast'", "Mbit/s > 0"),
        ({"rate_mbit": 0}, "network.rate_mbit", "0", "unlimited: inf"),
        ({"rate_mbit": -3}, "network.rate_mbit", "-3", "Mbit/s > 0"),
        ({"queue_packets": 1.5, "rate_mbit": 1}, "network.queue_packets", "1.5", "a whole number"),
        ({"queue_packets": -1, "rate_mbit": 1}, "network.queue_packets", "-1", "a whole number"),
        ({"uplink": {"queue_packets": 9}}, "network.uplink.queue_packets", "9", "without rate_mbit nothing ever waits"),
        ({"delay_ms": 3, "jitter_ms": 4}, "network.uplink.jitter_ms", "4", "at most delay_ms = 3"),
        ({"preset": "wifi_bad", "downlink": {"delay_ms": 9}}, "network.downlink.jitter_ms", "15.0", "delay_ms = 9"),
        ({"jitter_correlation": 0.5}, "network.uplink.jitter_correlation", "0.5", "there is no jitter"),
        ({"jitter_correlation": 1, "delay_ms": 1, "jitter_ms": 1}, "network.jitter_correlation", "1", "less than 1"),
        ({"loss_burst_packets": 4}, "network.uplink.loss_burst_packets", "4", "nothing is lost"),
        ({"loss": 0.1, "loss_burst_packets": 0.5}, "network.loss_burst_packets", "0.5", "at least 1 packet"),
        ({"loss": 0.1, "loss_in_burst": 0.9}, "network.uplink.loss_in_burst", "0.9", "there are no bursts"),
        ({"loss": 0.1, "loss_between_bursts": 0.2}, "network.uplink.loss_between_bursts", "0.2", "no bursts"),
        (
            {"loss": 0.1, "loss_burst_packets": 4, "loss_between_bursts": 0.2},
            "network.uplink.loss",
            "0.1",
            "more than loss_between_bursts = 0.2",
        ),
        (
            {"loss": 0.6, "loss_burst_packets": 4, "loss_in_burst": 0.5},
            "network.uplink.loss",
            "0.6",
            "less than loss_in_burst = 0.5",
        ),
        # Four packets of five in bursts: a burst of mean 2 would have to begin before the one before it has ended.
        ({"loss": 0.8, "loss_burst_packets": 2}, "network.uplink.loss_burst_packets", "2", "at least 4, for a loss"),
        ({"trace": 3}, "network.trace", "3", "the path of a CSV file"),
        ({"trace_end": "stop"}, "network.trace_end", "'stop'", "there is no trace"),
        ({"uplink": {"trace_end": "loop"}}, "network.uplink.trace_end", "'loop'", "there is no trace"),
        ({"trace_end": "again"}, "network.trace_end", "'again'", "loop or stop"),
        ({"uplink": {"loss": -0.1}}, "network.uplink.loss", "-0.1", "between 0 and 1"),
        ({"downlink": {"speed": 1}}, "network.downlink.speed", "1", "rate_mbit"),
        ({"downlink": 3}, "network.downlink", "3", "a table"),
        ({"uplink": {"outage_s": 1}}, "network.uplink.outage_s", "1", "set it in [network]"),
        ({"outage_s": 1}, "network.outage_s", "1", "less than outage_every_s = 0"),
        ({"outage_every_s": 2, "outage_s": 2}, "network.outage_s", "2", "less than outage_every_s = 2"),
        ({"outage_every_s": -2}, "network.outage_every_s", "-2", "seconds >= 0"),
        ({"outage_s": math.nan}, "network.outage_s", "nan", "seconds >= 0"),
    ],
)
def test_a_wrong_table_names_key_value_and_what_was_expected(
    table: dict[str, Any], key: str, value: str, expected: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_network(table)
    assert f"{key} = {value}: " in str(caught.value)
    assert expected in str(caught.value)


def test_conditions_are_checked_however_they_are_made() -> None:
    with pytest.raises(ConfigError, match=r"loss = 2: expected a fraction"):
        DirectionConditions(loss=2)
    with pytest.raises(ConfigError, match=r"outage_s = 3: expected less than outage_every_s"):
        NetworkConditions(outage_every_s=1, outage_s=3)


def test_the_values_of_one_direction_do_not_have_to_agree_with_those_of_both_that_they_override() -> None:
    conditions = parse_network(
        {"jitter_ms": 5, "uplink": {"delay_ms": 9}, "downlink": {"delay_ms": 7, "jitter_ms": 1, "loss": 0.25}}
    )
    assert conditions.uplink == DirectionConditions(delay_ms=9, jitter_ms=5)
    assert conditions.downlink == DirectionConditions(delay_ms=7, jitter_ms=1, loss=0.25)


def test_every_key_of_a_direction_survives_being_written_as_json_and_read() -> None:
    trace = Trace("office.csv", (0, 0.5, 1.5), delay_ms=(4, 5, 6), loss=(0, 0.1, 1), rate_mbit=(20, 10, 5), end="stop")
    uplink = DirectionConditions(
        jitter_ms=2,
        queue_ms=50,
        queue_packets=30,
        jitter_correlation=0.5,
        loss_burst_packets=4,
        loss_in_burst=0.5,
        loss_between_bursts=0.01,
        trace=trace,
    )
    conditions = NetworkConditions(uplink, DirectionConditions(rate_mbit=math.inf), 20, 1)
    assert parse_network(json.loads(json.dumps(conditions.to_table()))) == conditions


def test_an_error_in_a_file_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "net.toml"
    path.write_text("[network.uplink]\nloss = 7\n")
    with pytest.raises(ConfigError, match=r"net\.toml: network\.uplink\.loss = 7: expected"):
        load_network(path)


@pytest.mark.parametrize(("text", "reason"), [("[net]\n", "network"), ("[network\n", "not a TOML file")])
def test_a_file_without_a_network_table_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "net.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=reason):
        load_network(path)


def test_an_unknown_name_lists_the_presets() -> None:
    with pytest.raises(ConfigError, match=r"network = 'wifi': expected .*wifi_office.* path of a TOML file"):
        load_network("wifi")
