"""What two computers that start a run together have to agree on, without a directory that they share. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from common.config import to_tables
from common.messages import SCHEMA_VERSION
from deploy.network import HOSTS, Host
from deploy.placement import Placement
from deploy.run_file import versions

Facts = dict[str, str]
"""Name of what has to agree, as the user knows it -> its value as text."""

RUN_ID = "--run-id"
RELEASE = "release"
_NOT_ALIKE = ("run.id", "run.directory")
_TOLD_SEPARATELY = ("transport.listen_", "transport.connect_")
"""Settings that follow from placement, endpoints and base port."""


def facts_of(
    placement: Placement,
    addresses: Mapping[Host, str],
    base_port: int,
    run_id: str | None,
    configurations: Mapping[str, Any],
) -> Facts:
    """Return one side's facts; ``run_id`` is None if it takes the other side's."""
    facts = {
        RELEASE: versions().get("commit", versions()["relod"]),
        "message schema": str(SCHEMA_VERSION),
        "--base-port": str(base_port),
        **{f"endpoint {host}": addresses[host] for host in HOSTS},
        **{host_fact(service): host for service, host in placement.host.items()},
    }
    if run_id is not None:
        facts[RUN_ID] = run_id
    for service, configuration in configurations.items():
        for section, table in to_tables(configuration).items():
            for key, value in table.items():
                name = f"{section}.{key}"
                if name not in _NOT_ALIKE and not name.startswith(_TOLD_SEPARATELY):
                    facts[f"{service}: {name}"] = repr(value)
    return facts


def host_fact(service: str) -> str:
    """Name of the fact on which host a service runs."""
    return f"host of {service}"


def differences(here: Facts, there: Facts, here_name: Host, there_name: Host) -> list[str]:
    """Return what the two sides do not agree on, a line each; empty if they do.

    A run id that only one of them names is the other's too. The release may differ, as long as messages and settings
    are the same.
    """
    lines = []
    for name in dict.fromkeys([*here, *there]):
        mine, theirs = here.get(name), there.get(name)
        if mine == theirs or name == RELEASE or (name == RUN_ID and None in (mine, theirs)):
            continue
        lines.append(f"{name}: {_said(mine)} on {here_name}, {_said(theirs)} on {there_name}")
    return lines


def _said(value: str | None) -> str:
    return "not known" if value is None else value
