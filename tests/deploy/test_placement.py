"""Modes: the three that come with the project, and placement files that are wrong."""

from pathlib import Path

import pytest

from common.errors import ConfigError
from deploy.placement import load_placement, mode_names


def placement_file(folder: Path, text: str) -> str:
    path = folder / "my_mode.toml"
    path.write_text(text, encoding="utf-8")
    return str(path)


@pytest.mark.parametrize(
    ("mode", "remote"),
    [
        ("local_only", set()),
        ("remote_local", {"replay", "learner"}),
        ("remote_only", {"actor", "replay", "learner"}),
    ],
)
def test_modes_place_services_as_the_thesis_does(mode: str, remote: set[str]) -> None:
    placement = load_placement(mode)
    assert {service for service, host in placement.host.items() if host == "remote"} == remote
    assert placement.spans_hosts == bool(remote)


def test_the_robot_bridge_is_local_in_every_mode() -> None:
    assert {load_placement(mode).host["robot_bridge"] for mode in mode_names()} == {"local"}


def test_a_placement_file_is_a_mode_of_its_name(tmp_path: Path) -> None:
    path = placement_file(
        tmp_path, '[services]\nrobot_bridge = "local"\nactor = "local"\nreplay = "local"\nlearner = "remote"\n'
    )
    placement = load_placement(path)
    assert placement.mode == "my_mode"
    assert placement.together("actor", "replay")
    assert not placement.together("replay", "learner")


SERVICES = '[services]\nrobot_bridge = "local"\nactor = "local"\nreplay = "remote"\nlearner = "remote"\n'


def test_a_placement_file_may_say_where_its_hosts_are(tmp_path: Path) -> None:
    placement = load_placement(
        placement_file(tmp_path, SERVICES + '[endpoints]\nlocal = "192.168.1.10"\nremote = "192.168.1.20"\n')
    )
    assert placement.addresses == {"local": "192.168.1.10", "remote": "192.168.1.20"}
    assert load_placement("remote_local").addresses == {}
    assert placement.services_on("local") == ["robot_bridge", "actor"]
    assert placement.services_on("remote") == ["replay", "learner"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (SERVICES + '[endpoints]\nrobot = "10.0.0.1"', r"\[endpoints\] robot = '10.0.0.1': unknown host 'robot'"),
        (SERVICES + '[endpoints]\nlocal = "10.0.0"', r"\[endpoints\] local = '10.0.0': expected the computer's IPv4"),
        (SERVICES + "[endpoints]\nlocal = 10", r"\[endpoints\] local = 10: expected the computer's IPv4"),
        ("endpoints = 3\n" + SERVICES, "endpoints = 3: expected a table"),
        ('[services]\nrobot_bridg = "local"', r"unknown service 'robot_bridg'.*did you mean 'robot_bridge'"),
        ('[services]\nrobot_bridge = "laptop"', r"robot_bridge = 'laptop': expected one of local, remote"),
        ('[services]\nrobot_bridge = "local"\nactor = "local"', "no host for replay, learner"),
        ('[hosts]\nlocal = "10.0.0.1"', r"unknown section \[hosts\]"),
        ("services = 3", "expected a table"),
        ("[services", "not a TOML file"),
    ],
)
def test_a_wrong_placement_file_is_refused_by_name(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_placement(placement_file(tmp_path, text))


def test_an_unknown_mode_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"'remote_locl'.*local_only, remote_local, remote_only.*'remote_local'"):
        load_placement("remote_locl")
