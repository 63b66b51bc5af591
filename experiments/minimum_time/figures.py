"""Learning curves with their bands, and hits against performance."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from experiments.intervals import standard_error
from experiments.minimum_time.findings import correlation
from experiments.minimum_time.results import CurveResult, PanelResult, StudyResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as MatplotlibFigure

HITS_FIGURE = "hits_and_performance.png"
_COLOURS = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#bbbbbb", "#000000")
_BEST_RETURN = -1.0
"""An episode takes a step at least."""
_WIDTH, _HEIGHT = 5.4, 3.8


def draw_figures(directory: Path, study: StudyResult) -> list[Path]:
    """Draw all figures; return their paths."""
    paths = []
    for figure, panels in study.figures:
        drawing, (upper, lower) = _new(2, len(panels), figure.title)
        for linear, logarithmic, panel in zip(upper, lower, panels, strict=True):
            _draw_curves(linear, logarithmic, panel)
        paths.append(_save(drawing, directory / f"{figure.name}.png"))
    compared = [panel for panel in study.panels if len(panel.comparable) > 1 and not panel.compares_heads]
    if compared:
        drawing, (row,) = _new(1, len(compared), "Hits of the initial policy, and what was learnt")
        for axis, panel in zip(row, compared, strict=True):
            _draw_hits(axis, panel)
        paths.append(_save(drawing, directory / HITS_FIGURE))
    return paths


def _new(rows: int, columns: int, title: str) -> tuple[MatplotlibFigure, Sequence[Sequence[Axes]]]:
    # Not pyplot: no window system, no global state.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(max(_WIDTH * columns, 7.0), _HEIGHT * rows), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    return figure, list(figure.subplots(rows, columns, squeeze=False))


def _save(figure: MatplotlibFigure, path: Path) -> Path:
    figure.savefig(path, format="png", metadata={"Software": None})
    return path


def _draw_curves(linear: Axes, logarithmic: Axes, panel: PanelResult) -> None:
    """Draw the thesis's mean, and below it the geometric one on an axis that shows thousands as well as tens."""
    heads = f", limit {panel.panel.limits[0]}" if panel.compares_heads and len(panel.panel.limits) == 1 else ""
    runs = sorted({len(curve.runs) for curve in panel.curves})
    linear.set_title(f"{panel.title}{heads}: {' or '.join(map(str, runs))} runs, 95 % bands", fontsize=10)
    linear.set_ylabel("return of an episode, mean")
    logarithmic.set_ylabel("return of an episode, geometric mean")
    logarithmic.set_xlabel("steps of the run, resets included")
    curves = [(curve, colour) for curve, colour in zip(panel.curves, _COLOURS, strict=False) if curve.runs]
    for curve, colour in curves:
        label = f"{curve.head} head" if panel.compares_heads else f"limit {curve.limit}"
        for axis, band in ((linear, curve.curve), (logarithmic, curve.geometric_curve)):
            axis.plot(curve.at, band.mean, color=colour, linewidth=1.6, label=label)
            # Where the band of the mean goes beyond what a return can be, it is cut off.
            high = np.minimum(band.high, _BEST_RETURN)
            axis.fill_between(curve.at, band.low, high, color=colour, alpha=0.18, linewidth=0)
    for axis in (linear, logarithmic):
        axis.set_xlim(0, panel.panel.steps)
        axis.grid(alpha=0.3, which="both")
    if curves:
        linear.set_ylim(top=0)
        _from_thousands_to_one(logarithmic)
        linear.legend(fontsize=8, framealpha=0.9)


def _draw_hits(axis: Axes, panel: PanelResult) -> None:
    curves: list[CurveResult] = panel.comparable
    for curve, colour in zip(curves, _COLOURS, strict=False):
        hits, final = list(curve.hits.values()), curve.final
        lower = min(final.half, final.mean - 1.0)  # a goal takes a step at least
        axis.errorbar(
            [float(np.mean(hits))],
            [final.mean],
            xerr=[standard_error(hits)],
            yerr=[[lower], [final.half]],
            fmt="o",
            capsize=3,
            color=colour,
            label=f"limit {curve.limit}",
        )
    title = panel.title
    if found := correlation(panel):
        title += f": rank correlation {found.final.rho:+.2f} [{found.final.low:+.2f}, {found.final.high:+.2f}]"
    axis.set_title(title, fontsize=10)
    _plain_logarithmic(axis)
    axis.set_xlabel("hits in 20 000 steps, with standard error")
    axis.set_ylabel("steps per goal at the end, with 95 % interval")
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=8, framealpha=0.9)


def _from_thousands_to_one(axis: Axes) -> None:
    from matplotlib.ticker import FuncFormatter, NullFormatter

    axis.set_yscale("symlog", linthresh=1.0, linscale=0.1, subs=(2, 5))
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.yaxis.set_minor_formatter(NullFormatter())
    axis.set_ylim(top=_BEST_RETURN)


def _plain_logarithmic(axis: Axes) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_yscale("log")
    axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.yaxis.set_minor_formatter(NullFormatter())
