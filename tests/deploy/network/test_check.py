from __future__ import annotations

from typing import Any

import pytest

from deploy.network import DirectionConditions, LinkFailedError, LinkUnavailable, NetworkConditions, Trace
from deploy.network import __main__ as program
from deploy.network import check as check_module
from deploy.network.check import Check, measure
from deploy.network.check_rows import Row


def _row(measured: float | None) -> Row:
    return Row("loss", "uplink", "%", expected=2.0, measured=measured, allowed=0.4)


@pytest.fixture
def answers(monkeypatch: pytest.MonkeyPatch) -> dict[tuple[str, str], Any]:
    """(backend, network) -> the rows or the error that measuring it brings; every backend but netem is there."""
    answers: dict[tuple[str, str], Any] = {}

    def pretend(check: Check, seed: int) -> list[Row]:
        answer = answers.get((check.backend, check.network), [_row(2.1)])
        if isinstance(answer, Exception):
            raise answer
        return answer

    monkeypatch.setattr(check_module, "measure", pretend)
    monkeypatch.setattr(check_module, "unavailable", lambda name: "no netem here" if name == "netem" else None)
    return answers


def test_every_backend_that_is_there_is_held_against_every_preset(
    answers: dict[tuple[str, str], Any], capsys: pytest.CaptureFixture[str]
) -> None:
    assert program.main(["check"]) == 0
    output = capsys.readouterr().out
    assert "netem: not available here: no netem here" in output
    # Six presets, two backends.
    assert output.count(" ok\n") == 12
    assert output.endswith("namespaces, relay: every number within its tolerance\n")


@pytest.mark.parametrize("measured", [1.5, None])
def test_a_miss_is_named_and_exits_1(
    answers: dict[tuple[str, str], Any], capsys: pytest.CaptureFixture[str], measured: float | None
) -> None:
    answers["relay", "wifi_bad"] = [_row(measured)]
    assert program.main(["check", "--network", "wifi_bad"]) == 1
    output = capsys.readouterr().out
    assert "MISSES" in output
    assert output.endswith("missed: relay wifi_bad uplink loss\n")


def test_a_backend_that_was_asked_for_and_is_not_there_exits_1(
    answers: dict[tuple[str, str], Any], capsys: pytest.CaptureFixture[str]
) -> None:
    assert program.main(["check", "--backend", "netem", "--backend", "relay", "--network", "lan"]) == 1
    assert capsys.readouterr().out.endswith("not measured: netem\n")


def test_a_network_that_one_backend_cannot_do_is_no_miss_of_it(
    answers: dict[tuple[str, str], Any], capsys: pytest.CaptureFixture[str]
) -> None:
    answers["namespaces", "outage"] = LinkUnavailable("it has no outages")
    assert program.main(["check", "--network", "outage", "--network", "lan"]) == 0
    assert "outage       not measured: it has no outages" in capsys.readouterr().out


def test_a_network_that_does_not_exist_exits_1_with_its_reason(capsys: pytest.CaptureFixture[str]) -> None:
    assert program.main(["check", "--network", "wifi"]) == 1
    assert "network = 'wifi': expected one of the presets" in capsys.readouterr().err


def test_a_link_that_fails_is_a_miss_and_the_others_are_still_measured(
    answers: dict[tuple[str, str], Any], capsys: pytest.CaptureFixture[str]
) -> None:
    answers["relay", "lan"] = LinkFailedError("the relay died")
    assert program.main(["check", "--network", "lan", "--network", "wifi_bad"]) == 1
    output = capsys.readouterr().out
    assert "lan          FAILED: the relay died" in output
    assert output.count(" ok\n") == 3
    assert output.endswith("missed: relay lan\n")


@pytest.mark.parametrize("backend", ["relay", "namespaces"])
def test_traffic_in_both_directions_meets_its_own_conditions(request: pytest.FixtureRequest, backend: str) -> None:
    if backend == "namespaces":
        request.getfixturevalue("namespaces")
    conditions = NetworkConditions(DirectionConditions(delay_ms=40), DirectionConditions(delay_ms=10, loss=1.0))
    if backend == "relay":  # where what would be lost never comes
        conditions = NetworkConditions(DirectionConditions(delay_ms=40), DirectionConditions(delay_ms=10))
    rows = {(row.direction, row.quantity): row for row in measure(Check(backend, "test", conditions))}  # type: ignore[arg-type]
    uplink, downlink = rows["uplink", "mean delay"].measured, rows["downlink", "mean delay"].measured
    assert uplink is not None
    assert uplink >= 40
    assert rows["downlink", "loss"].expected == (100 if backend == "namespaces" else 0)
    if backend == "namespaces":
        assert rows["downlink", "loss"].measured == 100
        assert downlink is None
    else:
        assert downlink is not None
        assert 10 <= downlink < uplink


def test_what_cannot_be_measured_because_all_is_lost_is_no_miss(
    answers: dict[tuple[str, str], Any], capsys: pytest.CaptureFixture[str]
) -> None:
    lost = Row("mean delay", "uplink", "ms", expected=3.0, measured=None, allowed=0.3, silent=True)
    answers["namespaces", "lan"] = [_row(2.1), lost]
    assert program.main(["check", "--network", "lan"]) == 0
    output = capsys.readouterr().out
    assert "± 0.300 ms     cannot be measured: all is lost\n" in output
    assert "MISSES" not in output


def test_over_a_relay_that_lets_nothing_through_nothing_is_measured() -> None:
    conditions = NetworkConditions(downlink=DirectionConditions(loss=1))
    with pytest.raises(LinkUnavailable, match=r"everything in the downlink is lost \(loss = 1\)"):
        measure(Check("relay", "test", conditions))


def test_a_trace_that_stops_during_a_check_ends_it() -> None:
    conditions = NetworkConditions(DirectionConditions(trace=Trace("short.csv", (0, 0.01), loss=(0, 0), end="stop")))
    with pytest.raises(LinkFailedError, match=r"relay test: the trace short\.csv is over after 0\.02 s"):
        measure(Check("relay", "test", conditions))


def test_a_probe_that_fails_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(check_module._TRANSPORT, "relay", "smoke")  # type: ignore[arg-type]
    with pytest.raises(LinkFailedError, match=r"receiver of the uplink did not start: .*invalid choice: 'smoke'"):
        measure(Check("relay", "test", NetworkConditions()))
