"""Episodes of a run, and the steps it takes to the goal."""

from pathlib import Path

import pytest

from deploy.episodes import EpisodeTable, steps_per_goal
from tests.deploy.hand_made_record import write_episodes


def test_a_growing_table_is_read_piece_by_piece(tmp_path: Path) -> None:
    table = EpisodeTable(tmp_path)
    assert table.update() == []
    write_episodes(tmp_path, [10, 25])
    assert [(e.steps, e.length, e.episode_return) for e in table.update()] == [(10, 10, -10.0), (25, 15, -15.0)]
    with (tmp_path / "episodes.csv").open("a", encoding="utf-8") as file:
        file.write("2,-5.0,5,1,3")  # a row on its way to the disk
        file.flush()
        assert len(table.update()) == 2
        file.write("0,30,1.2\n")
    assert [e.steps for e in table.update()] == [10, 25, 30]
    assert table.unreadable == 0


def test_rows_that_are_none_are_counted(tmp_path: Path) -> None:
    write_episodes(tmp_path, [10])
    with (tmp_path / "episodes.csv").open("a", encoding="utf-8") as file:
        file.write("1,-5.0,fi\n\x00\x00\n")
    table = EpisodeTable(tmp_path)
    assert len(table.update()) == 1
    assert table.unreadable == 2


@pytest.mark.parametrize(
    ("ends", "steps", "expected"),
    [
        ([100, 600, 1100, 1500], 1500, 1000 / 3),  # those after step 500
        ([500, 1500], 1500, 1000.0),  # step 500 is not among the last 1000
        ([501, 1500], 1500, 500.0),
        ([10, 30], 40, 20.0),  # a run of fewer steps than the window
        ([10], 2000, None),
        ([], 500, None),
    ],
)
def test_steps_per_goal_are_over_the_last_thousand_steps(
    tmp_path: Path, ends: list[int], steps: int, expected: float | None
) -> None:
    write_episodes(tmp_path, ends)
    assert steps_per_goal(EpisodeTable(tmp_path).update(), steps) == expected
