"""``latency.png``: where actions' ages went, runs side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from services.robot_bridge.action_age import PARTS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DRAWN = ("p50", "p90", "p99")
"""Quantiles that the picture shows."""
_COLOURS = dict(zip(PARTS, ("#8c8c8c", "#c9a227", "#1f77b4", "#b5d0ea", "#d1495b", "#2a9d8f", "#6a4c93"), strict=True))
"""The two ways and the computation stand out; what only waits is pale."""
_LABELS = {"apply": "wait to apply"}
_PALE = ("encode", "queue")
_WRITTEN_SHARE = 0.04
"""A part narrower than this share of the axis has no room for its number."""
_LINEAR_BELOW_MS = 0.1


@dataclass(frozen=True)
class RunBars:
    """What is drawn of one run, milliseconds."""

    label: str
    parts: Mapping[str, Mapping[str, float]]
    """Part -> quantile of :data:`DRAWN` -> ms."""
    age: Mapping[str, float]
    """Quantile -> ms."""
    offset_bound: float
    """Largest error of uplink and downlink, median."""


def draw_latency(to: Path | BinaryIO, runs: Sequence[RunBars]) -> None:
    """Draw the runs' medians as stacked bars above, and each part's median to 99th percentile below."""
    # Not pyplot: no window system, no global state.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    heights = [1.4 + 0.75 * len(runs), 1.4 + 0.2 * len(PARTS) * (len(runs) + 0.5)]
    figure = Figure(figsize=(11.0, sum(heights)), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    stacks, spreads = figure.subplots(2, 1, gridspec_kw={"height_ratios": heights})
    _draw_stacks(stacks, runs)
    _draw_spreads(spreads, runs)
    for axes in (stacks, spreads):
        axes.grid(axis="x", alpha=0.3)
        axes.set_axisbelow(True)
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), fontsize=9, frameon=False)
    figure.savefig(to, format="png", metadata={"Title": "Where the latency goes"})


def _draw_stacks(axes: Axes, runs: Sequence[RunBars]) -> None:
    for part in PARTS:  # the legend in the order in which they pass, whichever run has which
        if _first_with(runs, part) is not None:
            axes.barh(0, 0.0, color=_COLOURS[part], label=_LABELS.get(part, part))
    room = 1.45 * max(sum(max(part["p50"], 0.0) for part in run.parts.values()) for run in runs)
    for at, run in enumerate(runs):
        left = 0.0
        for part, values in run.parts.items():
            width = max(values["p50"], 0.0)
            axes.barh(at, width, left=left, height=0.55, color=_COLOURS[part])
            if width > _WRITTEN_SHARE * room:
                colour = "black" if part in _PALE else "white"
                axes.text(left + width / 2, at, f"{width:.1f}", ha="center", va="center", color=colour, fontsize=9)
            left += width
        age = " / ".join(f"{run.age[quantile]:.1f}" for quantile in DRAWN)
        axes.text(left, at, f"  age {age} ms\n  ({' / '.join(DRAWN)})", va="center", fontsize=9)
    axes.set_yticks(range(len(runs)), [f"{run.label}\nclock ± {run.offset_bound:.2f} ms" for run in runs], fontsize=9)
    axes.set_ylim(len(runs) - 0.5, -0.5)
    axes.set_xlim(0.0, max(room, 1e-3))
    axes.set_xlabel("ms")
    axes.set_title(
        "Age of an action when the robot obeys it: median of each part\n"
        "(one way may seem too long, and the other too short, by at most the clock's error)",
        fontsize=11,
    )


def _draw_spreads(axes: Axes, runs: Sequence[RunBars]) -> None:
    """Each part's median, with a line over its 90th to its 99th percentile; one colour for a run."""
    from matplotlib import colormaps

    colours = colormaps["tab10"].colors  # type: ignore[attr-defined]
    shown = [part for part in PARTS if _first_with(runs, part) is not None]
    room = 0.8 / len(runs)
    for number, run in enumerate(runs):
        colour = colours[number % len(colours)]
        for at, part in enumerate(shown):
            if values := run.parts.get(part):
                y = at - 0.4 + room * (number + 0.5)
                label = run.label.splitlines()[0] if part == next(iter(run.parts)) else None
                axes.plot([values[name] for name in DRAWN], [y] * len(DRAWN), "-|", color=colour, markersize=7)
                axes.plot([values["p50"]], [y], "o", color=colour, markersize=6, label=label)
                text = f"  {values['p50']:.2f} – {values['p99']:.2f}"
                axes.text(max(values.values()), y, text, va="center", fontsize=8)
    longest = max(values["p99"] for run in runs for values in run.parts.values())
    least = min(values["p50"] for run in runs for values in run.parts.values())
    # From hundredths to hundreds: only a logarithmic axis shows both ends; below a tenth it is linear, for 0 is there.
    axes.set_xscale("symlog", linthresh=_LINEAR_BELOW_MS)
    axes.set_xlim(min(0.0, 1.3 * least), 7.0 * max(longest, _LINEAR_BELOW_MS))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_yticks(range(len(shown)), [_LABELS.get(part, part) for part in shown])
    axes.set_ylim(len(shown) - 0.5, -0.5)
    axes.set_xlabel("ms (dot: p50, ticks: p90 and p99)")


def _first_with(runs: Sequence[RunBars], part: str) -> int | None:
    """The first run that has the part."""
    return next((at for at, run in enumerate(runs) if part in run.parts), None)
