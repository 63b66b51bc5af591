"""From what was asked for to the four services' configurations. Pure: nothing is started or written here."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

from common.algorithms import ALGORITHMS
from common.algorithms.presets import presets_of, resolve_config, setting_names
from common.config import Tables, build_config, parse_override, section_names
from common.errors import ConfigError
from common.run_settings import AlgorithmSettings
from common.topics import ACTOR, LEARNER, REPLAY, ROBOT_BRIDGE, SERVICES, Lane
from deploy.computers import TwoComputers
from deploy.hosts import Host
from deploy.network import Crossing, NetworkConditions, NetworkLink
from deploy.network.conditions import direction_from
from deploy.placement import Placement
from services.actor.config import ActorConfig
from services.learner.config import LearnerConfig
from services.replay.config import ReplayConfig
from services.robot_bridge.config import RobotBridgeConfig
from services.robot_bridge.tasks import task_table

CONFIG_CLASSES: dict[str, type[Any]] = {
    ROBOT_BRIDGE: RobotBridgeConfig,
    ACTOR: ActorConfig,
    REPLAY: ReplayConfig,
    LEARNER: LearnerConfig,
}
"""Service -> its configuration class."""

PORTS = len(SERVICES) * len(Lane)
"""Ports of a run."""

NETWORK_SECTION = "network"
"""``--set network.key=value`` is not for a service but for the emulated network."""

LIMITED_SOCKET_BUFFER_KIB = 128
"""Send buffer where the network's rate is limited, or not known: what waits in a larger one is old when it arrives."""

RESEND_SHARE = 0.2
"""Share of a limited network's rate that repairs of a stream may take."""

_SET_ELSEWHERE = {
    "run.directory": "use --run-dir",
    "run.id": "use --run-id",
    "transport.listen_real_time": "endpoints follow from the placement; use --base-port",
    "transport.listen_bulk": "endpoints follow from the placement; use --base-port",
    "transport.connect_real_time": "endpoints follow from the placement; use --base-port",
    "transport.connect_bulk": "endpoints follow from the placement; use --base-port",
}
"""Settings that --set may not change, because they differ from service to service or belong to an option."""


@dataclass(frozen=True)
class RunRequest:
    """What the user asked for. None leaves a setting at its default."""

    placement: Placement
    task: str
    algorithm: str
    run_id: str
    run_dir: Path
    seed: int | None = None
    steps: int | None = None
    pacing: str | None = None
    learner_host: Host | None = None
    """The computer that the learner's computer stands for; None: itself."""
    overrides: tuple[str, ...] = ()
    """``section.key=value``, for the services; see :func:`split_overrides`."""


class PortMap:
    """Which service listens on which port: two each, one per lane."""

    def __init__(self, ports: range) -> None:
        if len(ports) != PORTS:
            raise ValueError(f"expected {PORTS} ports, got {len(ports)}")
        endpoints = [(service, lane) for service in SERVICES for lane in Lane]
        self._ports = dict(zip(endpoints, ports, strict=True))

    def port(self, service: str, lane: Lane) -> int:
        """The port that ``service`` listens on."""
        return self._ports[service, lane]


def connections() -> Iterator[tuple[str, str]]:
    """The mesh: (who connects, who listens), each pair of services once.

    Who comes later in the ring connects to who comes earlier.
    """
    for earlier, later in combinations(SERVICES, 2):
        yield later, earlier


def crossings(placement: Placement, ports: PortMap) -> list[Crossing]:
    """What the emulated network has to carry from host to host."""
    return [
        Crossing(placement.host[dialler], placement.host[listener], ports.port(listener, lane))
        for dialler, listener in connections()
        if not placement.together(dialler, listener)
        for lane in Lane
    ]


def split_overrides(overrides: Iterable[str]) -> tuple[list[str], dict[str, Any]]:
    """Separate ``network.key=value`` from what is meant for services: (the others, key -> value)."""
    others: list[str] = []
    network: dict[str, Any] = {}
    for override in overrides:
        section, key, value = parse_override(override)
        if section == NETWORK_SECTION:
            network[key] = value
        else:
            others.append(override)
    return others, network


def plan_run(
    request: RunRequest, ports: PortMap, network_link: NetworkLink, conditions: NetworkConditions | None
) -> dict[str, Any]:
    """Return service -> configuration.

    Args:
        request: what was asked for.
        ports: where the services listen.
        network_link: the network between the hosts, open.
        conditions: of that network; None if nothing crosses it.
    """
    if request.algorithm not in ALGORITHMS:
        raise ConfigError(f"--algorithm {request.algorithm}: expected one of {', '.join(ALGORITHMS)}")
    tables = {service: _tables(service, request, ports, network_link, conditions) for service in SERVICES}
    for override in request.overrides:
        _apply_override(tables, override)
    configurations = {
        service: build_config(CONFIG_CLASSES[service], tables[service], f"{service}.toml") for service in SERVICES
    }
    _check_task(configurations[ROBOT_BRIDGE])
    for service in (ACTOR, REPLAY, LEARNER):
        _check_algorithm(configurations[service].algorithm)
    _check_access(request.placement, configurations)
    _check_shared_memory(request.placement, configurations)
    return configurations


def service_command(service: str, config_path: Path, python: str = sys.executable) -> list[str]:
    """The command that starts ``service``, the same for the launcher and for a user, on the service's host."""
    return [python, "-m", f"services.{service}", "--config", str(config_path)]


def _tables(
    service: str,
    request: RunRequest,
    ports: PortMap,
    network_link: NetworkLink,
    conditions: NetworkConditions | None,
) -> Tables:
    placement = request.placement
    access = "map" if placement.together(REPLAY, LEARNER) else "arrays"
    host = request.learner_host
    algorithm = {"name": request.algorithm, **_memory_and_rate(request)}
    tables: Tables = {
        "run": _without_none({"id": request.run_id, "directory": str(request.run_dir), "seed": request.seed}),
        "transport": _transport_table(service, placement, ports, network_link, conditions),
    }
    match service:
        case "robot_bridge":
            tables["task"] = {"name": request.task}
            tables["robot_bridge"] = {
                **_without_none({"steps": request.steps, "pacing": request.pacing}),
                **_resend_pace(placement, ROBOT_BRIDGE, ACTOR, conditions),
            }
        case "actor":
            tables["algorithm"] = algorithm
            tables["actor"] = _resend_pace(placement, ACTOR, REPLAY, conditions)
            if host and placement.together(ACTOR, LEARNER):
                tables["actor"]["min_inference_s"] = host.inference_s
        case "replay":
            tables["algorithm"] = algorithm
            tables["replay"] = {"access": access}
        case "learner":
            tables["algorithm"] = algorithm
            tables["learner"] = {"access": access}
            if host:
                tables["learner"] |= {"device": host.device, "threads": host.threads}
    return tables


def _memory_and_rate(request: RunRequest) -> dict[str, Any]:
    """What the learner's computer leaves of an algorithm that replays experience."""
    host = request.learner_host
    if host is None:
        return {}
    values = {"replay_ratio": host.updates_per_step, "replay_capacity": host.replay_capacity}
    return {key: value for key, value in values.items() if key in setting_names(request.algorithm)}


def _transport_table(
    service: str,
    placement: Placement,
    ports: PortMap,
    network_link: NetworkLink,
    conditions: NetworkConditions | None,
) -> dict[str, Any]:
    here = placement.host[service]
    small = isinstance(network_link, TwoComputers) or _is_limited(conditions)
    table: dict[str, Any] = {"socket_buffer_kib": LIMITED_SOCKET_BUFFER_KIB if small else 0}
    for lane in Lane:
        table[f"listen_{lane.value}"] = _endpoint(network_link.listen_address(here), ports.port(service, lane))
        table[f"connect_{lane.value}"] = [
            _endpoint(*network_link.dial_address(here, placement.host[listener], ports.port(listener, lane)))
            for dialler, listener in connections()
            if dialler == service
        ]
    return table


def _endpoint(address: str, port: int) -> str:
    return f"tcp/{address}:{port}"


def _is_limited(conditions: NetworkConditions | None) -> bool:
    return conditions is not None and any((conditions.uplink.bytes_per_s, conditions.downlink.bytes_per_s))


def _resend_pace(
    placement: Placement, sender: str, receiver: str, conditions: NetworkConditions | None
) -> dict[str, float]:
    """How fast ``sender`` may repair its stream, where a limited network lies in between."""
    if conditions is None or placement.together(sender, receiver):
        return {}
    bytes_per_s = conditions.direction(direction_from(placement.host[sender])).bytes_per_s
    if bytes_per_s is None:
        return {}
    # The setting's least value is 1 KiB/s: at a rate that low nothing is left to share.
    return {"resend_kib_per_s": max(1.0, RESEND_SHARE * bytes_per_s / 1024)}


def _apply_override(tables: Mapping[str, Tables], override: str) -> None:
    """Write an override into the tables of every service that has the section."""
    section, key, value = parse_override(override)
    if reason := _SET_ELSEWHERE.get(f"{section}.{key}"):
        raise ConfigError(f"--set {override}: {reason}")
    having = [service for service in SERVICES if section in section_names(CONFIG_CLASSES[service])]
    if not having:
        known = {name for cls in CONFIG_CLASSES.values() for name in section_names(cls)} | {NETWORK_SECTION}
        close = difflib.get_close_matches(section, sorted(known), 1)
        hint = f"; did you mean {close[0]!r}?" if close else f"; known: {', '.join(sorted(known))}"
        raise ConfigError(f"--set {override}: no service has a section [{section}]{hint}")
    for service in having:
        tables[service].setdefault(section, {})[key] = value


def _check_task(bridge: RobotBridgeConfig) -> None:
    """Fail here rather than in a service that the others wait for."""
    known = task_table(bridge.tasks.rows)
    if bridge.task.name not in known:
        close = difflib.get_close_matches(bridge.task.name, known, 1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise ConfigError(f"--task {bridge.task.name}: expected one of {', '.join(sorted(known))}{hint}")


def _check_algorithm(algorithm: AlgorithmSettings) -> None:
    """Which preset the task asks for, the bridge will say; what fits none of them is told before anything starts."""
    errors = []
    for preset in [algorithm.preset] if algorithm.preset else presets_of(algorithm.name):
        try:
            resolve_config(algorithm.name, preset, algorithm.overrides)
        except ConfigError as error:
            errors.append(error)
        else:
            return
    raise ConfigError(f"[algorithm]: {errors[0]}")


def _check_access(placement: Placement, configurations: Mapping[str, Any]) -> None:
    replay, learner = configurations[REPLAY].replay.access, configurations[LEARNER].learner.access
    if replay != learner:
        raise ConfigError(f"replay.access = {replay!r}, learner.access = {learner!r}: expected the same")
    if replay == "map" and not placement.together(REPLAY, LEARNER):
        raise ConfigError(
            f"replay.access = 'map': replay runs on {placement.host[REPLAY]!r} and the learner on "
            f"{placement.host[LEARNER]!r}, and a file can be mapped on one host only; expected 'arrays'"
        )


def _check_shared_memory(placement: Placement, configurations: Mapping[str, Any]) -> None:
    if placement.spans_hosts and any(c.transport.shared_memory for c in configurations.values()):
        raise ConfigError(
            "transport.shared_memory = true: expected false where the services are on two hosts; the emulated hosts "
            "share their memory, and messages would not cross the network"
        )


def _without_none(values: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in values.items() if value is not None}
