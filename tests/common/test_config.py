"""Configurations: what is wrong is named with its key, its value and what was expected."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import pytest
import tomli_w

from common.config import (
    build_config,
    load_config,
    parse_override,
    read_toml,
    section_names,
    setting,
    to_tables,
)
from common.errors import ConfigError
from common.topics import SERVICES


@dataclass(frozen=True)
class Arm:
    name: str = setting()
    joints: int = setting(6, low=1, high=7)
    speed: float = setting(0.5, low=0.0, high=2.0)
    reach: float = setting(1.0, low=0.1)
    offset: float = setting(0.0, high=10.0)
    grip: bool = setting(False)
    touch: str = setting("soft", choices=("soft", "stiff"))
    peers: list[str] = setting([])
    posture: list[float] = setting([0.5, -0.5])


@dataclass(frozen=True)
class Extra:
    preset: str = setting("")
    overrides: dict[str, Any] = setting(rest=True)


@dataclass(frozen=True)
class ArmConfig:
    arm: Arm
    extra: Extra


def load(tmp_path, text, overrides=()):
    path = tmp_path / "arm.toml"
    path.write_text(text, encoding="utf-8")
    return load_config(ArmConfig, path, overrides)


def refused(tmp_path, text, overrides=()):
    """Return the error that a file gives."""
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, text, overrides)
    return str(caught.value)


def test_what_is_not_given_has_its_default(tmp_path):
    config = load(tmp_path, '[arm]\nname = "left"\n')
    assert config == ArmConfig(Arm("left"), Extra())
    assert (config.arm.joints, config.arm.speed, config.arm.touch, config.arm.peers) == (6, 0.5, "soft", [])


def test_every_kind_of_value_is_read(tmp_path):
    config = load(
        tmp_path,
        '[arm]\nname = "left"\njoints = 7\nspeed = 1.5\ngrip = true\ntouch = "stiff"\npeers = ["a", "b"]\n'
        '[extra]\npreset = "demo"\n',
    )
    assert config.arm == Arm("left", 7, 1.5, grip=True, touch="stiff", peers=["a", "b"])
    assert config.extra.preset == "demo"


def test_default_lists_are_not_shared():
    first, second = Arm("a"), Arm("b")
    assert first.peers is not second.peers


def test_a_whole_number_is_a_number(tmp_path):
    speed = load(tmp_path, '[arm]\nname = "left"\nspeed = 2\n').arm.speed
    assert (speed, type(speed)) == (2.0, float)


def test_the_ends_of_a_range_belong_to_it(tmp_path):
    for joints in (1, 7):
        assert load(tmp_path, f'[arm]\nname = "left"\njoints = {joints}\n').arm.joints == joints


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("joints = 0", "[arm] joints = 0: expected a value from 1 to 7"),
        ("joints = 8", "[arm] joints = 8: expected a value from 1 to 7"),
        ("joints = 6.0", "[arm] joints = 6.0: expected a whole number"),
        (f"joints = {2**63}", f"[arm] joints = {2**63}: expected a number of at most 64 bits"),
        ('joints = "6"', "[arm] joints = '6': expected a whole number"),
        ("joints = true", "[arm] joints = True: expected a whole number"),
        ("joints = [6]", "[arm] joints = [6]: expected a whole number"),
        ("joints = {a = 6}", "[arm] joints = {'a': 6}: expected a whole number"),
        ("speed = 2.5", "[arm] speed = 2.5: expected a value from 0.0 to 2.0"),
        ("speed = false", "[arm] speed = False: expected a number"),
        ('speed = "fast"', "[arm] speed = 'fast': expected a number"),
        ("speed = nan", "[arm] speed = nan: expected a finite number"),
        ("reach = inf", "[arm] reach = inf: expected a finite number"),
        ("reach = 0.05", "[arm] reach = 0.05: expected at least 0.1"),
        ("offset = 10.5", "[arm] offset = 10.5: expected at most 10.0"),
        ("grip = 1", "[arm] grip = 1: expected true or false"),
        ('grip = "true"', "[arm] grip = 'true': expected true or false"),
        ("touch = 3", "[arm] touch = 3: expected text"),
        ('touch = "stif"', "[arm] touch = 'stif': expected one of soft, stiff; did you mean 'stiff'?"),
        ('touch = ""', "[arm] touch = '': expected one of soft, stiff"),
        ("touch = 2026-01-01", "expected text"),
        ('peers = "a"', "[arm] peers = 'a': expected a list of texts"),
        ('peers = ["a", 1]', "[arm] peers = ['a', 1]: expected a list of texts"),
        ("posture = 1.5", "[arm] posture = 1.5: expected a list of numbers"),
        ('posture = [1, "a"]', "[arm] posture = [1, 'a']: expected a list of numbers"),
        ("posture = [0.5, true]", "[arm] posture = [0.5, True]: expected a list of numbers"),
        ("posture = [[1, 2]]", "[arm] posture = [[1, 2]]: expected a list of numbers"),
    ],
)
def test_a_wrong_value_is_named_with_what_was_expected(tmp_path, line, expected):
    error = refused(tmp_path, f'[arm]\nname = "left"\n{line}\n')
    assert expected in error
    assert str(tmp_path / "arm.toml") in error


def test_a_list_of_numbers_may_hold_whole_ones(tmp_path):
    posture = load(tmp_path, '[arm]\nname = "left"\nposture = [0, 1.5, -2]\n').arm.posture
    assert posture == [0.0, 1.5, -2.0]
    assert {type(value) for value in posture} == {float}


def test_a_wrong_choice_like_no_other_names_the_choices_once(tmp_path):
    error = refused(tmp_path, '[arm]\nname = "left"\ntouch = "h264"\n')
    assert error.endswith("touch = 'h264': expected one of soft, stiff")


def test_a_missing_setting_is_named(tmp_path):
    assert "[arm]: name is missing; expected text" in refused(tmp_path, "[arm]\njoints = 2\n")


def test_a_missing_section_counts_as_empty(tmp_path):
    assert "[arm]: name is missing; expected text" in refused(tmp_path, "")


def test_an_unknown_key_comes_with_a_suggestion(tmp_path):
    error = refused(tmp_path, '[arm]\nname = "left"\njoint = 6\n')
    assert error.endswith("[arm]: unknown key 'joint'; did you mean 'joints'?")


def test_an_unknown_key_like_no_other_comes_with_the_known_ones(tmp_path):
    error = refused(tmp_path, '[arm]\nname = "left"\nxyz = 6\n')
    assert error.endswith("unknown key 'xyz'; known: name, joints, speed, reach, offset, grip, touch, peers, posture")


def test_an_unknown_section_comes_with_a_suggestion(tmp_path):
    assert "unknown section [arms]; did you mean 'arm'?" in refused(tmp_path, '[arms]\nname = "left"\n')
    assert "unknown section [nose]; known: arm, extra" in refused(tmp_path, '[nose]\nname = "left"\n')


def test_a_key_outside_all_sections_is_refused(tmp_path):
    assert "unknown section [joints]" in refused(tmp_path, 'joints = 6\n[arm]\nname = "left"\n')


@pytest.mark.parametrize("line", ["arm = 3", 'arm = "left"', "[[arm]]\njoints = 6", "arm = [1]"])
def test_a_section_is_a_table(tmp_path, line):
    assert "[arm]: expected a table" in refused(tmp_path, line + "\n")
    assert "[arm]: expected a table" in refused(tmp_path, line + "\n", ["arm.joints=6"])


def test_a_section_with_a_rest_takes_any_other_key(tmp_path):
    config = load(tmp_path, '[arm]\nname = "l"\n[extra]\npreset = "p"\nlearning_rate = 0.1\nsizes = [1, 2]\n')
    assert config.extra == Extra("p", {"learning_rate": 0.1, "sizes": [1, 2]})


def test_the_rest_is_still_checked_where_a_key_is_declared(tmp_path):
    assert "[extra] preset = 3: expected text" in refused(tmp_path, '[arm]\nname = "l"\n[extra]\npreset = 3\n')


def test_a_key_named_as_the_rest_is_one_of_it(tmp_path):
    config = load(tmp_path, '[arm]\nname = "l"\n[extra]\noverrides = 3\n')
    assert config.extra.overrides == {"overrides": 3}


def test_rests_are_not_shared():
    assert Extra().overrides is not Extra().overrides


# ------------------------------------------------------------------ files


@pytest.mark.parametrize("text", ["[arm", "name = \n", "[arm]\nname = left\n", "[arm]\n[arm]\n", "\0"])
def test_a_broken_file_is_named(tmp_path, text):
    error = refused(tmp_path, text)
    assert f"{tmp_path / 'arm.toml'}: not a TOML file: " in error


def test_a_file_that_is_not_text_is_named(tmp_path):
    path = tmp_path / "arm.toml"
    path.write_bytes(b"[arm]\nname = '\xff'\n")
    with pytest.raises(ConfigError, match=r"arm.toml: not a TOML file"):
        read_toml(path)


def test_a_number_beyond_all_reason_is_no_toml(tmp_path):
    assert "not a TOML file" in refused(tmp_path, "[arm]\njoints = " + "1" * 5000)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"nowhere.toml: cannot be read: No such file"):
        load_config(ArmConfig, tmp_path / "nowhere.toml")


def test_a_folder_is_no_file(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        load_config(ArmConfig, tmp_path)


# ------------------------------------------------------------------ --set


@pytest.mark.parametrize(
    ("override", "parsed"),
    [
        ("arm.joints=3", ("arm", "joints", 3)),
        ("arm.speed=3.5", ("arm", "speed", 3.5)),
        ("arm.speed=1e-3", ("arm", "speed", 0.001)),
        ("arm.grip=true", ("arm", "grip", True)),
        ("arm.name=left", ("arm", "name", "left")),
        ("arm.name=left-2.b", ("arm", "name", "left-2.b")),
        ("arm.name=two words", ("arm", "name", "two words")),
        ("arm.name=a=b", ("arm", "name", "a=b")),
        ("arm.name=", ("arm", "name", "")),
        ('arm.name="3"', ("arm", "name", "3")),
        ("arm.name='true'", ("arm", "name", "true")),
        ('arm.peers=["a", "b"]', ("arm", "peers", ["a", "b"])),
        ("arm.peers=[]", ("arm", "peers", [])),
        ("arm.speed=.5", ("arm", "speed", 0.5)),
        ("arm.speed=-.5", ("arm", "speed", -0.5)),
        ("arm.speed= +.5e-1 ", ("arm", "speed", 0.05)),
        ("arm.posture=[-.25,.17, 37.5,1]", ("arm", "posture", [-0.25, 0.17, 37.5, 1])),
        ("arm.posture=[[.5],[1.5]]", ("arm", "posture", [[0.5], [1.5]])),
        ("arm.name=..5", ("arm", "name", "..5")),
        ("arm.name=.5.5", ("arm", "name", ".5.5")),
        ("arm.name=.5 m", ("arm", "name", ".5 m")),
        ('arm.peers=["a .5"]', ("arm", "peers", ["a .5"])),
        ("arm.peers=[a]", ("arm", "peers", "[a]")),  # bare words only where a text stands alone
        (" arm.joints = 3 ", ("arm", "joints", 3)),
        ("extra.deep.key=1", ("extra", "deep.key", 1)),
        ("arm.name=tcp/127.0.0.1:7450", ("arm", "name", "tcp/127.0.0.1:7450")),
        ("extra.table={a = 1}", ("extra", "table", {"a": 1})),
    ],
)
def test_an_override_is_section_key_and_toml_value(override, parsed):
    assert parse_override(override) == parsed


@pytest.mark.parametrize("override", ["", "arm", "arm.joints", "joints=3", ".joints=3", "arm.=3", "=3", "."])
def test_an_override_without_its_parts_is_refused(override):
    with pytest.raises(ConfigError, match=r"expected section.key=value, for example"):
        parse_override(override)


def test_an_override_with_a_number_beyond_all_reason_is_text():
    assert parse_override("arm.name=" + "1" * 5000) == ("arm", "name", "1" * 5000)


def test_overrides_replace_what_the_file_says_and_the_last_one_wins(tmp_path):
    text = '[arm]\nname = "left"\njoints = 2\n'
    config = load(tmp_path, text, ["arm.joints=3", "arm.joints=4", "arm.touch=stiff", "extra.size=9"])
    assert (config.arm.joints, config.arm.touch, config.extra.overrides) == (4, "stiff", {"size": 9})


def test_an_override_can_give_what_the_file_leaves_out(tmp_path):
    assert load(tmp_path, "", ["arm.name=left"]).arm.name == "left"


def test_an_override_is_checked_like_the_file(tmp_path):
    text = '[arm]\nname = "left"\n'
    assert "joints = 9: expected a value from 1 to 7" in refused(tmp_path, text, ["arm.joints=9"])
    assert "unknown key 'joint'; did you mean 'joints'" in refused(tmp_path, text, ["arm.joint=2"])
    assert "name = 3: expected text" in refused(tmp_path, text, ["arm.name=3"])


def test_an_override_of_an_unknown_section_is_named_as_it_was_typed(tmp_path):
    error = refused(tmp_path, '[arm]\nname = "left"\n', ["amr.joints=2"])
    assert error == "--set amr.joints=2: no section [amr]; did you mean 'arm'?"


# ------------------------------------------------------------------ round trips


def test_a_configuration_becomes_tables_and_comes_back():
    config = ArmConfig(Arm("left", 3, peers=["a"]), Extra("p", {"rate": 0.1, "sizes": [1]}))
    tables = to_tables(config)
    assert tables["extra"] == {"preset": "p", "rate": 0.1, "sizes": [1]}
    assert build_config(ArmConfig, tables, "here") == config


@pytest.mark.parametrize("service", SERVICES)
def test_every_services_configuration_survives_its_file(tmp_path, service):
    config_class = service_config(service)
    config = build_config(config_class, minimal_tables(service), "here")
    path = tmp_path / f"{service}.toml"
    path.write_text(tomli_w.dumps(to_tables(config)), encoding="utf-8")
    assert load_config(config_class, path) == config


@pytest.mark.parametrize("service", SERVICES)
def test_every_setting_of_a_service_can_be_overridden(tmp_path, service):
    config_class = service_config(service)
    tables = to_tables(build_config(config_class, minimal_tables(service), "here"))
    path = tmp_path / f"{service}.toml"
    path.write_text(tomli_w.dumps(minimal_tables(service)), encoding="utf-8")
    for section, table in tables.items():
        for key, value in table.items():
            typed = tomli_w.dumps({"value": value}).partition("=")[2]
            assert to_tables(load_config(config_class, path, [f"{section}.{key}={typed}"])) == tables


@pytest.mark.parametrize("service", SERVICES)
def test_every_service_refuses_an_unknown_key_in_its_own_section(service):
    tables = minimal_tables(service) | {service: {"surprise": 1}}
    with pytest.raises(ConfigError, match=rf"\[{service}\]: unknown key 'surprise'"):
        build_config(service_config(service), tables, "here")


@pytest.mark.parametrize("service", SERVICES)
def test_every_service_has_a_section_of_its_own_and_knows_its_run(service):
    assert {"run", "transport", service} <= set(section_names(service_config(service)))


def service_config(service):
    name = "".join(word.capitalize() for word in service.split("_"))
    return getattr(import_module(f"services.{service}.config"), f"{name}Config")


def minimal_tables(service):
    """Return the settings that have no default."""
    tables = {
        "run": {"id": "r1", "directory": "runs/r1"},
        "transport": {"listen_real_time": "tcp/127.0.0.1:7450", "listen_bulk": "tcp/127.0.0.1:7451"},
    }
    return tables | ({"task": {"name": "dot_reacher"}} if service == "robot_bridge" else {})
