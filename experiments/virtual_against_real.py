"""``python -m experiments.virtual_against_real --real DIR ... --virtual DIR ...``: does virtual time tell the truth?

Compares finished runs of one task, mode and network: the median from observation to action, and the steps per goal over
the whole run. Exit code 1 if they differ by more than they may.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common.errors import ConfigError, RelodError
from experiments.intervals import Interval, interval

MAX_LATENCY_DIFFERENCE = 0.15
"""Of the virtual runs' median latency, relative to that of the real runs."""
_SAME = ("task", "algorithm", "mode", "network", "steps")
"""What all the runs must have in common."""


@dataclass(frozen=True)
class Runs:
    """Some runs of one kind."""

    p50_ms: float
    """Median over the runs of their medians from observation to action."""
    p99_ms: float
    """Median over the runs of their 99th percentiles."""
    late: Interval
    """Share of the cycles whose action came after their end."""
    steps_per_goal: Interval
    """Steps of the run by its episodes."""

    @classmethod
    def of(cls, summaries: Sequence[dict[str, Any]]) -> Runs:
        """Put runs together."""
        latencies = [summary["observation_to_action_ms"] for summary in summaries]
        return cls(
            p50_ms=statistics.median(latency["p50"] for latency in latencies),
            p99_ms=statistics.median(latency["p99"] for latency in latencies),
            late=interval([summary["late_actions"] / summary["cycles"] for summary in summaries]),
            steps_per_goal=interval([summary["steps"] / summary["episodes"] for summary in summaries]),
        )


@dataclass(frozen=True)
class Comparison:
    """Real runs and virtual ones."""

    real: Runs
    virtual: Runs

    @property
    def latency_difference(self) -> float:
        """Of the virtual runs' median latency, relative to the real one's."""
        return self.virtual.p50_ms / self.real.p50_ms - 1

    @property
    def learning_overlaps(self) -> bool:
        """Whether the 95 % intervals of the steps per goal overlap."""
        real, virtual = self.real.steps_per_goal, self.virtual.steps_per_goal
        return abs(real.mean - virtual.mean) <= real.half + virtual.half

    @property
    def agrees(self) -> bool:
        """Whether virtual time may stand for real time."""
        return abs(self.latency_difference) <= MAX_LATENCY_DIFFERENCE and self.learning_overlaps

    def __str__(self) -> str:
        rows = [("", "real", "virtual")]
        rows += [
            (name, f"{getattr(self.real, key):.2f} ms", f"{getattr(self.virtual, key):.2f} ms")
            for name, key in (("observation to action, p50", "p50_ms"), ("observation to action, p99", "p99_ms"))
        ]
        rows.append(("late actions", _text(self.real.late, 100, " %"), _text(self.virtual.late, 100, " %")))
        rows.append(("steps per goal, 95 %", _text(self.real.steps_per_goal), _text(self.virtual.steps_per_goal)))
        lines = [f"{name:27} {real:>18} {virtual:>18}".rstrip() for name, real, virtual in rows]
        overlap = "overlap" if self.learning_overlaps else "do not overlap"
        limit = f"at most {100 * MAX_LATENCY_DIFFERENCE:.0f} %"
        verdict = "agree" if self.agrees else "DISAGREE"
        lines.append(f"p50 {100 * self.latency_difference:+.1f} % ({limit}), intervals {overlap}: {verdict}")
        return "\n".join(lines)


def compare(real: Sequence[Path], virtual: Sequence[Path]) -> Comparison:
    """Compare the runs in these folders.

    Raises:
        ConfigError: a run has no usable summary, or not the task, mode or network of the others.
    """
    for kind, run_dirs in (("real", real), ("virtual", virtual)):
        if len(run_dirs) < 2:
            raise ConfigError(f"--{kind}: one run: expected at least two, or there is no interval")
    summaries = {run_dir: _summary(run_dir) for run_dir in (*real, *virtual)}
    first, *others = summaries
    for run_dir in others:
        for key in _SAME:
            expected, found = summaries[first][key], summaries[run_dir][key]
            if found != expected:
                raise ConfigError(f"{run_dir}: {key} = {found!r}: expected {expected!r}, as in {first}")
    return Comparison(Runs.of([summaries[path] for path in real]), Runs.of([summaries[path] for path in virtual]))


def _summary(run_dir: Path) -> dict[str, Any]:
    path = run_dir / "summary.json"
    try:
        summary: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: expected a finished run's summary: {error}") from error
    for key in ("observation_to_action_ms", "episodes"):
        if not summary.get(key):
            raise ConfigError(f"{path}: {key} = {summary.get(key)!r}: nothing to compare")
    return summary


def _text(value: Interval, factor: float = 1.0, unit: str = "") -> str:
    return f"{factor * value.mean:.2f} ± {factor * value.half:.2f}{unit}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare from the command line; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.virtual_against_real", description="Compare real runs with virtual ones."
    )
    for kind, program in (("real", "deploy.launch"), ("virtual", "experiments.train --mode")):
        parser.add_argument(
            f"--{kind}", type=Path, nargs="+", required=True, metavar="RUN_DIR", help=f"records of {program}"
        )
    options = parser.parse_args(arguments)
    try:
        comparison = compare(options.real, options.virtual)
    except RelodError as error:
        print(f"experiments.virtual_against_real: error: {error}", file=sys.stderr)
        return 1
    print(comparison)
    return 0 if comparison.agrees else 1


if __name__ == "__main__":
    sys.exit(main())
