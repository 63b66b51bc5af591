"""``learning_curve.png``: return, and steps per goal, over a run's steps."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
import numpy.typing as npt

from deploy.episodes import GOAL_WINDOW_STEPS, Episode

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOVING_AVERAGE_EPISODES = 20
_POINTS = 400
_EPISODE_COLOUR, _MEAN_COLOUR = "#9db8d2", "#1f4e79"

FloatArray = npt.NDArray[np.float64]


def moving_average(values: Sequence[float], width: int = MOVING_AVERAGE_EPISODES) -> FloatArray:
    """Mean of each value and the up to ``width - 1`` before it."""
    sums = np.concatenate([[0.0], np.cumsum(np.asarray(values, dtype=np.float64))])
    ends = np.arange(1, len(sums))
    starts = np.maximum(ends - width, 0)
    means: FloatArray = (sums[ends] - sums[starts]) / (ends - starts)
    return means


def sliding_steps_per_goal(
    episodes: Sequence[Episode], steps: int, window: int = GOAL_WINDOW_STEPS
) -> tuple[FloatArray, FloatArray]:
    """(steps of the run, steps per goal over the ``window`` steps before); NaN where no goal was reached in them."""
    goals = np.array([episode.steps for episode in episodes], dtype=np.float64)
    at = np.unique(np.linspace(1, max(steps, 1), _POINTS).round())
    widths = np.minimum(at, window)
    counts = np.searchsorted(goals, at, side="right") - np.searchsorted(goals, at - widths, side="right")
    return at, np.where(counts > 0, widths / np.maximum(counts, 1), np.nan)


def draw_learning_curve(
    to: Path | BinaryIO, episodes: Sequence[Episode], steps: int, has_goal: bool, title: str
) -> None:
    """Draw the curve of a run.

    Args:
        to: a PNG file.
        episodes: the completed ones, oldest first.
        steps: of the run.
        has_goal: whether steps per goal mean something.
        title: says which run it is.
    """
    # Not pyplot: no window system, no global state, fit for any thread.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 6.4 if has_goal else 3.8), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2 if has_goal else 1, 1, sharex=True, squeeze=False)[:, 0]
    _draw_returns(axes[0], episodes)
    if has_goal:
        _draw_steps_per_goal(axes[1], episodes, steps)
    axes[0].set_title(title)
    axes[-1].set_xlabel("steps of the run, resets included")
    axes[-1].set_xlim(0, max(steps, 1))
    figure.savefig(to, format="png", metadata={"Title": title})


def _draw_returns(axes: Axes, episodes: Sequence[Episode]) -> None:
    axes.set_ylabel("return of an episode")
    axes.grid(alpha=0.3)
    if not episodes:
        axes.text(0.5, 0.5, "no episode was completed", transform=axes.transAxes, ha="center", va="center")
        return
    at = [episode.steps for episode in episodes]
    returns = [episode.episode_return for episode in episodes]
    axes.plot(at, returns, ".", markersize=4, color=_EPISODE_COLOUR, label="episode")
    label = f"mean of {MOVING_AVERAGE_EPISODES} episodes"
    axes.plot(at, moving_average(returns), color=_MEAN_COLOUR, linewidth=1.8, label=label)
    axes.legend(loc="lower right", framealpha=0.9)


def _draw_steps_per_goal(axes: Axes, episodes: Sequence[Episode], steps: int) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    at, values = sliding_steps_per_goal(episodes, steps)
    axes.plot(at, values, color=_MEAN_COLOUR, linewidth=1.8)
    # From hundreds to ten: only a logarithmic axis shows both ends.
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel(f"steps per goal\n(last {GOAL_WINDOW_STEPS} steps)")
    axes.grid(alpha=0.3, which="both")


def load_drawing() -> None:
    """Import and set up what curves are drawn with, by drawing one: seconds of work, the first time on a computer."""
    draw_learning_curve(io.BytesIO(), [], 0, has_goal=True, title="")
