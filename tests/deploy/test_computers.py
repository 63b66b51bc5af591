"""Addresses of two real computers, and those that cannot be."""

import re

import pytest

from common.errors import ConfigError
from deploy.computers import TwoComputers, check_is_ours, check_pair, checked_address, other_host


@pytest.mark.parametrize("address", ["192.168.1.300", "robot.local", "", "0.0.0.0", "224.0.0.1", "::1", 7, None])
def test_what_is_no_computer_s_ipv4_address_is_refused(address: object) -> None:
    with pytest.raises(ConfigError, match=r"here: expected the computer's IPv4 address, such as 192\.168\.1\.10"):
        checked_address("local", address, "here")


def test_an_address_of_an_unknown_host_is_refused() -> None:
    with pytest.raises(ConfigError, match="unknown host 'lokal'; expected local or remote"):
        checked_address("lokal", "10.0.0.1", "here")


def test_both_addresses_are_needed() -> None:
    with pytest.raises(ConfigError, match=r"no address for 'remote'.*\[endpoints\].*--endpoint remote=ADDRESS"):
        check_pair({"local": "10.0.0.1"})


@pytest.mark.parametrize("local_is_inner", [True, False])
def test_a_loopback_address_reaches_no_other_computer(local_is_inner: bool) -> None:
    inner, outer = ("local", "remote") if local_is_inner else ("remote", "local")
    with pytest.raises(ConfigError, match=f"the address that {inner} has in the network of {outer}"):
        check_pair({inner: "127.0.0.1", outer: "10.0.0.2"})  # type: ignore[dict-item]
    check_pair({"local": "127.0.0.1", "remote": "127.0.0.2"})


def test_two_computers_have_two_addresses() -> None:
    with pytest.raises(ConfigError, match=r"local = remote = 10\.0\.0\.1: expected the addresses of two computers"):
        check_pair({"local": "10.0.0.1", "remote": "10.0.0.1"})


def test_an_address_of_another_computer_is_refused() -> None:
    check_is_ours("local", "127.0.0.1")
    # 192.0.2.0/24 is for documentation: no computer has it.
    with pytest.raises(ConfigError, match=re.escape("endpoint local = 192.0.2.7: not an address of this computer")):
        check_is_ours("local", "192.0.2.7")


def test_services_listen_on_their_computer_and_are_dialled_there() -> None:
    link = TwoComputers({"local": "10.0.0.1", "remote": "10.0.0.2"})
    assert link.listen_address("remote") == "10.0.0.2"
    assert link.dial_address("remote", "local", 7450) == ("10.0.0.1", 7450)
    assert link.dial_address("local", "local", 7450) == ("10.0.0.1", 7450)
    assert (other_host("local"), other_host("remote")) == ("remote", "local")
