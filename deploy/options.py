"""The launcher's command line, turned into a checked request."""

from __future__ import annotations

import argparse
import math
import re
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from common.algorithms import ALGORITHMS
from common.config import read_toml
from common.errors import ConfigError
from common.topics import ROBOT_BRIDGE
from deploy.computers import check_is_ours, check_pair, checked_address
from deploy.hosts import host_names, load_host
from deploy.network import (
    HOSTS,
    LINK_PREFERENCES,
    PRESETS,
    Host,
    LinkPreference,
    NetworkConditions,
    load_network,
    parse_network,
)
from deploy.network.conditions import DIRECTIONS
from deploy.placement import Placement, load_placement, mode_names
from deploy.plan import RunRequest, split_overrides

NO_NETWORK = "none"
"""Name of the network of a run on one host."""
REAL_NETWORK = "real"
"""Name of the network of a run on two computers."""

HOST_BUDGET_HELP = f"what the learner's computer can do: {', '.join(host_names())}, or a TOML file with a table [host]"
"""Of the option that ``experiments.train`` has too."""

_DESCRIPTION = """\
Start the four services of a run, watch them, and summarise what came of it.

Ctrl-C ends the run early; its record is complete then, too.
"""
_EPILOG = """\
examples:
  python -m deploy.launch local_only --task visual_dot_reacher
  python -m deploy.launch remote_local --task dot_reacher --network wifi_office --steps 5000
  python -m deploy.launch local_only --task dot_reacher --host-budget jetson
  python -m deploy.launch local_only --task dot_reacher --set task.preset=thesis --set algorithm.batch_size=32
"""


@dataclass(frozen=True)
class Side:
    """This computer's part in a run on two computers."""

    host: Host
    """Which of the two this computer is."""
    addresses: Mapping[Host, str]
    """Host -> the IPv4 address that its services listen on."""
    run_id: str | None
    """None: the one that ``local`` makes."""
    wait_s: float
    """Longest time to wait for the other computer's launcher, seconds."""


@dataclass(frozen=True)
class LaunchOptions:
    """What the command line asks for, checked as far as it can be without starting anything."""

    request: RunRequest
    network: str
    """Name of the network's conditions."""
    conditions: NetworkConditions | None
    """None: nothing crosses a network."""
    base_port: int | None
    write_config: Path | None
    """Only write the configurations to this folder."""
    side: Side | None = None
    """None: all services run on this computer."""
    network_backend: LinkPreference = "auto"
    """How the network is emulated."""


def parse_options(arguments: Sequence[str] | None = None) -> LaunchOptions:
    """Read the command line; usage errors end the program with exit code 2.

    Raises:
        ConfigError: the options are well-formed, but not what the run can be started with.
    """
    options = _parser().parse_args(arguments)
    placement = load_placement(options.mode)
    for_services, for_network = split_overrides(options.set)
    side = _side(options, placement) if options.host else None
    if options.endpoint and side is None:
        raise ConfigError(f"--endpoint {options.endpoint[0]}: expected together with --host, which this computer is")
    if side is None:
        network, conditions = choose_network(placement, options.network, for_network)
    elif options.network or for_network:
        raise ConfigError("--network: with --host nothing is emulated, the network is the one between the computers")
    else:
        network, conditions = REAL_NETWORK, None
    mode = f"{placement.mode}-{side.host}" if side else placement.mode
    run_dir = options.run_dir or Path("runs") / default_run_name(mode, options.task, options.seed or 0, datetime.now())
    request = RunRequest(
        placement=placement,
        task=options.task,
        algorithm=options.algorithm,
        run_id=options.run_id or make_run_id(datetime.now()),
        # Absolute: a service that is started again by hand may be started from elsewhere.
        run_dir=run_dir.absolute(),
        seed=options.seed,
        steps=options.steps,
        pacing=options.pacing,
        learner_host=load_host(options.host_budget) if options.host_budget else None,
        overrides=tuple(for_services),
    )
    write_config = options.write_config.absolute() if options.write_config else None
    return LaunchOptions(
        request, network, conditions, options.base_port, write_config, side, network_backend=options.network_backend
    )


def _side(options: argparse.Namespace, placement: Placement) -> Side:
    host: Host = options.host
    if not placement.services_on(host):
        raise ConfigError(f"--host {host}: in {placement.mode} all services are on {placement.host[ROBOT_BRIDGE]!r}")
    if not placement.spans_hosts:
        raise ConfigError(f"--host {host}: in {placement.mode} all services are on one computer; leave --host out")
    if options.write_config:
        raise ConfigError("--write-config: expected without --host, for the files name all services")
    addresses = {**placement.addresses, **_endpoints(options.endpoint)}
    check_pair(addresses)
    check_is_ours(host, addresses[host])
    run_id = options.run_id or (make_run_id(datetime.now()) if host == HOSTS[0] else None)
    return Side(host, addresses, run_id, options.wait)


def _endpoints(texts: Sequence[str]) -> dict[Host, str]:
    """The addresses in ``HOST=ADDRESS``, one for a host."""
    addresses: dict[Any, str] = {}
    for endpoint in texts:
        name, equals, address = endpoint.partition("=")
        if not equals:
            raise ConfigError(f"--endpoint {endpoint}: expected HOST=ADDRESS, for example local=192.168.1.10")
        if name in addresses:
            raise ConfigError(f"--endpoint {endpoint}: expected once for each host, got {name}={addresses[name]} too")
        addresses[name] = checked_address(name, address, f"--endpoint {endpoint}")
    return addresses


def choose_network(
    placement: Placement, name_or_path: str | None, overrides: Mapping[str, Any]
) -> tuple[str, NetworkConditions | None]:
    """Return the name and the conditions of the network that the run's data crosses.

    Raises:
        ConfigError: unknown network or key, or a network that nothing would cross.
    """
    conditions = load_network(name_or_path or "ideal")
    name = name_or_path if name_or_path in PRESETS else Path(name_or_path or "ideal").stem
    if overrides:
        # A trace's path starts from the file, like in the file; without one, from where the user is.
        directory = Path() if name_or_path is None or name_or_path in PRESETS else Path(name_or_path).parent
        conditions = parse_network(_overridden(name_or_path or "ideal", overrides), directory=directory)
        name = f"{name}, changed"
    if placement.spans_hosts:
        return name, conditions
    if conditions != PRESETS["ideal"]:
        raise ConfigError(
            f"--network {name}: in {placement.mode} all services are on one host, so nothing crosses a network; "
            "leave it out, or choose a mode with two hosts"
        )
    return NO_NETWORK, None


def default_run_name(mode: str, task: str, seed: int, now: datetime) -> str:
    """Name of a run's folder, sorted by time."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", f"{now:%Y%m%d-%H%M%S}-{mode}-{task}-{seed}")


def make_run_id(now: datetime) -> str:
    """A name that no other run on the same network has."""
    return f"{now:%Y%m%d%H%M%S}{secrets.token_hex(3)}"


def _overridden(name_or_path: str, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """The ``[network]`` table with ``key`` (both directions) and ``uplink.key``, ``downlink.key`` replaced."""
    table: dict[str, Any] = {"preset": name_or_path}
    if name_or_path not in PRESETS:
        table = dict(read_toml(Path(name_or_path))["network"])
    one_way = {direction: dict(table.pop(direction, {})) for direction in DIRECTIONS}
    for key, value in overrides.items():
        direction, dot, direction_key = key.partition(".")
        if dot and direction in one_way:
            one_way[direction][direction_key] = value
        else:
            # What was said of one direction gives way to what the command line says of both.
            for values in one_way.values():
                values.pop(key, None)
            table[key] = value
    return {**table, **{direction: values for direction, values in one_way.items() if values}}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m deploy.launch",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("mode", metavar="MODE", help=f"{', '.join(mode_names())}, or a placement file")
    parser.add_argument("--task", required=True, help="task id")
    parser.add_argument("--algorithm", default="sac", help=f"one of {', '.join(ALGORITHMS)} (default: %(default)s)")
    parser.add_argument("--steps", type=int, metavar="N", help="action cycles of the run, resets included")
    parser.add_argument("--seed", type=int, metavar="N", help="seed of everything random (default: 0)")
    parser.add_argument("--pacing", choices=("realtime", "lockstep"), help="what an action cycle waits for")
    parser.add_argument(
        "--network",
        metavar="PRESET|FILE",
        help=f"emulated network between the hosts: {', '.join(PRESETS)}, or a TOML file with a table [network]",
    )
    parser.add_argument("--host-budget", metavar="HOST|FILE", help=HOST_BUDGET_HELP)
    parser.add_argument(
        "--network-backend",
        choices=LINK_PREFERENCES,
        default="auto",
        help="how the network is emulated (default: %(default)s, namespaces where they can be made, else the relay)",
    )
    parser.add_argument("--run-dir", type=Path, metavar="DIR", help="folder of the run's record (default: in runs/)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="override a setting of every service that has it, or of the network; may be given several times",
    )
    parser.add_argument(
        "--write-config",
        type=Path,
        metavar="DIR",
        help="only write a configuration for each service to DIR, and print the four commands",
    )
    parser.add_argument(
        "--base-port",
        type=int,
        metavar="N",
        help="first of the run's TCP ports: 8 of its services, with --host 4 more of the two launchers",
    )
    parser.add_argument("--run-id", metavar="ID", help="name of the run in its messages (default: date and chance)")
    computers = parser.add_argument_group(
        "two computers", "the same command on both, but for --host and --run-dir; see docs/two-computers.md"
    )
    computers.add_argument("--host", choices=HOSTS, help="start only the services of this host, which this computer is")
    computers.add_argument(
        "--endpoint",
        action="append",
        default=[],
        metavar="HOST=ADDRESS",
        help="IPv4 address of local or remote, where the mode file's [endpoints] do not say it; once for each",
    )
    computers.add_argument(
        "--wait",
        type=_seconds,
        default=120.0,
        metavar="S",
        help="longest time to wait for the other computer's launcher (default: %(default).0f)",
    )
    return parser


def _seconds(text: str) -> float:
    value = float(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"expected more than 0 seconds, got {text}")
    return value
