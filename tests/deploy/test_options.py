"""The launcher's command line: networks, names, defaults."""

import shlex
from datetime import datetime
from pathlib import Path

import pytest

from common.errors import ConfigError
from deploy.network import PRESETS
from deploy.options import choose_network, default_run_name, make_run_id, parse_options
from deploy.placement import load_placement

NOON = datetime(2025, 3, 4, 12, 5, 6)


def test_defaults_are_left_to_the_services() -> None:
    options = parse_options(["local_only", "--task", "dot_reacher"])
    request = options.request
    assert (request.algorithm, request.steps, request.seed, request.pacing) == ("sac", None, None, None)
    assert (options.network, options.conditions, options.write_config) == ("none", None, None)
    assert request.run_dir.parent == Path.cwd() / "runs"
    assert request.run_dir.name.endswith("-local_only-dot_reacher-0")


def test_everything_can_be_said() -> None:
    options = parse_options(
        shlex.split(
            "remote_only --task dot_reacher --algorithm sac --steps 10 --seed 3 --pacing lockstep --network wifi_bad "
            "--run-dir out --set actor.threads=2 --set network.loss=0 --base-port 9000 --write-config configs"
        )
    )
    request = options.request
    assert (request.steps, request.seed, request.pacing, request.overrides) == (10, 3, "lockstep", ("actor.threads=2",))
    assert request.run_dir == Path.cwd() / "out"
    assert options.write_config == Path.cwd() / "configs"
    assert options.base_port == 9000
    assert options.conditions is not None
    assert options.conditions.uplink.loss == options.conditions.downlink.loss == 0
    assert options.conditions.uplink.delay_ms == PRESETS["wifi_bad"].uplink.delay_ms
    assert options.network == "wifi_bad, changed"


def test_a_host_budget_is_a_host_s_name_or_file(tmp_path: Path) -> None:
    command = ["local_only", "--task", "dot_reacher", "--host-budget"]
    host = parse_options([*command, "jetson"]).request.learner_host
    assert host is not None
    assert (host.name, host.replay_capacity) == ("jetson", 16_000)
    with pytest.raises(ConfigError, match=r"'board\.toml': expected one of jetson, laptop, workstation, or the path"):
        parse_options([*command, "board.toml"])


def test_a_mode_with_two_hosts_has_an_ideal_network_unless_told() -> None:
    assert choose_network(load_placement("remote_only"), None, {}) == ("ideal", PRESETS["ideal"])
    assert choose_network(load_placement("remote_local"), "outage", {}) == ("outage", PRESETS["outage"])


def test_a_mode_with_one_host_has_no_network() -> None:
    local_only = load_placement("local_only")
    assert choose_network(local_only, None, {}) == ("none", None)
    assert choose_network(local_only, "ideal", {}) == ("none", None)
    for network, overrides in (("wifi_office", {}), (None, {"loss": 0.1})):
        with pytest.raises(ConfigError, match="nothing crosses a network"):
            choose_network(local_only, network, overrides)


def test_overrides_of_the_network_win_over_its_file(tmp_path: Path) -> None:
    path = tmp_path / "cellar.toml"
    path.write_text("[network]\ndelay_ms = 4\n[network.uplink]\nrate_mbit = 2\nloss = 0.5\n", encoding="utf-8")
    remote_only = load_placement("remote_only")
    name, from_file = choose_network(remote_only, str(path), {})
    assert name == "cellar"
    assert from_file is not None
    assert from_file.uplink.loss == 0.5
    name, changed = choose_network(remote_only, str(path), {"loss": 0.1, "uplink.rate_mbit": 3, "outage_every_s": 9})
    assert name == "cellar, changed"
    assert changed is not None
    assert (changed.uplink.loss, changed.downlink.loss) == (0.1, 0.1)
    assert (changed.uplink.rate_mbit, changed.downlink.rate_mbit) == (3, None)
    assert (changed.uplink.delay_ms, changed.outage_every_s) == (4, 9)


def test_an_unknown_network_is_refused_by_name() -> None:
    remote_only = load_placement("remote_only")
    with pytest.raises(ConfigError, match="'wifi_ofice'"):
        choose_network(remote_only, "wifi_ofice", {})
    with pytest.raises(ConfigError, match=r"network\.los"):
        choose_network(remote_only, "ideal", {"los": 0.1})


def test_names_of_runs_fit_folders_and_key_expressions() -> None:
    assert default_run_name("remote_only", "my/task", 2, NOON) == "20250304-120506-remote_only-my_task-2"
    one, other = make_run_id(NOON), make_run_id(NOON)
    assert one != other
    assert one.isalnum()
