"""From rows to curves, tables, figures and words, with goals placed by hand."""

import csv
import math

import numpy as np
import pytest

from experiments.minimum_time.figures import draw_figures
from experiments.minimum_time.findings import correlation, findings
from experiments.minimum_time.report import report_text, table_text
from experiments.minimum_time.results import collect
from experiments.minimum_time.tables import curve_rows, hit_rows, run_rows, write_tables
from tests.experiments.minimum_time.rows_by_hand import HAND_MADE, hand_made_rows

ROWS = hand_made_rows(HAND_MADE)


def without(*seeds_of_limit):
    """The rows without the runs of some (limit, seed)."""
    return {key: row for key, row in ROWS.items() if key[0] == "hits" or (key[3], key[6]) not in seeds_of_limit}


def test_each_curve_has_its_runs_and_its_hits():
    study = collect(HAND_MADE, ROWS, {})
    limits, heads = study.panels
    assert [(curve.limit, len(curve.runs), len(curve.hits)) for curve in limits.curves] == [
        (2, 3, 4),
        (10, 3, 4),
        (50, 3, 4),
    ]
    # Hits of another head are counted for the seeds that learn.
    assert [(curve.head, len(curve.runs), len(curve.hits)) for curve in heads.curves] == [
        ("zero", 3, 4),
        ("default", 3, 3),
    ]
    assert [curve.final.mean for curve in limits.curves] == [pytest.approx(every) for every in (500, 100, 10)]
    # The zero head at limit 50 is in both figures, and in the tables once.
    assert [(curve.limit, curve.head) for curve in study.curves] == [
        (2, "zero"),
        (10, "zero"),
        (50, "zero"),
        (50, "default"),
    ]


def test_a_curve_is_the_mean_of_its_runs():
    curve = collect(HAND_MADE, ROWS, {}).panels[0].curves[1]
    # Episodes of 100 steps, the seeds' first one of 100, 99 and 98: it is in the windows that end by step 500 + that.
    first = [100, (99 + 4 * 100) / 5, (98 + 4 * 100) / 5]
    np.testing.assert_array_equal(curve.at, np.arange(500, 2001, 100))
    assert curve.curve.mean[0] == pytest.approx(-sum(first) / 3)
    assert curve.geometric_curve.mean[0] == pytest.approx(-(math.prod(first) ** (1 / 3)))
    for band in (curve.curve, curve.geometric_curve):
        assert band.low[0] < band.mean[0] < band.high[0]
        assert band.low[-1] == pytest.approx(band.high[-1]) == pytest.approx(-100.0)


def test_every_run_has_a_row_and_a_missing_one_its_reason():
    failed = next(key for key in ROWS if key[:1] == ("training",) and (key[3], key[4], key[6]) == (10, "zero", 1))
    study = collect(HAND_MADE, without((10, 1)), {failed: "crashed: ValueError: the robot fell over"})
    rows = list(run_rows(study.curves))
    assert len(rows) == 4 * 3
    (missing,) = [row for row in rows if row["status"] != "finished"]
    assert (missing["limit"], missing["seed"], missing["steps_per_goal"]) == (10, 1, "")
    assert missing["status"] == "crashed: ValueError: the robot fell over"
    first = rows[0]
    assert (first["limit"], first["seed"], first["goals"], first["goals_last_1000"]) == (2, 0, 4, 2)
    assert first["steps_per_goal"] == "500.000"  # the goal at 1000 is no longer among the last 1000 steps
    assert (first["hits"], first["hits_standard_error"]) == ("11.500", f"{math.sqrt(5 / 3 / 4):.3f}")
    assert "seed 1: crashed: ValueError: the robot fell over" in report_text(study, "command", [])


def test_tables_hold_every_count_and_every_point_once(tmp_path):
    study = collect(HAND_MADE, ROWS, {})
    assert len(list(hit_rows(study.curves))) == 3 * 4 + 3
    points = list(curve_rows(study.curves))
    assert len(points) == 4 * 16
    for path in write_tables(tmp_path, study):
        with path.open(newline="", encoding="utf-8") as file:
            assert len(list(csv.DictReader(file))) == {"results.csv": 12, "hits.csv": 15, "curves.csv": 64}[path.name]


def test_hits_that_go_with_performance_are_found_and_weighed():
    panel = collect(HAND_MADE, ROWS, {}).panels[0]
    found = correlation(panel)
    assert (found.final.rho, found.goals.rho) == (pytest.approx(-1), pytest.approx(1))
    text = " ".join(findings(panel))
    # Three limits fall into order by chance in 2 of 6 cases: no evidence, whatever the coefficient.
    assert "-1.00 over 3 limits" in text
    assert "p = 0.333" in text
    assert "no evidence" in text
    assert "fewest steps per goal at the end under limit 50" in text


def test_heads_are_compared_seed_by_seed():
    panel = collect(HAND_MADE, ROWS, {}).panels[1]
    (text,) = findings(panel)
    assert "10.0 +- 0.0 with the zero head, 20.0 +- 0.0 with the default one" in text
    assert "which needs 2.00 times as many [2.00, 2.00]: the zero head does better" in text
    assert "Goals of a whole run: 200.0 +- 0.0 and 100.0 +- 0.0, -100 [-100, -100]: the zero head does better" in text


def test_a_difference_that_the_seeds_do_not_agree_on_is_none():
    rows = dict(ROWS)
    for key, row in rows.items():
        if key[0] == "training" and key[4] == "default":
            every = (5, 10, 20)[key[6]]
            rows[key] = {**row, "goal_steps": list(range(every, 2001, every))}
    (text,) = findings(collect(HAND_MADE, rows, {}).panels[1])
    assert "no difference can be told at this size" in text


def test_what_there_is_of_an_unfinished_study_can_be_shown(tmp_path):
    # One run of limit 50, none of limit 2, and no hits at all.
    rows = {key: row for key, row in without((50, 1), (50, 2), (2, 0), (2, 1), (2, 2)).items() if key[0] != "hits"}
    study = collect(HAND_MADE, rows, {})
    write_tables(tmp_path, study)
    assert [path.name for path in draw_figures(tmp_path, study)] == ["learning_curves.png", "heads.png"]
    text = report_text(study, "command", [])
    assert "5 of 12 runs finished" in text
    assert "limit 2, zero head, seeds 0, 1, 2: not run yet" in text
    assert "nan" not in text + table_text(study)


def test_figures_show_every_panel(tmp_path):
    paths = draw_figures(tmp_path, collect(HAND_MADE, ROWS, {}))
    assert [path.name for path in paths] == ["learning_curves.png", "heads.png", "hits_and_performance.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths)
