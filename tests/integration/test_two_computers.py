"""A run on two computers, real services: launchers, directories and addresses of their own.

As root the computers are network namespaces joined by an emulated WiFi; otherwise two addresses of this machine.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

from deploy.network import HOSTS, PRESETS, LinkUnavailable, NamespaceLink
from deploy.placement import MODES
from deploy.ports import reserved_ports
from deploy.run_record import read_record
from deploy.side import SIDE_PORTS
from deploy.summary import summarise

REPOSITORY = Path(__file__).parents[2]
PATIENCE_S = 240.0
# In lockstep the run waits for the learner, however long its imports take.
RUN = ["--task", "dot_reacher", "--steps", "500", "--pacing", "lockstep", "--host-budget", "laptop"]
SMALL = ["--set=algorithm.hidden_size=16", "--set=algorithm.batch_size=16", "--set=algorithm.min_size_to_sample=50"]


@contextlib.contextmanager
def two_computers(folder: Path) -> Iterator[tuple[dict[str, str], dict[str, list[str]]]]:
    """Host -> address, and host -> what takes a command there."""
    with contextlib.ExitStack() as stack:
        try:
            link = stack.enter_context(NamespaceLink(PRESETS["wifi_office"], folder, 0))
        except LinkUnavailable:
            yield {"local": "127.0.0.2", "remote": "127.0.0.3"}, {"local": [], "remote": []}
        else:
            yield (
                {host: link.listen_address(host) for host in HOSTS},
                {host: link.command_prefix(host) for host in HOSTS},
            )


def test_two_launchers_make_one_run_with_one_complete_record(tmp_path: Path) -> None:
    (tmp_path / "link").mkdir()
    mode = tmp_path / "lab.toml"
    with reserved_ports(SIDE_PORTS) as ports:
        base_port = ports[0]
    with two_computers(tmp_path / "link") as (addresses, prefixes):
        endpoints = "".join(f'{host} = "{address}"\n' for host, address in addresses.items())
        mode.write_text((MODES / "remote_local.toml").read_text() + f"\n[endpoints]\n{endpoints}")
        common = ["-m", "deploy.launch", str(mode), *RUN, *SMALL, "--base-port", str(base_port)]
        launchers = {
            host: subprocess.Popen(
                [*prefixes[host], sys.executable, *common, "--host", host, "--run-dir", str(tmp_path / host)],
                cwd=REPOSITORY,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
            for host in HOSTS
        }
        try:
            said = {host: launcher.communicate(timeout=PATIENCE_S)[0] for host, launcher in launchers.items()}
        finally:
            for launcher in launchers.values():
                launcher.kill()
    assert {host: launcher.returncode for host, launcher in launchers.items()} == {"local": 0, "remote": 0}, said
    assert "500/500 100 %" in said["local"]
    local, remote = tmp_path / "local", tmp_path / "remote"
    assert (local / "actions.csv").exists()
    assert not (local / "ring").exists()
    assert (remote / "ring").exists()
    assert (remote / "policy.msgpack").exists()
    ids = {tomllib.loads((folder / "run.toml").read_text())["run"]["id"] for folder in (local, remote)}
    assert len(ids) == 1
    values = json.loads((local / "summary.json").read_text())
    assert values == json.loads((remote / "summary.json").read_text())
    assert values["experience"]["produced"] == values["experience"]["persisted"] > 400
    assert (values["experience"]["lost"], values["experience"]["duplicated"]) == (0, 0)
    assert (values["steps"], values["service_failures"]) == (500, [])
    # A laptop's third of an update for each transition after the first 50; the last may have had no time for its own.
    assert 0 < values["updates"] <= (values["experience"]["persisted"] - 50) / 3
    assert summarise(read_record(local, remote)).values == values
