"""The learning curve's numbers, and that it is drawn."""

from pathlib import Path

import numpy as np
import pytest

from deploy.curve import draw_learning_curve, moving_average, sliding_steps_per_goal
from deploy.episodes import Episode


def episodes_ending_at(*steps: int) -> list[Episode]:
    return [Episode(number, -10.0 - number, 10, 1, end) for number, end in enumerate(steps)]


def test_the_moving_average_begins_with_what_there_is() -> None:
    np.testing.assert_allclose(moving_average([1.0, 2.0, 3.0, 6.0], width=2), [1.0, 1.5, 2.5, 4.5])
    assert len(moving_average([])) == 0


def test_steps_per_goal_slide_over_the_run() -> None:
    at, values = sliding_steps_per_goal(episodes_ending_at(100, 200, 300), steps=400, window=200)
    by_step = dict(zip(at.tolist(), values.tolist(), strict=True))
    assert np.isnan(by_step[99.0])  # no goal yet
    assert by_step[100.0] == 100.0  # one in 100 steps
    assert by_step[250.0] == 100.0  # those at 100 and 200, in the 200 steps up to 250
    assert by_step[300.0] == 100.0  # those at 200 and 300: step 100 is just outside
    assert by_step[400.0] == 200.0  # that at 300


@pytest.mark.parametrize("has_goal", [True, False])
@pytest.mark.parametrize("ends", [(), (100,), tuple(range(50, 2000, 50))])
def test_a_curve_is_drawn_whatever_the_run_was(tmp_path: Path, ends: tuple[int, ...], has_goal: bool) -> None:
    path = tmp_path / "learning_curve.png"
    draw_learning_curve(path, episodes_ending_at(*ends), steps=ends[-1] if ends else 0, has_goal=has_goal, title="run")
    assert path.read_bytes().startswith(b"\x89PNG")
