"""``python -m experiments.train --task T``: learning in one process, as fast as it computes, the same every time.

The bridge, actor, replay and learner of a real run in simulated time (:mod:`experiments.simulation`): on one machine,
the same options give the same run. Its record is that of ``deploy.launch``.

Without ``--mode`` the world waits for each action and its updates: lockstep, without a network, and the record's mode
is ``in_process``. With it the run is one of that mode in virtual time (:mod:`experiments.virtual_time`): the world goes
on at its own pace whatever anyone computes, and computing and the network take as long as they would.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

from common.algorithms import ALGORITHMS
from common.console import Console
from common.errors import ConfigError, RelodError, ServiceError
from common.stop_signals import INTERRUPTED, StopSignals
from common.topics import LEARNER, ROBOT_BRIDGE
from deploy.network import PRESETS
from deploy.options import HOST_BUDGET_HELP, default_run_name
from deploy.placement import mode_names
from deploy.progress import ProgressReader, progress_line
from deploy.run_file import IN_PROCESS
from deploy.summary import read_record, summarise, write_curve, write_summary
from deploy.summary_text import summary_text
from experiments.command_line import exit_code
from experiments.in_process import InProcessRun
from experiments.loading import load_libraries
from experiments.training import Training, plan_training

logger = logging.getLogger(__name__)

_PROGRESS_S = 1.0


def train(training: Training, console: Console | None = None, stop: StopSignals | None = None) -> dict[str, Any]:
    """Train, write the record, return the summary's values.

    Args:
        training: what to train; its folder must be empty or not there yet.
        console: where progress and the summary are shown; None: nowhere.
        stop: ends the run early, with a complete record. For the main thread.

    Raises:
        KeyboardInterrupt: stopped before anything was begun or written.
        ConfigError: an option or setting is not what it can be.
        ServiceError: one of the services failed.
    """
    run_dir = training.run_dir
    if run_dir.exists() and (not run_dir.is_dir() or any(run_dir.iterdir())):
        raise ConfigError(f"--run-dir {run_dir}: expected a folder that is empty or not there yet")
    is_new = not run_dir.exists()
    plan = plan_training(training)
    if console:
        console.line(f"run directory: {run_dir}")
    if stop:
        load_libraries(plan.configurations[LEARNER].algorithm.name, stop)
    plan = plan.with_computing_times()
    facts = plan.write(run_dir)
    steps = plan.configurations[ROBOT_BRIDGE].robot_bridge.steps
    reader = ProgressReader(run_dir, steps)
    next_progress_s = 0.0

    def look(run: InProcessRun) -> None:
        nonlocal next_progress_s
        if console and time.monotonic() >= next_progress_s:
            next_progress_s = time.monotonic() + _PROGRESS_S
            console.status(progress_line(reader.read()))
        if stop and stop.asked:
            run.stop("interrupted")

    def hurried() -> bool:
        return stop is not None and stop.asked_again

    log = run_dir / "logs" / "train.log"
    begun: InProcessRun | None = None
    try:
        with _log_to(log):
            begun = plan.begin()
            try:
                begun.run(look, hurried)
            finally:
                if begun.told_to_stop:
                    replace(facts, ended_early=begun.told_to_stop).write(run_dir)
    except RelodError as error:
        if begun is None or isinstance(error, ConfigError):
            if is_new:  # Nothing has begun: the corrected command may use the same folder.
                shutil.rmtree(run_dir, ignore_errors=True)
            raise
        raise ServiceError(f"{error}; see {log}. python -m deploy.summary {run_dir} shows what there is") from error
    summary = summarise(read_record(run_dir))
    paths = [write_summary(run_dir, summary)]
    if not hurried():
        paths.append(write_curve(run_dir, summary))
    if console:
        if begun.told_to_stop and summary.values["steps"] < steps:
            console.error(f"experiments.train: the run has ended early: {begun.told_to_stop}")
        if begun.cut_off:
            console.error(f"experiments.train: the services were cut off: {begun.cut_off}")
        if len(paths) < 2:
            console.error(f"no time to draw the learning curve; python -m deploy.summary {run_dir} does")
        for warning in summary.warnings:
            console.error(f"experiments.train: warning: {warning}")
        console.line(summary_text(summary.values))
        for path in paths:
            console.line(str(path))
    return summary.values


@contextlib.contextmanager
def _log_to(path: Path) -> Iterator[None]:
    path.parent.mkdir(parents=True)
    file = logging.FileHandler(path, encoding="utf-8")
    file.setFormatter(logging.Formatter("%(asctime)s %(name)s %(levelname)s %(message)s"))
    root = logging.getLogger()
    level = root.level
    root.addHandler(file)
    root.setLevel(logging.INFO)
    try:
        yield
    finally:
        root.removeHandler(file)
        root.setLevel(level)
        file.close()


def _parse(arguments: Sequence[str] | None) -> Training:
    parser = argparse.ArgumentParser(
        prog="python -m experiments.train",
        description="Train in one process and simulated time; the same options give the same run. Without --mode in "
        "lockstep: the world waits for actions and updates.",
    )
    parser.add_argument("--task", required=True, help="task id")
    parser.add_argument("--algorithm", default="sac", help=f"one of {', '.join(ALGORITHMS)} (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of everything random (default: 0)")
    parser.add_argument("--steps", type=int, metavar="N", help="action cycles of the run, resets included")
    parser.add_argument(
        "--mode",
        metavar="MODE",
        help=f"in virtual time, as on two hosts: {', '.join(mode_names())}, or a placement file",
    )
    parser.add_argument(
        "--network",
        metavar="PRESET|FILE",
        help=f"with --mode, network between the hosts: {', '.join(PRESETS)}, or a TOML file with a table [network]",
    )
    parser.add_argument("--host-budget", metavar="HOST|FILE", help=HOST_BUDGET_HELP)
    parser.add_argument("--run-dir", type=Path, metavar="DIR", help="folder of the run's record (default: in runs/)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="override a setting, as for deploy.launch; may be given several times",
    )
    options = parser.parse_args(arguments)
    name = Path(options.mode).stem if options.mode else IN_PROCESS
    run_dir = options.run_dir or Path("runs") / default_run_name(name, options.task, options.seed, datetime.now())
    return Training(
        task=options.task,
        run_dir=run_dir,
        algorithm=options.algorithm,
        seed=options.seed,
        steps=options.steps,
        overrides=tuple(options.set),
        host_budget=options.host_budget,
        mode=options.mode,
        network=options.network,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Train from the command line; return the exit code."""
    training = _parse(arguments)
    console = Console()

    def run() -> int:
        with StopSignals() as stop:
            train(training, console, stop)
        return INTERRUPTED if stop.asked else 0

    return exit_code("experiments.train", "--run-dir", training.run_dir, console, run)


if __name__ == "__main__":
    sys.exit(main())
