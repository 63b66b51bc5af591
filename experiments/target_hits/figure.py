"""Target hits over time limits, as in figures 7.2 and 8.4."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from experiments.target_hits.guideline import SUFFICIENT_HITS
from experiments.target_hits.table import Cell

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLUMNS = 3
_BAR_COLOUR, _LINE_COLOUR = "#9db8d2", "#1f4e79"


def draw_hits(to: Path, of: Sequence[Cell], steps: int, show_sufficient: bool) -> None:
    """Draw one panel a task.

    Args:
        to: a PNG file.
        of: the bars.
        steps: in which the hits were counted.
        show_sufficient: draw the line of the guideline, which is for 20 000 steps.
    """
    # Not pyplot: no window system, no global state.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    tasks = list(dict.fromkeys(cell.task for cell in of))
    columns = min(len(tasks), _COLUMNS)
    rows = -(-len(tasks) // columns)
    figure = Figure(figsize=(4.2 * columns + 0.6, 3.2 * rows + 0.4), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel, task in zip(panels, tasks, strict=False):
        _draw_task(panel, [cell for cell in of if cell.task == task])
        panel.set_title(task)
        if show_sufficient:
            panel.axhline(SUFFICIENT_HITS, color=_LINE_COLOUR, linewidth=1, linestyle="--")
            panel.set_ylim(top=max(panel.get_ylim()[1], 1.1 * SUFFICIENT_HITS))
    for panel in panels[len(tasks) :]:
        panel.set_visible(False)
    for panel in panels[::columns]:
        panel.set_ylabel(f"target hits in {steps} steps")
    dashed = f"; dashed: the {SUFFICIENT_HITS:g} hits that are sufficient" if show_sufficient else ""
    figure.suptitle(f"initial policy; error bars are standard errors over seeds{dashed}", fontsize="medium")
    figure.savefig(to, format="png", metadata={"Title": "target hits of the initial policy"})


def _draw_task(panel: Axes, of: Sequence[Cell]) -> None:
    at = np.arange(len(of))
    errors = np.nan_to_num([cell.standard_error for cell in of])
    panel.bar(at, [cell.mean for cell in of], yerr=errors, capsize=3, color=_BAR_COLOUR, ecolor=_LINE_COLOUR)
    panel.set_xticks(at, [str(cell.limit) for cell in of], rotation=45)
    panel.set_xlabel("time limit, steps")
    panel.set_ylim(bottom=0)
    panel.grid(axis="y", alpha=0.3)
