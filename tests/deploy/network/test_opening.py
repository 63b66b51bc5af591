from __future__ import annotations

import logging
from pathlib import Path

import pytest

from deploy.network import (
    PRESETS,
    Crossing,
    LinkUnavailable,
    NamespaceLink,
    NetworkConditions,
    NoLink,
    RelayLink,
    open_link,
)

_CROSSING = Crossing("local", "remote", 7447)


@pytest.fixture
def no_namespaces(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: NamespaceLink) -> NamespaceLink:
        raise LinkUnavailable("network namespaces need root")

    monkeypatch.setattr(NamespaceLink, "__enter__", refuse)


@pytest.mark.parametrize(("conditions", "needs"), [(None, [_CROSSING]), (PRESETS["wifi_bad"], [])])
def test_without_conditions_or_crossings_there_is_no_link(
    conditions: NetworkConditions | None, needs: list[Crossing], tmp_path: Path
) -> None:
    with open_link(conditions, needs=needs, run_dir=tmp_path) as network_link:
        assert isinstance(network_link, NoLink)
        assert network_link.dial_address("local", "remote", 7447) == ("127.0.0.1", 7447)


@pytest.mark.usefixtures("namespaces")
def test_namespaces_are_preferred_where_they_can_be_made(tmp_path: Path) -> None:
    with open_link(PRESETS["ideal"], needs=[_CROSSING], run_dir=tmp_path) as network_link:
        assert isinstance(network_link, NamespaceLink)
        assert network_link.dial_address("local", "remote", 7447) == (network_link.addresses["remote"], 7447)


@pytest.mark.usefixtures("no_namespaces")
def test_the_relay_stands_in_and_says_why_and_what_is_lost(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with (
        caplog.at_level(logging.WARNING),
        open_link(PRESETS["ideal"], needs=[_CROSSING], run_dir=tmp_path) as network_link,
    ):
        assert isinstance(network_link, RelayLink)
    assert "because network namespaces need root" in caplog.text
    assert "real packet loss" in caplog.text


@pytest.mark.usefixtures("no_namespaces")
def test_namespaces_that_were_asked_for_are_not_replaced(tmp_path: Path) -> None:
    asked_for = open_link(PRESETS["ideal"], needs=[_CROSSING], run_dir=tmp_path, prefer="namespaces")
    with pytest.raises(LinkUnavailable, match="need root"):
        asked_for.__enter__()


@pytest.mark.usefixtures("no_namespaces")
def test_an_error_of_the_launcher_is_not_taken_for_one_of_the_link(tmp_path: Path) -> None:
    with (
        pytest.raises(LinkUnavailable, match="raised by the launcher"),
        open_link(PRESETS["ideal"], needs=[_CROSSING], run_dir=tmp_path),
    ):
        raise LinkUnavailable("raised by the launcher")
