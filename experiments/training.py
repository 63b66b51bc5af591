"""What to train in one process, turned into the four services' configurations and the description of the run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import tomli_w

from common.config import to_tables
from common.errors import ConfigError
from common.record import write_atomically
from common.topics import LEARNER, ROBOT_BRIDGE
from deploy.hosts import Host, load_host
from deploy.network import NetworkConditions, NoLink
from deploy.options import NO_NETWORK, choose_network, make_run_id
from deploy.placement import Placement, load_placement
from deploy.plan import PORTS, PortMap, RunRequest, plan_run, split_overrides
from deploy.run_file import IN_PROCESS, RunFile, versions
from experiments.in_process import InProcessRun, LockstepRun
from experiments.virtual_costs import with_computing_times
from experiments.virtual_network import BACKEND
from experiments.virtual_time import VirtualRun

VIRTUAL = "virtual"
"""Pacing of a run in virtual time, in its record."""
_NO_PORTS = PortMap(range(1, PORTS + 1))
"""The configurations want endpoints; nobody listens on them."""
_ALONE = ("learner.nice=0",)
"""There is nobody here that a learner could keep from running."""
_REAL_CAMERA = "opencv"
_NOBODY_WAITS = ("robot_bridge.real_time_priority=false", "actor.real_time_priority=false")
"""In virtual time it does not matter when this process gets its processor."""


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
    mode: str | None = None
    """Mode or placement file, in virtual time; None: in lockstep."""
    network: str | None = None
    """Network between the mode's hosts, as for ``deploy.launch``."""


@dataclass(frozen=True)
class PlannedTraining:
    """A training that can be begun."""

    configurations: dict[str, Any]
    """Service -> configuration."""
    placement: Placement
    network: str
    """Name of the network's conditions."""
    conditions: NetworkConditions | None
    """None: nothing crosses a network."""
    learner_host: Host | None
    """The computer that the learner's stands for; None: this one."""
    virtual: bool
    """In virtual time rather than in lockstep."""

    def with_computing_times(self) -> PlannedTraining:
        """Return the plan with how long actions and updates take, in virtual time; may measure it."""
        if not self.virtual:
            return self
        return replace(self, configurations=with_computing_times(self.configurations, self.learner_host))

    def begin(self) -> InProcessRun:
        """Make the run; its thread is the caller's."""
        if self.virtual:
            return VirtualRun(self.configurations, self.placement, self.conditions)
        return LockstepRun(self.configurations)

    def write(self, run_dir: Path) -> RunFile:
        """Write the configurations and ``run.toml``; return what stands in the latter."""
        bridge = self.configurations[ROBOT_BRIDGE]
        for service, configuration in self.configurations.items():
            write_atomically(run_dir / "config" / f"{service}.toml", tomli_w.dumps(to_tables(configuration)))
        facts = RunFile(
            id=bridge.run.id,
            mode=self.placement.mode if self.virtual else IN_PROCESS,
            task=bridge.task.name,
            algorithm=self.configurations[LEARNER].algorithm.name,
            seed=bridge.run.seed,
            steps=bridge.robot_bridge.steps,
            pacing=VIRTUAL if self.virtual else bridge.robot_bridge.pacing,
            network=self.network,
            backend=BACKEND if self.conditions else NO_NETWORK,
            placement=dict(self.placement.host),
            conditions=self.conditions.to_table() if self.conditions else {},
            versions=versions(),
            host_budget=self.learner_host.name if self.learner_host else "",
        )
        facts.write(run_dir)
        return facts


def plan_training(training: Training) -> PlannedTraining:
    """Return how to do it.

    Raises:
        ConfigError: an option or setting is not what it can be.
    """
    virtual = training.mode is not None
    placement = load_placement(training.mode or "local_only")
    overrides, network, conditions = _network(training, placement)
    host = load_host(training.host_budget) if training.host_budget else None
    pacing = "realtime" if virtual else "lockstep"
    request = RunRequest(
        placement=placement,
        task=training.task,
        algorithm=training.algorithm,
        run_id=make_run_id(datetime.now()),
        run_dir=training.run_dir.absolute(),
        seed=training.seed,
        steps=training.steps,
        pacing=pacing,
        learner_host=host,
        overrides=(*_ALONE, *overrides, *(_NOBODY_WAITS if virtual else ())),
    )
    configurations = plan_run(request, _NO_PORTS, NoLink(), conditions)
    _check_pacing(configurations[ROBOT_BRIDGE].robot_bridge.pacing, pacing)
    _check_camera(configurations[ROBOT_BRIDGE].camera.name)
    return PlannedTraining(configurations, placement, network, conditions, host, virtual)


def _network(training: Training, placement: Placement) -> tuple[list[str], str, NetworkConditions | None]:
    """Return the overrides for services, and the network's name and conditions."""
    if training.mode is None:
        if training.network is not None:
            raise ConfigError(
                f"--network {training.network}: without --mode the run is in lockstep, and nothing crosses a network; "
                "add --mode, e.g. --mode remote_only"
            )
        return list(training.overrides), NO_NETWORK, None
    for_services, for_network = split_overrides(training.overrides)
    network, conditions = choose_network(placement, training.network, for_network)
    if conditions and conditions.congestion_control:
        raise ConfigError(
            f"network.congestion_control = {conditions.congestion_control!r}: expected ''; virtual time has a TCP of "
            "its own (docs/virtual-time.md), and only hosts in namespaces have the kernel's"
        )
    return for_services, network, conditions


def _check_pacing(pacing: str, expected: str) -> None:
    if pacing != expected:
        raise ConfigError(
            f"--set robot_bridge.pacing={pacing}: expected {expected!r}; a run is in lockstep without --mode, and in "
            "virtual time with it; for real time there is deploy.launch"
        )


def _check_camera(name: str) -> None:
    if name == _REAL_CAMERA:
        raise ConfigError(
            f"--set camera.name={name}: its pictures are taken in real time, and time is simulated here; run it with "
            "deploy.launch, or show a recording: camera.name=recorded"
        )
