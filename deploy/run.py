"""A run from its options to its exit code: configurations, network, services, progress, summary."""

from __future__ import annotations

import os
import shlex
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import tomli_w

from common.config import to_tables
from common.errors import ConfigError
from common.service import DRAIN_TIMEOUT_S
from common.topics import LEARNER, ROBOT_BRIDGE, SERVICES
from deploy.child import LaunchedService
from deploy.console import Console
from deploy.curve import load_drawing
from deploy.network import NetworkLink, NoLink, open_link
from deploy.options import NO_NETWORK, LaunchOptions
from deploy.plan import PORTS, PortMap, crossings, plan_run, service_command
from deploy.ports import reserved_ports
from deploy.progress import ProgressReader, progress_line
from deploy.run_file import RunFile, versions
from deploy.stop_signals import INTERRUPTED, StopSignals
from deploy.summary import read_record, summarise, write_curve, write_summary
from deploy.summary_text import summary_text
from deploy.supervise import Supervisor

_POLL_S = 0.05
_PROGRESS_S = 1.0
_OVERTIME_S = DRAIN_TIMEOUT_S + 10.0
"""Longest time that the others may need after the bridge has ended; then the network has kept its word from them."""
_CURVE_UNTIL_S = 4.0
"""After Ctrl-C: from here on there is no time left to wait for the drawing library."""


class Drawing:
    """Loads what the learning curve is drawn with while the run is going on, so that its end is not delayed."""

    def __init__(self) -> None:
        self._thread = threading.Thread(target=self._load, name="load drawing", daemon=True)

    def start(self) -> None:
        """Begin to load; before this the launcher has one thread, and can start processes without harm."""
        self._thread.start()

    def is_loaded(self, stop: StopSignals) -> bool:
        """Wait until it is; after Ctrl-C only as long as there is time."""
        if self._thread.ident is None:  # never begun: whoever draws loads for himself
            return True
        left_s = None if stop.asked_s is None else max(0.0, stop.asked_s + _CURVE_UNTIL_S - time.monotonic())
        self._thread.join(left_s)
        return not self._thread.is_alive()

    def _load(self) -> None:
        # The run comes first.
        thread = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, thread, max(10, os.getpriority(os.PRIO_PROCESS, thread)))
        load_drawing()


def service_environment(service: str) -> dict[str, str]:
    """Variables a service is started with, beside the user's own."""
    # Threads that spin while they wait would take the cores from the other services.
    environment = {"OMP_WAIT_POLICY": "PASSIVE", "PYTHONUNBUFFERED": "1"}
    if service != LEARNER:
        # For what these compute, threads cost a hundred times what they bring.
        environment |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    return environment


def write_configurations(options: LaunchOptions, directory: Path) -> int:
    """Write the configurations for services that a user starts by hand on this computer."""
    request = options.request
    if (request.run_dir / "parts").exists():
        raise ConfigError(f"--run-dir {request.run_dir}: holds the record of a run already; choose another")
    with reserved_ports(PORTS, options.base_port) as ports:
        configurations = plan_run(request, PortMap(ports), NoLink(), None)
    paths = _write_tables(directory, configurations)
    _run_file(options, configurations, NoLink()).write(request.run_dir)
    for path in paths.values():
        print(f"wrote {path}")
    if request.placement.spans_hosts:
        print(
            "All addresses are 127.0.0.1: without the launcher there is no emulated network. For two computers, "
            "put their addresses in the files."
        )
    print(f"The run's record will be in {request.run_dir}")
    print("Start each service in a terminal of its own, in any order:")
    for service, path in paths.items():
        print(f"  {shlex.join(service_command(service, _shortened(path), str(_shortened(Path(sys.executable)))))}")
    return 0


def launch(options: LaunchOptions, stop: StopSignals, console: Console) -> int:
    """Start the services, watch them until the run is over, summarise; return the exit code."""
    request = options.request
    run_dir = request.run_dir
    if run_dir.exists() and (not run_dir.is_dir() or any(run_dir.iterdir())):
        raise ConfigError(f"--run-dir {run_dir}: expected a folder that is empty or not there yet")
    if stop.asked:  # while this program was still being loaded: there is nothing to stop, and no record
        return INTERRUPTED
    drawing = Drawing()
    with reserved_ports(PORTS, options.base_port) as ports:
        port_map = PortMap(ports)
        # Once without the network: a wrong setting is told before anything is opened or written.
        plan_run(request, port_map, NoLink(), options.conditions)
        run_dir.mkdir(parents=True, exist_ok=True)
        needs = crossings(request.placement, port_map)
        with open_link(options.conditions, needs=needs, run_dir=run_dir, seed=request.seed or 0) as network_link:
            configurations = plan_run(request, port_map, network_link, options.conditions)
            paths = _write_tables(run_dir / "config", configurations)
            _run_file(options, configurations, network_link).write(run_dir)
            services = [
                LaunchedService(
                    service,
                    (*network_link.command_prefix(request.placement.host[service]), *service_command(service, path)),
                    service_environment(service),
                )
                for service, path in paths.items()
            ]
            console.line(f"run directory: {run_dir}")
            steps_total = configurations[ROBOT_BRIDGE].robot_bridge.steps
            reader = ProgressReader(run_dir, steps_total)
            succeeded = _watch(services, reader, run_dir, network_link, drawing, stop, console)
    # The network has been closed: its part of the record is final.
    complete = _summarise(run_dir, drawing, stop, console)
    if stop.asked:
        return INTERRUPTED
    return 0 if succeeded and complete else 1


def _watch(
    services: Sequence[LaunchedService],
    reader: ProgressReader,
    run_dir: Path,
    network_link: NetworkLink,
    drawing: Drawing,
    stop: StopSignals,
    console: Console,
) -> bool:
    """Run the services to their end; True if all has gone well."""
    supervisor = Supervisor(services, run_dir, console.error, run_has_begun=lambda: reader.read().steps > 0)
    network_failure: str | None = None
    try:
        supervisor.start(lambda: stop.asked)
        drawing.start()
        next_progress_s = time.monotonic()
        while supervisor.running and not stop.asked and not supervisor.cannot_start:
            supervisor.check()
            if network_failure is None and (network_failure := network_link.failure()):
                console.error(f"the emulated network has failed, and so the run ends: {network_failure}")
                break
            if time.monotonic() >= next_progress_s:
                next_progress_s = time.monotonic() + _PROGRESS_S
                console.status(progress_line(reader.read()))
            if supervisor.overdue(_OVERTIME_S):
                console.error(f"the bridge ended {_OVERTIME_S:.0f} s ago, and some have not heard of it")
                break
            time.sleep(_POLL_S)
        if not stop.asked:
            supervisor.check()
    finally:
        # Also when this program has an error: nothing may be left running.
        if supervisor.running:
            asked_s = stop.asked_s if stop.asked_s is not None else time.monotonic()
            console.line("stopping the services")
            supervisor.stop(asked_s)
    console.line(progress_line(reader.read()))
    if not stop.asked and supervisor.failed:
        console.error(f"not well at the end: {', '.join(supervisor.failed)}")
    return not supervisor.failed and network_failure is None


def _summarise(run_dir: Path, drawing: Drawing, stop: StopSignals, console: Console) -> bool:
    """Write and show the summary; True if the record is complete."""
    try:
        summary = summarise(read_record(run_dir))
        for warning in summary.warnings:
            console.error(f"deploy.launch: warning: {warning}")
        console.line(summary_text(summary.values))
        paths = [write_summary(run_dir, summary)]
        if drawing.is_loaded(stop):
            paths.append(write_curve(run_dir, summary))
        else:
            console.error(f"no time to draw the learning curve; python -m deploy.summary {run_dir} does")
    except OSError as error:
        console.error(f"deploy.launch: error: {run_dir}: the summary cannot be written: {error.strerror}")
        return False
    for path in paths:
        console.line(str(_shortened(path)))
    return True


def _write_tables(directory: Path, configurations: Mapping[str, Any]) -> dict[str, Path]:
    directory.mkdir(parents=True, exist_ok=True)
    paths = {service: directory / f"{service}.toml" for service in SERVICES}
    for service, path in paths.items():
        path.write_text(tomli_w.dumps(to_tables(configurations[service])), encoding="utf-8")
    return paths


def _run_file(options: LaunchOptions, configurations: Mapping[str, Any], network_link: NetworkLink) -> RunFile:
    bridge = configurations[ROBOT_BRIDGE]
    part = network_link.part()
    return RunFile(
        id=bridge.run.id,
        mode=options.request.placement.mode,
        task=bridge.task.name,
        algorithm=configurations[LEARNER].algorithm.name,
        seed=bridge.run.seed,
        steps=bridge.robot_bridge.steps,
        pacing=bridge.robot_bridge.pacing,
        network=options.network,
        backend=part.kind if part else NO_NETWORK,
        placement=dict(options.request.placement.host),
        conditions=options.conditions.to_table() if options.conditions and part else {},
        versions=versions(),
        host_budget=options.request.learner_host.name if options.request.learner_host else "",
    )


def _shortened(path: Path) -> Path:
    """The path as a user in this folder would type it."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path
