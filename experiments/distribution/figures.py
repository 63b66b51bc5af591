"""A figure for each panel: steps per goal of each configuration, and the learning curves."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from experiments.distribution.results import PanelResult, StudyResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = ("#000000", "#4477aa", "#66ccee", "#ee6677", "#aa3377", "#228833", "#ccbb44")
_ROOM = 1.5
"""Between what is drawn and the frame, on a logarithmic axis."""


def draw_figures(directory: Path, study: StudyResult) -> list[Path]:
    """Draw all figures; return their paths."""
    return [_draw(directory, panel) for panel in study.panels if panel.measured]


def _draw(directory: Path, panel: PanelResult) -> Path:
    # Not pyplot: no window system, no global state.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 4.5), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    runs = sorted({len(result.runs) for result in panel.measured})
    figure.suptitle(f"{panel.panel.title}: {' or '.join(map(str, runs))} runs of {panel.panel.steps} steps, 95 %")
    means, curves = figure.subplots(1, 2)
    _draw_means(means, panel)
    _draw_curves(curves, panel)
    path = directory / f"{panel.panel.name}.png"
    figure.savefig(path, format="png", metadata={"Software": None})
    return path


def _draw_means(axis: Axes, panel: PanelResult) -> None:
    from matplotlib.ticker import LogFormatter

    names = [result.configuration.name for result in panel.measured]
    for row, (result, colour) in enumerate(zip(panel.measured, _COLOURS, strict=False)):
        mean = result.steps_per_goal
        error = None if len(result.runs) < 2 else mean.half
        axis.plot(
            [run.steps_per_goal for run in result.runs], [row + 0.2] * len(result.runs), ".", color=colour, alpha=0.4
        )
        axis.errorbar([mean.mean], [row], xerr=error, fmt="o", capsize=4, color=colour)
    axis.set_yticks(range(len(names)), names)
    axis.invert_yaxis()
    axis.set_xscale("log")  # Configurations differ by factors; of an interval that reaches 0 the rest is shown.
    values = [run.steps_per_goal for result in panel.measured for run in result.runs]
    axis.set_xlim(min(values) / _ROOM, max(values) * _ROOM)
    axis.xaxis.set_major_formatter(LogFormatter())
    axis.xaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.5, 0.5)))  # Only where they fit.
    axis.set_xlabel("steps per goal over the run (dots: runs)")
    axis.grid(alpha=0.3, axis="x", which="both")


def _draw_curves(axis: Axes, panel: PanelResult) -> None:
    from matplotlib.ticker import LogFormatter

    for result, colour in zip(panel.measured, _COLOURS, strict=False):
        mean, low, high = result.curve
        axis.plot(result.at, mean, color=colour, linewidth=1.6, label=result.configuration.name)
        axis.fill_between(result.at, low, high, color=colour, alpha=0.15, linewidth=0)
    axis.set_yscale("log")
    highest = max(float(np.nanmax(result.curve[0])) for result in panel.measured)
    axis.yaxis.set_major_formatter(LogFormatter())
    axis.set_ylim(1, highest * _ROOM)  # The bands of few runs go far beyond.
    axis.set_xlim(0, panel.panel.steps)
    axis.set_xlabel("steps of the run, resets included")
    axis.set_ylabel(f"steps per goal in {panel.panel.window} steps, geometric mean")
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=8)
