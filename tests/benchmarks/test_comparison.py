"""Comparisons: sides in processes of their own, rounds in turn, medians, and what goes wrong with them."""

from __future__ import annotations

import pytest

from benchmarks.comparison import Comparison, RowPlan, Side, check_agreement, rows_of, run
from benchmarks.side import UnavailableError
from benchmarks.side_process import SideError, side_environment
from benchmarks.table import Budget, Row

MODULE = "tests.benchmarks.sides"
TWICE = Budget(">=", 2.0)


def side(function, tolerance=1e-3, **options):
    return Side(f"{MODULE}:{function}", options, tolerance)


def comparison(ours, baseline, rounds=1):
    return Comparison({"ours": ours, "baseline": baseline}, (RowPlan("a_ms", TWICE, "ours", "baseline"),), rounds)


def quiet(text):
    pass


def test_each_number_is_the_median_of_its_sides_rounds():
    rows = rows_of(
        (RowPlan("a_ms", TWICE, "ours", "baseline"), RowPlan("b_ms", Budget("<", 4.0, "ms"), "ours")),
        {"ours": [3.0, 100.0, 1.0], "baseline": [9.0, 2.0, 9.0]},
    )
    assert rows == [Row("a_ms", 3.0, 9.0, 3.0, ">= 2x", True), Row("b_ms", 3.0, None, None, "< 4 ms", True)]


def test_both_sides_are_measured_in_their_own_processes():
    rows = run(comparison(side("rising", values=[5, 1, 3]), side("rising", values=[8, 9, 7]), rounds=3), quiet)
    assert rows == [Row("a_ms", 3.0, 8.0, 2.667, ">= 2x", True)]


def test_sides_that_computed_something_else_are_not_compared():
    with pytest.raises(SideError, match=r"ours computed 2.5, baseline 2: expected the same within 0.02"):
        run(
            comparison(
                side("constant", value=1, result=[1, 2.5], tolerance=0.01), side("constant", value=2, result=[1, 2])
            ),
            quiet,
        )


def test_results_may_differ_by_the_tolerance_of_the_largest_number():
    compared = comparison(side("constant", tolerance=0.01), side("constant"))
    check_agreement(compared, {"ours": [0.9, 100.0], "baseline": [0.0, 100.0]})
    with pytest.raises(SideError):
        check_agreement(compared, {"ours": [1.1, 100.0], "baseline": [0.0, 100.0]})
    with pytest.raises(SideError):
        check_agreement(compared, {"ours": [float("nan"), 100.0], "baseline": [0.0, 100.0]})
    with pytest.raises(SideError, match="ours gave 1 results, baseline 2"):
        check_agreement(compared, {"ours": [1.0], "baseline": [1.0, 2.0]})


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        ("failing", "ValueError: no such thing"),
        ("failing_later", "ValueError: worn out"),
        ("dying", "exit code 3: out of memory"),
    ],
)
def test_a_side_that_fails_says_why(function, reason):
    with pytest.raises(SideError, match=reason):
        run(comparison(side("constant", value=1), side(function)), quiet)


def test_what_this_computer_lacks_is_no_failure():
    with pytest.raises(UnavailableError, match="install libegl1"):
        run(comparison(side("unavailable"), side("constant", value=1)), quiet)


def test_every_side_has_one_thread_and_nobodys_tuned_allocator(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "8")
    monkeypatch.setenv("MALLOC_TOP_PAD_", "1")
    rows = run(
        comparison(side("environment", name="OMP_NUM_THREADS"), side("environment", name="MALLOC_TOP_PAD_")), quiet
    )
    assert (rows[0].ours, rows[0].baseline) == (1.0, -1.0)
    assert side_environment({"HOME": "/root", "GOMP_CPU_AFFINITY": "0"}).keys() == {
        "HOME",
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
    }


def test_only_the_wanted_rows_and_their_sides_are_left():
    sides = {"bf16": side("constant"), "fp32": side("constant"), "plain": side("constant")}
    plans = (RowPlan("a_bf16_ms", TWICE, "bf16", "plain"), RowPlan("a_fp32_ms", TWICE, "fp32", "plain"))
    whole = Comparison(sides, plans, rounds=3)
    part = whole.only(lambda name: "fp32" in name)
    assert part == Comparison({"fp32": sides["fp32"], "plain": sides["plain"]}, plans[1:], rounds=3)
    assert whole.only(lambda name: "visual" in name) is None
