"""The command: which rows, what it prints, what it writes, how it exits."""

from __future__ import annotations

import json

import pytest

from benchmarks import bench
from benchmarks.comparison import Comparison, RowPlan, Side
from benchmarks.side import UnavailableError
from benchmarks.side_process import SideError
from benchmarks.table import Budget, Row

BUDGET = Budget(">=", 2.0)


def comparison(name):
    return Comparison({"ours": Side("a:b")}, (RowPlan(name, BUDGET, "ours"),), rounds=5)


@pytest.fixture
def measured(monkeypatch):
    """What each row's measurement comes to: a Row or an exception."""
    outcomes = {
        "fast_ms": Row("fast_ms", 1.0, 3.0, 3.0, ">= 2x", True),
        "slow_ms": Row("slow_ms", 1.0, 1.5, 1.5, ">= 2x", False),
        "broken_ms": SideError("ended with exit code 3"),
        "blind_ms": UnavailableError("no GL library: install libegl1"),
    }
    rounds = []

    def run(comparison, progress):
        rounds.append(comparison.rounds)
        outcome = outcomes[comparison.plans[0].name]
        if isinstance(outcome, Exception):
            raise outcome
        return [outcome]

    monkeypatch.setattr(bench, "run", run)
    monkeypatch.setattr(bench, "all_comparisons", lambda: [comparison(name) for name in outcomes])
    return rounds


def rows(path):
    return {row["name"]: row["ok"] for row in json.loads(path.read_text(encoding="utf-8"))}


def test_budgets_that_hold_are_a_success(measured, tmp_path):
    assert bench.main(["--only", "fast", "--out", str(tmp_path / "bench.json")]) == 0
    assert rows(tmp_path / "bench.json") == {"fast_ms": True}


@pytest.mark.parametrize(("out", "reason"), [("file/bench.json", "File exists"), ("folder", "Is a directory")])
def test_a_result_that_cannot_be_written_is_refused_before_anything_is_measured(
    measured, tmp_path, capsys, out, reason
):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    assert bench.main(["--out", str(tmp_path / out)]) == 1
    assert reason in capsys.readouterr().err
    assert measured == []


def test_a_budget_that_fails_is_a_failure(measured, tmp_path):
    assert bench.main(["--only", "fast", "slow", "--out", str(tmp_path / "bench.json")]) == 1
    assert rows(tmp_path / "bench.json") == {"fast_ms": True, "slow_ms": False}


def test_a_measurement_that_fails_is_reported_and_the_rest_goes_on(measured, tmp_path, capsys):
    assert bench.main(["--only", "broken", "fast", "--out", str(tmp_path / "bench.json")]) == 1
    assert rows(tmp_path / "bench.json") == {"fast_ms": True, "broken_ms": False}
    assert "broken_ms: not measured: ended with exit code 3" in capsys.readouterr().out


def test_what_cannot_be_measured_here_is_left_out_and_said(measured, tmp_path, capsys):
    assert bench.main(["--only", "fast", "blind", "--out", str(tmp_path / "bench.json")]) == 0
    assert rows(tmp_path / "bench.json") == {"fast_ms": True}
    assert "blind_ms: skipped: no GL library: install libegl1" in capsys.readouterr().out


def test_quick_is_one_round(measured, tmp_path):
    bench.main(["--only", "fast", "--out", str(tmp_path / "bench.json")])
    bench.main(["--quick", "--only", "fast", "--out", str(tmp_path / "bench.json")])
    assert measured == [5, 1]


def test_an_unknown_row_is_refused_with_those_there_are(measured, capsys):
    with pytest.raises(SystemExit) as ended:
        bench.main(["--only", "nothing"])
    assert ended.value.code == 2
    assert "expected a part of one of fast_ms, slow_ms, broken_ms, blind_ms" in capsys.readouterr().err


def test_an_interrupt_writes_nothing(monkeypatch, tmp_path):
    def interrupted(comparison, progress):
        raise KeyboardInterrupt

    monkeypatch.setattr(bench, "all_comparisons", lambda: [comparison("a_ms")])
    monkeypatch.setattr(bench, "run", interrupted)
    assert bench.main(["--out", str(tmp_path / "bench.json")]) == bench.INTERRUPTED
    assert not (tmp_path / "bench.json").exists()


def test_every_row_has_a_name_of_its_own_and_a_side_of_its_own():
    plans = [(plan, comparison) for comparison in bench.all_comparisons() for plan in comparison.plans]
    names = [plan.name for plan, _ in plans]
    assert len(names) == len(set(names))
    for plan, compared in plans:
        assert plan.ours in compared.sides
        assert plan.baseline is None or plan.baseline in compared.sides
        # An absolute budget has a unit, a ratio has none.
        assert (plan.budget.unit == "x") == (plan.baseline is not None)
