"""``python -m benchmarks.bench``: every performance claim of this project against its budget. Used by ``make bench``.

Prints one table and writes it as JSON; the exit code is 1 where a budget fails. docs/benchmarks.md explains the rows.
"""

from __future__ import annotations

import argparse
import errno
import os
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks import inference, minibatches, policy_weights, rendering, replay, round_trip, updates
from benchmarks.comparison import Comparison, run
from benchmarks.side import UnavailableError
from benchmarks.side_process import SideError
from benchmarks.table import Row, exit_code, to_json, to_text, unmeasured
from common.record import write_atomically

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""

SUBJECTS = (updates, inference, replay, policy_weights, round_trip, minibatches, rendering)
"""Modules that say in ``comparisons()`` what they measure."""


def all_comparisons() -> list[Comparison]:
    """Return every comparison this computer can be asked for."""
    return [comparison for subject in SUBJECTS for comparison in subject.comparisons()]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print, write; return the exit code."""
    comparisons = all_comparisons()
    names = [plan.name for comparison in comparisons for plan in comparison.plans]
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.bench", description=__doc__, epilog=f"rows: {', '.join(names)}"
    )
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="only rows whose name contains a NAME")
    parser.add_argument("--quick", action="store_true", help="one round of each side: does it run?")
    parser.add_argument("--out", type=Path, default=Path("runs/bench.json"), metavar="FILE", help="(%(default)s)")
    options = parser.parse_args(arguments)
    for text in options.only:
        if not any(text in name for name in names):
            parser.error(f"--only {text}: expected a part of one of {', '.join(names)}")
    if options.only:
        kept = [comparison.only(lambda name: any(text in name for text in options.only)) for comparison in comparisons]
        comparisons = [comparison for comparison in kept if comparison is not None]
    if options.quick:
        comparisons = [comparison.quick() for comparison in comparisons]
    try:
        _try_to_write_beside(options.out)
    except OSError as error:
        print(f"benchmarks.bench: error: --out {options.out}: {error.strerror}; choose another file", file=sys.stderr)
        return 1
    try:
        rows, notes = measure(comparisons)
    except KeyboardInterrupt:
        print("\ninterrupted: nothing was written", file=sys.stderr)
        return INTERRUPTED
    print(f"\n{to_text(rows)}")
    for note in notes:
        print(note)
    write_atomically(options.out, to_json(rows))
    print(f"written to {options.out}")
    return exit_code(rows)


def _try_to_write_beside(path: Path) -> None:
    """Find out before minutes of measuring; raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=path.parent):
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))


def measure(comparisons: Sequence[Comparison]) -> tuple[list[Row], list[str]]:
    """Return the rows, and what has to be said about rows that could not be measured."""
    rows: list[Row] = []
    notes: list[str] = []
    for number, comparison in enumerate(comparisons, start=1):
        names = ", ".join(plan.name for plan in comparison.plans)
        print(f"[{number}/{len(comparisons)}] {names}", flush=True)
        begun = time.monotonic()
        try:
            rows += run(comparison, lambda text: print(f"    {text}", flush=True))
        except UnavailableError as error:
            notes.append(f"{names}: skipped: {error}")
        except SideError as error:
            rows += [unmeasured(plan.name, plan.budget) for plan in comparison.plans]
            notes.append(f"{names}: not measured: {error}")
        print(f"    {time.monotonic() - begun:.0f} s", flush=True)
    return rows, notes


if __name__ == "__main__":
    # Each ends the sides and removes their files. A command started in the background inherits an ignored SIGINT.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    sys.exit(main())
