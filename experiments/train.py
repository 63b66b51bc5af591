"""``python -m experiments.train --task T``: learning in one process, as fast as it computes, the same every time.

The bridge, actor, replay and learner of a real run, in lockstep, without a network and in simulated time
(:mod:`experiments.simulation`): on one machine, the same options give the same run. Its record is that of
``deploy.launch``, with the mode ``in_process``.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import tomli_w

from common import topics
from common.algorithms import ALGORITHMS
from common.codec import decode
from common.config import to_tables
from common.errors import ConfigError, RelodError, ServiceError
from common.messages import TaskSpec
from common.record import write_atomically
from common.service import Service
from common.topics import LEARNER, ROBOT_BRIDGE, SERVICES
from deploy.console import Console
from deploy.hosts import load_host
from deploy.network import NoLink
from deploy.options import HOST_BUDGET_HELP, NO_NETWORK, default_run_name, make_run_id
from deploy.placement import load_placement
from deploy.plan import PORTS, PortMap, RunRequest, plan_run
from deploy.progress import ProgressReader, progress_line
from deploy.run_file import IN_PROCESS, RunFile, versions
from deploy.stop_signals import INTERRUPTED, StopSignals
from deploy.summary import read_record, summarise, write_curve, write_summary
from deploy.summary_text import summary_text
from experiments.command_line import exit_code
from experiments.loading import load_libraries
from experiments.simulation import SimulatedClock, SimulatedNetwork

logger = logging.getLogger(__name__)

_PROGRESS_S = 1.0
_LOOK_S = 1.0
"""Simulated time between two looks at what is going on."""
_NO_PORTS = PortMap(range(1, PORTS + 1))
"""The configurations want endpoints; nobody listens on them."""


@dataclass(frozen=True)
class Training:
    """What to train."""

    task: str
    run_dir: Path
    algorithm: str = "sac"
    seed: int = 0
    steps: int | None = None
    """Action cycles, resets included; None: the bridge's default."""
    overrides: tuple[str, ...] = ()
    """``section.key=value``, as for ``deploy.launch``."""
    host_budget: str | None = None
    """Name or file of the computer that the learner's stands for; None: this one."""


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
    configurations = _configurations(training)
    if stop:
        load_libraries(configurations[LEARNER].algorithm.name, stop)
    _write_configurations(training, configurations)
    steps = configurations[ROBOT_BRIDGE].robot_bridge.steps
    reader = ProgressReader(run_dir, steps)
    next_progress_s = 0.0

    def look(simulation: _Simulation) -> None:
        nonlocal next_progress_s
        if console and time.monotonic() >= next_progress_s:
            next_progress_s = time.monotonic() + _PROGRESS_S
            console.status(progress_line(reader.read()))
        if stop and stop.asked:
            simulation.stop("interrupted")

    log = run_dir / "logs" / "train.log"
    try:
        with _log_to(log):
            _Simulation(configurations).run(look)
    except ConfigError:
        if is_new:  # Nothing has begun: the corrected command may use the same folder.
            shutil.rmtree(run_dir, ignore_errors=True)
        raise
    except RelodError as error:
        raise ServiceError(f"{error}; see {log}. python -m deploy.summary {run_dir} shows what there is") from error
    summary = summarise(read_record(run_dir))
    paths = [write_summary(run_dir, summary), write_curve(run_dir, summary)]
    if console:
        for warning in summary.warnings:
            console.error(f"experiments.train: warning: {warning}")
        console.line(summary_text(summary.values))
        for path in paths:
            console.line(str(path))
    return summary.values


class _Simulation:
    """The four services of one run, each in a simulated thread."""

    def __init__(self, configurations: Mapping[str, Any]) -> None:
        self._configurations = configurations
        self._clock = SimulatedClock()
        self._network = SimulatedNetwork(self._clock)
        self._failures: dict[str, Exception] = {}
        self._services = {name: self._service(name, number) for number, name in enumerate(SERVICES, 1)}

    def run(self, look: Callable[[_Simulation], None]) -> None:
        """Run to the end; ``look`` is called once in a while.

        Raises:
            RelodError: a service has failed; the others have been stopped.
        """
        try:
            threads = [self._clock.thread(lambda name=name: self._serve(name), name) for name in SERVICES]  # type: ignore[misc]
            threads[0].start()
            self._set_pace()
            for thread in threads[1:]:
                thread.start()
            while any(thread.is_alive() for thread in threads):
                look(self)
                self._wait()
                if self._failures:
                    self.stop("another service has failed")
        finally:
            self._clock.end()
        for name, failure in self._failures.items():
            if isinstance(failure, RelodError):
                raise failure
            raise ServiceError(f"{name}: unexpected {type(failure).__name__}: {failure}") from failure

    def stop(self, reason: str) -> None:
        """Let the run end early."""
        for service in self._services.values():
            if service.name == ROBOT_BRIDGE or self._failures:
                service.stop(reason)

    def _service(self, name: str, number: int) -> Service:
        run = self._configurations[name].run
        # Random numbers depend on the incarnation, so that a restart does not repeat them: here it has to be known.
        service = Service(name, run, self._network.transport(run), self._clock, incarnation=number)
        begun_s = time.monotonic()
        service.wall_s = lambda: time.monotonic() - begun_s
        return service

    def _serve(self, name: str) -> None:
        service = self._services[name]
        try:
            service.start()
            _serve_function(name)(service, self._configurations[name])
        except Exception as error:
            service.failure = f"{type(error).__name__}: {error}"
            self._failures[name] = error
            logger.exception("%s has failed", name)
        finally:
            service.close()

    def _set_pace(self) -> None:
        """An answer takes one action cycle of simulated time, so that heartbeat and record go by the robot's time."""
        client = self._network.transport(self._configurations[ROBOT_BRIDGE].run)
        while not self._failures:
            if payload := client.query(topics.SPEC):
                spec = decode(payload, TaskSpec)
                self._network.delays_ns[topics.ACTION.name] = round(spec.action_cycle_time_s * 1e9)
                return
            self._wait(0.01)

    def _wait(self, seconds: float = _LOOK_S) -> None:
        condition = self._clock.condition()
        with condition:
            self._clock.wait(condition, seconds)


def _serve_function(name: str) -> Callable[[Service, Any], None]:
    """What ``python -m services.NAME`` runs."""
    match name:
        case "robot_bridge":
            from services.robot_bridge.__main__ import serve
        case "actor":
            from services.actor.__main__ import serve
        case "replay":
            from services.replay.__main__ import serve
        case _:
            from services.learner.__main__ import serve
    return serve


def _configurations(training: Training) -> dict[str, Any]:
    request = RunRequest(
        placement=load_placement("local_only"),
        task=training.task,
        algorithm=training.algorithm,
        run_id=make_run_id(datetime.now()),
        run_dir=training.run_dir.absolute(),
        seed=training.seed,
        steps=training.steps,
        pacing="lockstep",
        learner_host=load_host(training.host_budget) if training.host_budget else None,
        # There is nobody here that a learner could keep from running.
        overrides=("learner.nice=0", *training.overrides),
    )
    configurations = plan_run(request, _NO_PORTS, NoLink(), None)
    if configurations[ROBOT_BRIDGE].robot_bridge.pacing != "lockstep":
        raise ConfigError("--set robot_bridge.pacing: expected 'lockstep'; for real time there is deploy.launch")
    return configurations


def _write_configurations(training: Training, configurations: Mapping[str, Any]) -> None:
    bridge = configurations[ROBOT_BRIDGE]
    for service, configuration in configurations.items():
        write_atomically(training.run_dir / "config" / f"{service}.toml", tomli_w.dumps(to_tables(configuration)))
    RunFile(
        id=bridge.run.id,
        mode=IN_PROCESS,
        task=bridge.task.name,
        algorithm=configurations[LEARNER].algorithm.name,
        seed=bridge.run.seed,
        steps=bridge.robot_bridge.steps,
        pacing=bridge.robot_bridge.pacing,
        network=NO_NETWORK,
        backend=NO_NETWORK,
        placement=dict.fromkeys(SERVICES, "local"),
        versions=versions(),
        host_budget=load_host(training.host_budget).name if training.host_budget else "",
    ).write(training.run_dir)


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
        description="Train in one process, in lockstep, without a network; the same options give the same run.",
    )
    parser.add_argument("--task", required=True, help="task id")
    parser.add_argument("--algorithm", default="sac", help=f"one of {', '.join(ALGORITHMS)} (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of everything random (default: 0)")
    parser.add_argument("--steps", type=int, metavar="N", help="action cycles of the run, resets included")
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
    run_dir = options.run_dir or Path("runs") / default_run_name(IN_PROCESS, options.task, options.seed, datetime.now())
    return Training(
        options.task,
        run_dir,
        options.algorithm,
        options.seed,
        options.steps,
        tuple(options.set),
        options.host_budget,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Train from the command line; return the exit code."""
    training = _parse(arguments)
    console = Console()

    def run() -> int:
        with StopSignals() as stop:
            console.line(f"run directory: {training.run_dir}")
            train(training, console, stop)
        return INTERRUPTED if stop.asked else 0

    return exit_code("experiments.train", "--run-dir", training.run_dir, console, run)


if __name__ == "__main__":
    sys.exit(main())
