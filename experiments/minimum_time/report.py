"""A study's README: what was run, the table, the figures, what follows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from common.record import write_atomically
from deploy.run_file import versions
from experiments.intervals import standard_error
from experiments.minimum_time.findings import findings, interval_text
from experiments.minimum_time.results import CurveResult, PanelResult, StudyResult

_DECIDE_RUNS = ("python", "numpy", "torch", "mujoco", "dm-control")
"""Whose next version may draw, compute or simulate differently."""
_READING = """\
Steps per goal are those of a run's last 1000 steps, resets included; a run that reached no goal in them counts with the
steps since its last goal (since its beginning, if there was none), which is at least 1000. Means are over seeds, with
95 % intervals by Student's t; geometric means and ratios have theirs from the logarithms. Hits are those of the initial
policy in 20 000 steps, mean and standard error. A point of a run's learning curve is the mean return of the episodes
that ended in the {window} steps before it; where none ended, it is minus the steps since the last goal."""


def write_report(directory: Path, study: StudyResult, command: str, figures: Sequence[Path]) -> Path:
    """Write ``README.md``; return its path.

    Args:
        directory: of the results.
        study: what was found.
        command: that makes it again.
        figures: drawn already, in the same folder.
    """
    path = directory / "README.md"
    write_atomically(path, report_text(study, command, [figure.name for figure in figures]))
    return path


def report_text(study: StudyResult, command: str, figures: Sequence[str]) -> str:
    """The README's text."""
    planned = sum(curve.panel.seeds for curve in study.curves)
    finished = sum(len(curve.runs) for curve in study.curves)
    lines = [
        f"# Minimum-time study, size `{study.size.name}`",
        "",
        "```",
        command,
        "```",
        "",
        f"{finished} of {planned} runs finished. Versions: "
        + ", ".join(f"{name} {version}" for name, version in versions().items() if name in _DECIDE_RUNS)
        + ".",
        "",
        _READING.format(window=study.size.window),
        "",
    ]
    for panel in study.panels:
        lines += [f"## {panel.title}", "", *_table(panel), ""]
    lines += ["## Findings", "", *(f"- {text}" for panel in study.panels for text in findings(panel)), ""]
    if finished < planned:
        lines += ["## Runs that are missing", ""]
        lines += [f"- {text}" for text in _missing(study)]
        lines.append("")
    lines += ["## Figures", "", *(f"![{name}]({name})" for name in figures), ""]
    return "\n".join(lines)


def table_text(study: StudyResult) -> str:
    """The tables alone, for a terminal."""
    return "\n\n".join("\n".join([panel.title, *_table(panel)]) for panel in study.panels)


def _table(panel: PanelResult) -> list[str]:
    rows = [
        ["limit", "head", "hits", "runs", "steps per goal at the end", "without a goal there", "goals of a run"],
        ["--:", "---", "--:", "--:", "--:", "--:", "--:"],
        *(_row(curve) for curve in panel.curves),
    ]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return [f"| {' | '.join(text.ljust(width) for text, width in zip(row, widths, strict=True))} |" for row in rows]


def _row(curve: CurveResult) -> list[str]:
    hits = list(curve.hits.values())
    measured = ["-"] * 3
    if curve.runs:
        measured = [interval_text(curve.final), str(curve.without_goal), interval_text(curve.goals)]
    return [
        str(curve.limit),
        curve.head,
        _with_error(float(np.mean(hits)), standard_error(hits)) if hits else "-",
        f"{len(curve.runs)} of {curve.panel.seeds}",
        *measured,
    ]


def _missing(study: StudyResult) -> Iterator[str]:
    """One line for the seeds of a curve that have the same reason."""
    for curve in study.curves:
        by_reason: dict[str, list[int]] = {}
        for seed, reason in curve.missing.items():
            by_reason.setdefault(reason, []).append(seed)
        for reason, seeds in by_reason.items():
            named = f"seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}"
            yield f"{curve.panel.task}, limit {curve.limit}, {curve.head} head, {named}: {reason}"


def _with_error(mean: float, error: float) -> str:
    return f"{mean:.1f}" if math.isnan(error) else f"{mean:.1f} +- {error:.1f}"
