"""What two computers must agree on before they start one run."""

from pathlib import Path
from typing import Any

import pytest

from deploy.agreement import RELEASE, Facts, differences, facts_of
from deploy.computers import TwoComputers
from deploy.network import Host
from deploy.placement import load_placement
from deploy.plan import PORTS, PortMap, RunRequest, plan_run

ADDRESSES: dict[Host, str] = {"local": "10.0.0.1", "remote": "10.0.0.2"}


def facts(
    mode: str = "remote_local",
    addresses: dict[Host, str] = ADDRESSES,
    base_port: int = 7450,
    run_id: str | None = None,
    **request: Any,
) -> Facts:
    placement = load_placement(mode)
    values = {"task": "dot_reacher", "algorithm": "sac", "run_id": "x", "run_dir": Path("/run"), **request}
    ports = PortMap(range(base_port, base_port + PORTS))
    configurations = plan_run(RunRequest(placement, **values), ports, TwoComputers(addresses), None)
    return facts_of(placement, addresses, base_port, run_id, configurations)


def test_the_same_command_agrees_whatever_the_run_directory_is() -> None:
    here, there = facts(run_id="one", run_dir=Path("/here")), facts(run_dir=Path("/there"), run_id=None)
    assert differences(here, there, "local", "remote") == []
    assert differences(there, here, "remote", "local") == []


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"run_id": "two"}, "--run-id: one on local, two on remote"),
        ({"task": "visual_dot_reacher"}, "robot_bridge: task.name: 'dot_reacher' on local, 'visual_dot_reacher' on"),
        ({"steps": 9}, "robot_bridge: robot_bridge.steps: 7000 on local, 9 on remote"),
        ({"seed": 3}, "learner: run.seed: 0 on local, 3 on remote"),
        ({"overrides": ("run.robot=arm2",)}, "actor: run.robot: 'robot0' on local, 'arm2' on remote"),
        ({"overrides": ("algorithm.batch_size=8",)}, "learner: algorithm.batch_size: not known on local, 8 on remote"),
        ({"base_port": 7500}, "--base-port: 7450 on local, 7500 on remote"),
        ({"mode": "remote_only"}, "host of actor: local on local, remote on remote"),
        (
            {"addresses": {"local": "10.0.0.1", "remote": "10.0.0.3"}},
            "endpoint remote: 10.0.0.2 on local, 10.0.0.3 on remote",
        ),
    ],
)
def test_what_is_not_the_same_is_named_with_both_values(change: dict[str, Any], line: str) -> None:
    lines = differences(facts(run_id="one"), facts(**{"run_id": "one", **change}), "local", "remote")
    assert any(found.startswith(line) for found in lines), lines


def test_endpoints_are_named_once_and_not_for_every_service() -> None:
    moved = facts(addresses={"local": "10.0.0.9", "remote": "10.0.0.2"})
    assert differences(facts(), moved, "local", "remote") == ["endpoint local: 10.0.0.1 on local, 10.0.0.9 on remote"]


def test_another_release_agrees_as_long_as_messages_and_settings_do() -> None:
    here = facts()
    assert here[RELEASE]
    assert differences(here, {**here, RELEASE: "other"}, "local", "remote") == []
    older = {**here, "message schema": "0"}
    assert differences(here, older, "local", "remote")[0].startswith("message schema: ")
