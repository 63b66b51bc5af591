"""The study's numbers as CSV files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from common.record import write_atomically
from experiments.csv_text import csv_text, number_text
from experiments.intervals import standard_error
from experiments.minimum_time.results import CurveResult, StudyResult

FINISHED = "finished"


def write_tables(directory: Path, study: StudyResult) -> list[Path]:
    """Write ``results.csv``, ``hits.csv`` and ``curves.csv``; return their paths."""
    tables = {
        "results.csv": run_rows(study.curves),
        "hits.csv": hit_rows(study.curves),
        "curves.csv": curve_rows(study.curves),
    }
    paths = []
    for name, rows in tables.items():
        path = directory / name
        write_atomically(path, csv_text(rows))
        paths.append(path)
    return paths


def run_rows(curves: Iterable[CurveResult]) -> Iterator[Mapping[str, Any]]:
    """One row a run, also of those that failed."""
    for curve in curves:
        hits = list(curve.hits.values())
        of_curve = {
            **_names(curve),
            "hits": number_text(float(np.mean(hits)) if hits else float("nan")),
            "hits_standard_error": number_text(standard_error(hits) if hits else float("nan")),
        }
        for run in curve.runs:
            yield {
                **of_curve,
                "seed": run.seed,
                "steps": run.steps,
                "goals": run.goals,
                "goals_last_1000": run.last_goals,
                "steps_per_goal": number_text(run.steps_per_goal),
                "status": FINISHED,
            }
        for seed, reason in curve.missing.items():
            yield {
                **of_curve,
                "seed": seed,
                "steps": curve.panel.steps,
                **dict.fromkeys(("goals", "goals_last_1000", "steps_per_goal"), ""),
                "status": reason,
            }


def hit_rows(curves: Iterable[CurveResult]) -> Iterator[Mapping[str, Any]]:
    """One row a count of the initial policy's hits."""
    seen: set[tuple[Any, ...]] = set()
    for curve in curves:
        names = _names(curve)
        for seed, hits in curve.hits.items():
            row = {**names, "seed": seed, "hits": hits}
            if tuple(row.values()) not in seen:
                seen.add(tuple(row.values()))
                yield row


def curve_rows(curves: Iterable[CurveResult]) -> Iterator[Mapping[str, Any]]:
    """One row a point of a learning curve."""
    for curve in curves:
        if not curve.runs:
            continue
        columns = {
            f"{kind}return{part}": values
            for kind, band in (("", curve.curve), ("geometric_", curve.geometric_curve))
            for part, values in (("", band.mean), ("_low", band.low), ("_high", band.high))
        }
        for at, *values in zip(curve.at, *columns.values(), strict=True):
            numbers = dict(zip(columns, map(number_text, values), strict=True))
            yield {**_names(curve), "step": int(at), "runs": len(curve.runs), **numbers}


def _names(curve: CurveResult) -> dict[str, Any]:
    return {"task": curve.panel.task, "preset": curve.panel.preset, "limit": curve.limit, "head": curve.head}
