"""A study's README and tables: what was run, the numbers, what follows from them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from common.record import write_atomically
from deploy.run_file import versions
from experiments.csv_text import csv_text
from experiments.distribution.results import ConfigurationResult, PanelResult, StudyResult, curve_rows, run_rows
from experiments.intervals import Interval
from experiments.wording import counted

_DECIDE_RUNS = ("python", "numpy", "torch", "mujoco")
"""Whose next version may draw, compute or simulate differently."""
_READING = """\
Steps per goal are those of a whole run, resets included: its steps by its goals; a run without a goal counts as if it
had reached one at its end. Means are over seeds with 95 % intervals by Student's t. Ratios are geometric means over the
seeds that both have, with 95 % intervals from the logarithms; the intervals are not corrected for their number. Bars
are about the means."""


def write_tables(directory: Path, study: StudyResult) -> list[Path]:
    """Write ``results.csv`` and ``curves.csv``; return their paths."""
    paths = []
    for name, rows in {"results.csv": run_rows(study), "curves.csv": curve_rows(study)}.items():
        write_atomically(directory / name, csv_text(rows))
        paths.append(directory / name)
    return paths


def write_report(directory: Path, study: StudyResult, command: str, figures: Sequence[Path]) -> Path:
    """Write ``README.md``; return its path.

    Args:
        directory: of the results.
        study: what was found.
        command: that makes it again.
        figures: drawn already, in the same folder.
    """
    planned = sum(result.panel.seeds for result in study.configurations)
    finished = sum(len(result.runs) for result in study.configurations)
    decisive = ", ".join(f"{name} {version}" for name, version in versions().items() if name in _DECIDE_RUNS)
    lines = [f"# Distributions, size `{study.size.name}`", "", "```", command, "```", ""]
    lines += [f"{finished} of {planned} runs finished. Versions: {decisive}.", "", _READING, ""]
    for panel in study.panels:
        if panel.measured:
            lines += [f"## {_title(panel)}", "", *panel_lines(panel), ""]
    missing = [line for result in study.configurations for line in _missing(result)]
    if missing:
        lines += ["## Runs that are missing", "", *missing, ""]
    lines += [*(f"![{figure.stem}]({figure.name})" for figure in figures), ""]
    path = directory / "README.md"
    write_atomically(path, "\n".join(lines))
    return path


def table_text(study: StudyResult) -> str:
    """The tables alone, for a terminal."""
    return "\n\n".join("\n".join([_title(panel), *panel_lines(panel)]) for panel in study.panels if panel.measured)


def panel_lines(panel: PanelResult) -> list[str]:
    """The numbers of one panel, and how its configurations compare."""
    rows = [
        ["configuration", "runs", "steps per goal", "without a goal", "p50, ms", "late, %", "lost"],
        ["---", "--:", "--:", "--:", "--:", "--:", "--:"],
    ]
    for result in panel.measured:
        rows.append(
            [
                result.configuration.name,
                str(len(result.runs)),
                _interval_text(result.steps_per_goal),
                str(result.without_goal),
                f"{result.mean('p50_ms').mean:.1f}",
                _interval_text(result.mean("late"), 100.0, 2),
                str(result.lost),
            ]
        )
    lines = _table(rows)
    if panel.answers:
        rows = [
            ["configuration", "against", "ratio", "pairs", "here", "of means", "bar", "", "thesis"],
            ["---", "---", "--:", "--:", "---", "--:", "---", "---", "---"],
        ]
        for answer in panel.answers:
            question = answer.question
            within = "" if math.isnan(answer.low) else f" [{answer.low:.2f}, {answer.high:.2f}]"
            ratio = f"{answer.ratio:.2f}{within}"
            rows.append(
                [
                    question.configuration,
                    question.against,
                    ratio,
                    str(answer.pairs),
                    answer.verdict,
                    f"{answer.ratio_of_means:.2f}",
                    question.bar.text() if question.bar else "",
                    {None: "", True: "holds", False: "does not hold"}[answer.keeps_bar],
                    question.finding,
                ]
            )
        lines += ["", *_table(rows)]
    return lines


def _title(panel: PanelResult) -> str:
    return f"{panel.panel.title}, {panel.panel.steps} steps"


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return [f"| {' | '.join(text.ljust(width) for text, width in zip(row, widths, strict=True))} |" for row in rows]


def _missing(result: ConfigurationResult) -> list[str]:
    by_reason: Mapping[str, list[int]] = {reason: [] for reason in result.missing.values()}
    for seed, reason in result.missing.items():
        by_reason[reason].append(seed)
    return [
        f"- {result.configuration.name}, {result.panel.task}, {counted(len(seeds), 'seed')} "
        f"({', '.join(map(str, seeds))}): {reason}"
        for reason, seeds in by_reason.items()
    ]


def _interval_text(value: Interval, factor: float = 1.0, decimals: int = 1) -> str:
    mean = f"{factor * value.mean:.{decimals}f}"
    return mean if math.isnan(value.half) else f"{mean} +- {factor * value.half:.{decimals}f}"
