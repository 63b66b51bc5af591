from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from common.errors import ConfigError
from deploy.network import PRESETS, DirectionConditions, NetworkConditions, load_network, parse_network


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("ideal", DirectionConditions()),
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


@pytest.mark.parametrize("rate_mbit", [0, 0.0, None])
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
        ({"rate_mbit": "fast"}, "network.rate_mbit", "'fast'", "Mbit/s >= 0"),
        ({"uplink": {"loss": -0.1}}, "network.uplink.loss", "-0.1", "between 0 and 1"),
        ({"downlink": {"speed": 1}}, "network.downlink.speed", "1", "rate_mbit"),
        ({"downlink": 3}, "network.downlink", "3", "a table"),
        ({"uplink": {"outage_s": 1}}, "network.uplink.outage_s", "1", "set them in [network]"),
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
