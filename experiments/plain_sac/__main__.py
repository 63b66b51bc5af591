"""``python -m experiments.plain_sac``: does the whole system learn as well as a SAC loop in one file?

Both learn Dot-Reacher with the same preset and several seeds; what is compared is the steps per goal over the last
1000 steps, resets included. Exit code 1 if the two means' 95 % intervals do not overlap or the means differ by more
than a quarter.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Sequence

import numpy as np

from common.console import Console
from common.options import output_folder
from experiments.plain_sac.loop import run
from experiments.train import Training, train

LAST = 1000
T_975 = {2: 12.706, 3: 4.303, 4: 3.182, 5: 2.776, 6: 2.571, 7: 2.447, 8: 2.365, 9: 2.306, 10: 2.262}
"""Number of seeds -> 97.5 % quantile of Student's t with one degree of freedom less."""
LARGEST_DIFFERENCE = 0.25


def steps_per_goal(goal_steps: Sequence[int], steps: int) -> float:
    """Steps per goal over the last 1000 steps; a run without a goal in them counts as one goal."""
    return LAST / max(1, sum(steps - LAST < at <= steps for at in goal_steps))


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Mean and half the width of its 95 % interval."""
    return float(np.mean(values)), T_975[len(values)] * float(np.std(values, ddof=1)) / len(values) ** 0.5


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare from the command line; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m experiments.plain_sac", description=__doc__)
    parser.add_argument("--seeds", type=int, default=5, choices=T_975, metavar="N", help="2 to 10 (default: 5)")
    parser.add_argument("--steps", type=int, default=5000, metavar="N", help="action cycles of a run (default: 5000)")
    parser.add_argument(
        "--out", type=output_folder, default="runs/plain_sac", metavar="DIR", help="folder of the results"
    )
    options = parser.parse_args(arguments)
    console, rows = Console(), []
    for seed in range(options.seeds):
        plain = steps_per_goal(run(seed, options.steps).goal_steps, options.steps)
        run_dir = options.out / f"seed{seed}"
        goals = train(Training("dot_reacher", run_dir, seed=seed, steps=options.steps))["steps_per_goal_last_1000"]
        rows.append({"seed": seed, "plain": round(plain, 3), "ours": goals if goals is not None else float(LAST)})
        console.line(f"seed {seed}: plain {rows[-1]['plain']}, ours {rows[-1]['ours']} steps per goal")
    with (options.out / "steps_per_goal.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ["seed", "plain", "ours"])
        writer.writeheader()
        writer.writerows(rows)
    (plain, plain_half), (ours, ours_half) = (interval([row[name] for row in rows]) for name in ("plain", "ours"))
    overlap = abs(plain - ours) <= plain_half + ours_half
    difference = abs(ours - plain) / plain
    console.line(f"plain {plain:.2f} +- {plain_half:.2f}, ours {ours:.2f} +- {ours_half:.2f} (95 %), steps per goal")
    console.line(f"intervals overlap: {'yes' if overlap else 'no'}; means differ by {100 * difference:.0f} %")
    return 0 if overlap and difference <= LARGEST_DIFFERENCE else 1


if __name__ == "__main__":
    sys.exit(main())
