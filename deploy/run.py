"""A run from its options to its exit code: configurations, network, services, progress, summary."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import tomli_w

from common.config import to_tables
from common.console import Console
from common.errors import ConfigError
from common.stop_signals import INTERRUPTED, StopSignals
from common.topics import LEARNER, ROBOT_BRIDGE
from deploy.child import LaunchedService
from deploy.computers import TwoComputers
from deploy.network import HOSTS, NetworkLink, NoLink, open_link
from deploy.options import NO_NETWORK, LaunchOptions
from deploy.placement import Placement
from deploy.plan import PORTS, PortMap, crossings, plan_run, service_command
from deploy.ports import reserved_ports
from deploy.progress import ProgressReader
from deploy.run_file import RunFile, versions
from deploy.run_record import read_record
from deploy.summary import summarise, write_curve, write_summary
from deploy.summary_text import summary_text
from deploy.watch import Drawing, EarlyEnd, watch


def service_environment(service: str) -> dict[str, str]:
    """Variables a service is started with, beside the user's own."""
    # Threads that spin while they wait would take the cores from the other services.
    environment = {"OMP_WAIT_POLICY": "PASSIVE", "PYTHONUNBUFFERED": "1"}
    if service != LEARNER:
        # For what these compute, threads cost a hundred times what they bring.
        environment |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    return environment


def launched_services(
    paths: Mapping[str, Path], placement: Placement, network_link: NetworkLink
) -> list[LaunchedService]:
    """What to start for the configurations in ``paths``, service -> file."""
    return [
        LaunchedService(
            service,
            (*network_link.command_prefix(placement.host[service]), *service_command(service, path)),
            service_environment(service),
        )
        for service, path in paths.items()
    ]


def write_configurations(options: LaunchOptions, directory: Path) -> int:
    """Write the configurations for services that a user starts by hand on this computer."""
    request = options.request
    if (request.run_dir / "parts").exists():
        raise ConfigError(f"--run-dir {request.run_dir}: holds the record of a run already; choose another")
    addresses = request.placement.addresses
    real = len(addresses) == len(HOSTS)
    with reserved_ports(PORTS, options.base_port) as ports:
        configurations = plan_run(request, PortMap(ports), TwoComputers(addresses) if real else NoLink(), None)
    paths = write_tables(directory, configurations)
    run_file(options, configurations, NoLink()).write(request.run_dir)
    for path in paths.values():
        print(f"wrote {path}")
    if request.placement.spans_hosts and not real:
        print(
            "All addresses are 127.0.0.1: without the launcher there is no emulated network. For two computers, "
            "put their addresses into [endpoints] of the mode file."
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
        with open_link(
            options.conditions,
            needs=needs,
            run_dir=run_dir,
            prefer=options.network_backend,
            seed=request.seed or 0,
        ) as network_link:
            configurations = plan_run(request, port_map, network_link, options.conditions)
            paths = write_tables(run_dir / "config", configurations)
            facts = run_file(options, configurations, network_link)
            facts.write(run_dir)
            services = launched_services(paths, request.placement, network_link)
            console.line(f"run directory: {run_dir}")
            steps_total = configurations[ROBOT_BRIDGE].robot_bridge.steps
            reader = ProgressReader(run_dir, steps_total)

            def early_end() -> EarlyEnd | None:
                if failure := network_link.failure():
                    return EarlyEnd(f"the emulated network has failed, and so the run ends: {failure}")
                over = network_link.over()
                return EarlyEnd(f"the run ends: {over}", is_failure=False) if over else None

            failures = watch(
                services, reader, run_dir, drawing, stop, console, early_end=early_end, report=console.error
            )
            ended_early = "interrupted" if stop.asked else network_link.failure() or network_link.over()
    # The network has been closed: its part of the record is final.
    if ended_early:
        _write_again(replace(facts, ended_early=ended_early), run_dir, console)
    complete = summarise_run(run_dir, drawing, stop, console)
    if stop.asked:
        return INTERRUPTED
    return 0 if complete and not failures else 1


def summarise_run(run_dir: Path, drawing: Drawing, stop: StopSignals, console: Console) -> bool:
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


def write_tables(directory: Path, configurations: Mapping[str, Any]) -> dict[str, Path]:
    """Write each service's configuration; return service -> file."""
    directory.mkdir(parents=True, exist_ok=True)
    paths = {service: directory / f"{service}.toml" for service in configurations}
    for service, path in paths.items():
        path.write_text(tomli_w.dumps(to_tables(configurations[service])), encoding="utf-8")
    return paths


def run_file(options: LaunchOptions, configurations: Mapping[str, Any], network_link: NetworkLink) -> RunFile:
    """Return the facts about a run."""
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


def _write_again(facts: RunFile, run_dir: Path, console: Console) -> None:
    try:
        facts.write(run_dir)
    except OSError as error:
        console.error(f"deploy.launch: error: {run_dir / 'run.toml'}: cannot be written: {error.strerror}")


def _shortened(path: Path) -> Path:
    """The path as a user in this folder would type it."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path
