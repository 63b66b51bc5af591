"""``python -m deploy.latency RUN_DIR [RUN_DIR ...]``: where each action's age went, as a table and as a picture.

An action's age is the time from the capture of the newest camera frame it was computed from to the moment at which the
robot obeys it. The parts are explained in :mod:`services.robot_bridge.action_age`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.errors import ConfigError, RelodError
from common.topics import ROBOT_BRIDGE
from deploy.action_age import AGE, QUANTILES, WAYS, ActionAges
from deploy.latency_picture import DRAWN, RunBars, draw_latency
from deploy.record_folders import find_file
from deploy.run_file import RunFile
from services.robot_bridge.action_age import PARTS

PICTURE = "latency.png"


@dataclass(frozen=True)
class RunLatency:
    """One run: what it was, and its actions' ages."""

    run_dir: Path
    mode: str
    """Mode and network; empty where the record does not know them."""
    task: str
    ages: ActionAges
    copy: Path | None = None
    """Folder of copies that the ages were read from, where the robot's computer was another one."""

    @classmethod
    def read(cls, run_dir: Path) -> RunLatency:
        """Read a run's record.

        Raises:
            ConfigError: there is nothing in it that can be split.
        """
        if not run_dir.is_dir():
            raise ConfigError(f"{run_dir}: no such run directory")
        otherwise = "expected the run directory of a run in which actions arrived"
        folder = find_file(run_dir, "actions.csv", ROBOT_BRIDGE, otherwise).parent
        ages, copy = ActionAges.read(folder), None if folder == run_dir else folder
        try:
            run = RunFile.read(run_dir)
        except ConfigError:  # of a run that was put together by hand
            return cls(run_dir, "", "", ages, copy)
        return cls(run_dir, f"{run.mode}, network {Path(run.network).stem}", run.task, ages, copy)


def table(run: RunLatency) -> str:
    """One run's parts as text."""
    ages = run.ages
    quantiles = ages.quantiles_ms()
    facts = ", ".join(filter(None, (run.mode, run.task)))
    lines = [f"{run.run_dir}{facts and f': {facts}'}", f"  {'ms':<12}" + "".join(f"{name:>10}" for name in QUANTILES)]
    for part in (*PARTS, AGE):
        values = quantiles.get(part)
        cells = (f"{values[name]:>10.3f}" if values else f"{'-':>10}" for name in QUANTILES)
        lines.append(f"  {part:<12}" + "".join(cells))
    p50, largest = np.percentile(ages.offset_bound, [50, 100])
    lines.append(
        f"  {' and '.join(WAYS)} may be off by {p50:.3f} ms (p50; at most {largest:.3f} ms), one too long and the "
        "other too short: the error bound of the clocks' offset"
    )
    where = f"; as far as they were copied to {run.copy}" if run.copy else ""
    lines.append(f"  {len(ages.age)} applied actions{_left_out(ages)}{where}")
    return "\n".join(lines)


def _left_out(ages: ActionAges) -> str:
    reasons = {
        "answered but not applied": ages.not_applied,
        "before the clocks' offset was known": ages.unknown,
        "across a clock's jump": ages.contradicted,
        "unreadable": ages.unreadable,
    }
    counted = [f"{count} {reason}" for reason, count in reasons.items() if count]
    return f"; left out: {', '.join(counted)}" if counted else ""


def draw(runs: Sequence[RunLatency], path: Path) -> None:
    """Draw the runs side by side."""
    bars = []
    for run in runs:
        quantiles = run.ages.quantiles_ms()
        age = quantiles.pop(AGE)
        bars.append(
            RunBars(
                label="\n".join(filter(None, (run.run_dir.resolve().name, run.mode))),
                parts={part: {name: values[name] for name in DRAWN} for part, values in quantiles.items()},
                age={name: age[name] for name in DRAWN},
                offset_bound=float(np.percentile(run.ages.offset_bound, 50)),
            )
        )
    draw_latency(path, bars)


def main(arguments: Sequence[str] | None = None) -> int:
    """Show runs' latencies from the command line; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m deploy.latency", description="Split each action's age into its parts, run by run."
    )
    parser.add_argument("run_dirs", type=Path, nargs="+", metavar="RUN_DIR", help="folder of a run's record")
    parser.add_argument(
        "--picture", type=Path, metavar="FILE", help=f"where the picture goes (default: {PICTURE} in the first RUN_DIR)"
    )
    options = parser.parse_args(arguments)
    picture = options.picture or options.run_dirs[0] / PICTURE
    try:
        if picture.suffix.lower() != ".png":
            raise ConfigError(f"--picture {picture}: expected a name that ends in .png, for that is what is written")
        runs = [RunLatency.read(run_dir) for run_dir in options.run_dirs]
        draw(runs, picture)
    except RelodError as error:
        print(f"deploy.latency: error: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"deploy.latency: error: {picture}: cannot be written: {error.strerror}", file=sys.stderr)
        return 1
    print("\n\n".join(table(run) for run in runs))
    print(picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
