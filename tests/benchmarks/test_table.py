"""The table: ratios, budgets, exit code, JSON; all rows made by hand."""

from __future__ import annotations

import json
from dataclasses import fields

import pytest

from benchmarks.table import Budget, Row, exit_code, judge, to_json, to_text, unmeasured

GOOD = Row("a_ms", 10.0, 30.0, 3.0, ">= 2.5x", ok=True)
BAD = Row("b_bytes", 30.0, 100.0, 0.3, "<= 0.2x", ok=False)
ABSOLUTE = Row("c_per_s", 700.0, None, None, ">= 500 /s", ok=True)


@pytest.mark.parametrize(
    ("relation", "limit", "below", "at", "above"),
    [(">=", 2.5, False, True, True), ("<=", 0.2, True, True, False), ("<", 2.0, True, False, False)],
)
def test_a_budget_holds_on_its_side_of_the_limit(relation, limit, below, at, above):
    budget = Budget(relation, limit)
    assert [budget.holds(limit * share) for share in (0.999, 1.0, 1.001)] == [below, at, above]


@pytest.mark.parametrize("relation", ["<", "<=", ">="])
def test_what_is_not_a_number_keeps_no_budget(relation):
    assert not Budget(relation, 1.0).holds(float("nan"))


def test_a_budget_reads_as_it_is_meant():
    assert str(Budget(">=", 2.5)) == ">= 2.5x"
    assert str(Budget("<", 2.0, "ms")) == "< 2 ms"


def test_a_speed_up_is_the_baselines_cost_over_ours():
    assert judge("a", Budget(">=", 2.5), ours=100.0, baseline=250.0) == Row("a", 100.0, 250.0, 2.5, ">= 2.5x", True)
    assert not judge("a", Budget(">=", 2.5), ours=100.0, baseline=249.0).ok


def test_a_share_is_our_cost_over_the_baselines():
    assert judge("b", Budget("<=", 0.2), ours=20.0, baseline=100.0) == Row("b", 20.0, 100.0, 0.2, "<= 0.2x", True)
    assert not judge("b", Budget("<=", 0.2), ours=21.0, baseline=100.0).ok


def test_an_absolute_budget_judges_our_number_and_has_neither_baseline_nor_ratio():
    budget = Budget(">=", 500.0, "/s")
    assert judge("c", budget, ours=500.0) == Row("c", 500.0, None, None, ">= 500 /s", True)
    assert not judge("c", budget, ours=499.9).ok


def test_a_budget_is_judged_before_its_number_is_rounded():
    row = judge("a", Budget(">=", 2.5), ours=1.0, baseline=2.49999)
    assert row.ratio == 2.5
    assert not row.ok


def test_a_cost_of_nothing_is_no_measurement():
    row = judge("a", Budget(">=", 2.5), ours=0.0, baseline=1.0)
    assert row.ratio is None
    assert not row.ok


def test_what_was_not_measured_fails_its_budget():
    assert unmeasured("a", Budget(">=", 2.5)) == Row("a", None, None, None, ">= 2.5x", False)


def test_one_failing_budget_decides_the_exit_code():
    assert exit_code([GOOD, ABSOLUTE]) == 0
    assert exit_code([GOOD, BAD, ABSOLUTE]) == 1


def test_json_is_a_list_of_rows_with_exactly_their_fields():
    rows = json.loads(to_json([GOOD, ABSOLUTE, unmeasured("d", Budget("<", 2.0, "ms"))]))
    names = ["name", "ours", "baseline", "ratio", "budget", "ok"]
    assert [field.name for field in fields(Row)] == names
    assert [list(row) for row in rows] == [names] * 3
    assert rows[0] == {"name": "a_ms", "ours": 10.0, "baseline": 30.0, "ratio": 3.0, "budget": ">= 2.5x", "ok": True}
    assert rows[1]["baseline"] is None
    assert rows[2]["ours"] is None


def test_the_text_has_a_line_for_each_row_that_says_what_failed():
    header, _, good, bad, absolute = to_text([GOOD, BAD, ABSOLUTE]).splitlines()
    assert header.split() == ["name", "ours", "baseline", "ratio", "budget", "ok"]
    assert good.split() == ["a_ms", "10", "30", "3x", ">=", "2.5x", "yes"]
    assert bad.split() == ["b_bytes", "30", "100", "0.3x", "<=", "0.2x", "NO"]
    assert absolute.split() == ["c_per_s", "700", "-", "-", ">=", "500", "/s", "yes"]
