"""Hits as rows, as a table and as a figure."""

import math

import pytest

from experiments.target_hits.figure import draw_hits
from experiments.target_hits.jobs import HitCount, hit_counts
from experiments.target_hits.table import Cell, cells, csv_text, notes, standard_error, table_text

COUNTS = [HitCount("dot", 10, 0, 4), HitCount("dot", 10, 1, 8), HitCount("dot", 100, 0, 7)]


def test_rows_are_sorted_by_number_whatever_order_jobs_ended_in():
    rows = {
        ("dot", 100, 0): {"hits": 7},
        ("dot", "start", 3): {"steps": 9, "effort": 100},
        ("dot", 10, 1): {"hits": 8},
        ("dot", 10, 0): {"hits": 4},
    }
    assert hit_counts(rows) == COUNTS
    assert csv_text(COUNTS) == "task,limit,seed,hits\ndot,10,0,4\ndot,10,1,8\ndot,100,0,7\n"


def test_mean_and_standard_error_over_seeds():
    first, second = cells(COUNTS)
    # 4 and 8: mean 6, deviation sqrt(8), over sqrt(2)
    assert first == Cell("dot", 10, 6.0, 2.0, 2)
    assert (second.mean, second.seeds, math.isnan(second.standard_error)) == (7.0, 1, True)
    assert standard_error([3, 3, 3]) == 0.0


def test_the_table_shows_each_cell_and_how_many_seeds_are_behind_it():
    text = table_text(cells(COUNTS), 20_000)
    assert "in 20000 steps" in text
    assert text.splitlines()[-2:] == [
        "              10 steps     6.0 ± 2.0 (2)",
        "             100 steps     7.0 ±   - (1)",
    ]


def test_one_step_is_no_steps_and_stays_in_its_column():
    lines = table_text(cells([HitCount("dot", 1, 0, 4), HitCount("dot", 10, 0, 4)]), 20_000).splitlines()
    assert lines[-2:] == ["               1 step      4.0 ±   - (1)", "              10 steps     4.0 ±   - (1)"]


def test_a_task_whose_goal_comes_in_every_other_step_is_called_trivial():
    # 150 hits in 200 steps are 1.33 steps each; 100 are 2.
    of = cells([HitCount("near", 1, 0, 120), HitCount("near", 2, 0, 150), HitCount("far", 1, 0, 100)])
    (note,) = notes(of, 200)
    assert note.startswith("near is trivial: under 2 steps the untrained policy reaches the goal every 1.3 steps.")


@pytest.mark.parametrize("tasks", [1, 2, 5])
def test_a_figure_is_drawn_for_any_number_of_tasks(tmp_path, tasks):
    of = [Cell(f"task {task}", limit, 3.0, math.nan, 1) for task in range(tasks) for limit in (1, 5000)]
    draw_hits(tmp_path / "hits.png", of, 20_000, show_sufficient=True)
    assert (tmp_path / "hits.png").read_bytes().startswith(b"\x89PNG")
