"""A run of the study in real time: the launcher starts four services, as a user would."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from common.errors import RelodError
from deploy.child import TIED_COMMAND
from deploy.run_file import REPOSITORY
from experiments.training import Training

_TAIL_LINES = 5


class LaunchError(RelodError):
    """The launcher did not bring the run to its end."""


def launch(training: Training) -> Mapping[str, Any]:
    """Run what is to be trained through :mod:`deploy.launch`; return the run's summary.

    The launcher ends the run, in order, if this process dies.

    Raises:
        LaunchError: its exit code was not 0.
    """
    tie = (sys.executable, str(TIED_COMMAND), str(os.getpid()))
    # A file, and not a pipe: the services that the launcher starts may outlive it and would hold the pipe open.
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as console:
        # A session of its own: Ctrl-C is this process's business, and must not reach the services twice.
        finished = subprocess.run(
            [*tie, *command_line(training)],
            stdin=subprocess.DEVNULL,
            stdout=console,
            stderr=subprocess.STDOUT,
            cwd=REPOSITORY,
            start_new_session=True,
            check=False,
        )
        if finished.returncode:
            console.seek(0)
            tail = " / ".join(console.read().splitlines()[-_TAIL_LINES:])
            raise LaunchError(f"deploy.launch ended with exit code {finished.returncode}: {tail}")
    summary: Mapping[str, Any] = json.loads((training.run_dir / "summary.json").read_text(encoding="utf-8"))
    return summary


def command_line(training: Training) -> list[str]:
    """The launcher's."""
    options: dict[str, Any] = {
        "--task": training.task,
        "--algorithm": training.algorithm,
        "--steps": training.steps,
        "--seed": training.seed,
        "--network": training.network,
        "--host-budget": training.host_budget,
        "--run-dir": Path(training.run_dir).absolute(),
    }
    command = [sys.executable, "-m", "deploy.launch", str(training.mode)]
    for option, value in options.items():
        if value is not None:
            command += [option, str(value)]
    for override in training.overrides:
        command += ["--set", override]
    return command
