"""Ports: free ones are found, taken ones are named, and two launchers do not get the same."""

import socket

import pytest

from common.errors import ConfigError
from deploy.ports import DEFAULT_BASE_PORT, held_ports, reserved_ports


def test_ports_are_consecutive_and_from_the_default_base_on() -> None:
    with reserved_ports(8) as ports:
        assert len(ports) == 8
        assert (ports[0] - DEFAULT_BASE_PORT) % 8 == 0


def test_two_launchers_get_different_ports_before_any_is_listened_on() -> None:
    with reserved_ports(8) as ours, reserved_ports(8) as theirs:
        assert not set(ours) & set(theirs)


def test_ports_are_given_back() -> None:
    with reserved_ports(8) as ports:
        first = ports[0]
    with reserved_ports(8, base=first) as again:
        assert again[0] == first


def test_a_port_in_use_is_skipped_or_named() -> None:
    with reserved_ports(8) as free:
        base = free[0]
    with socket.create_server(("127.0.0.1", base + 3)):
        with reserved_ports(8) as others:
            assert base + 3 not in others
        with (
            pytest.raises(ConfigError, match=f"another process listens on {base + 3}; choose another --base-port"),
            reserved_ports(8, base=base),
        ):
            pass


@pytest.mark.parametrize("base", [0, -1, 65530, 70000])
def test_a_base_port_out_of_range_is_refused(base: int) -> None:
    with pytest.raises(ConfigError, match=f"--base-port {base}"), reserved_ports(8, base=base):
        pass


def test_ports_of_one_address_are_held_as_they_are_asked_for() -> None:
    with reserved_ports(4) as free:
        base = free[0]
    with (
        held_ports([base, base + 3], "127.0.0.2"),
        held_ports([base + 1], "127.0.0.3"),
        pytest.raises(ConfigError, match=f"use {base + 3}; choose another --base-port, on both computers"),
        held_ports([base + 2, base + 3], "127.0.0.3"),
    ):
        pass
    with socket.create_server(("127.0.0.2", base)), held_ports([base], "127.0.0.3"):
        pass
    with (
        socket.create_server(("127.0.0.2", base)),
        pytest.raises(ConfigError, match=f"another process listens on {base}"),
        held_ports([base], "127.0.0.2"),
    ):
        pass
