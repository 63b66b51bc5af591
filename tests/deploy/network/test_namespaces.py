from __future__ import annotations

import json
import os
import select
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from common.errors import ConfigError
from deploy.network import DirectionConditions, LinkUnavailable, NamespaceLink, NetworkConditions
from deploy.network import namespaces as namespaces_module
from deploy.network.conditions import HOSTS
from deploy.network.namespaces import namespace_name, remove_stale_namespaces
from tests.deploy.network.conftest import RunOn

_NAMESPACES = Path("/var/run/netns")

_UDP_ECHO = """
import socket, sys
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as service:
    service.bind((sys.argv[1], 7000))
    print("listening", flush=True)
    while True:
        data, sender = service.recvfrom(2048)
        service.sendto(data, sender)
"""
_UDP_PING = """
import json, socket, sys, time
round_trips_ms = []
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
    client.settimeout(float(sys.argv[2]))
    for number in range(int(sys.argv[3])):
        sent = time.monotonic()
        client.sendto(bytes(72), (sys.argv[1], 7000))
        try:
            client.recv(2048)
        except TimeoutError:
            continue
        round_trips_ms.append((time.monotonic() - sent) * 1e3)
        time.sleep(float(sys.argv[4]))
print(json.dumps(round_trips_ms))
"""

_CRASHING_LAUNCHER = """
import os, signal, sys
from pathlib import Path
from deploy.network import NamespaceLink, NetworkConditions
with NamespaceLink(NetworkConditions(), Path(sys.argv[1])) as network_link:
    print(network_link._process._process.pid, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""

needs_namespaces = pytest.mark.usefixtures("namespaces")


def _own_namespaces() -> list[str]:
    return sorted(path.name for path in _NAMESPACES.glob(f"relod-{os.getpid()}-*"))


def _ping(
    network_link: NamespaceLink, run_on: RunOn, timeout_s: float = 5.0, count: int = 5, pause_s: float = 0.0
) -> list[float]:
    """UDP round trips from local to remote, ms."""
    service = run_on(network_link, "remote", _UDP_ECHO, network_link.addresses["remote"])
    assert service.stdout is not None
    assert service.stdout.readline() == "listening\n"
    client = run_on(network_link, "local", _UDP_PING, network_link.addresses["remote"], timeout_s, count, pause_s)
    round_trips_ms: list[float] = json.loads(client.communicate(timeout=20)[0])
    service.kill()
    return round_trips_ms


@needs_namespaces
def test_a_round_trip_takes_the_delays_of_both_directions(tmp_path: Path, run_on: RunOn) -> None:
    conditions = NetworkConditions(DirectionConditions(delay_ms=40), DirectionConditions(delay_ms=10))
    with NamespaceLink(conditions, tmp_path) as network_link:
        round_trips_ms = _ping(network_link, run_on)
    assert len(round_trips_ms) == 5
    assert min(round_trips_ms) >= 50


@needs_namespaces
def test_the_kernel_counts_what_the_packet_link_counts(tmp_path: Path, run_on: RunOn) -> None:
    with NamespaceLink(NetworkConditions(), tmp_path) as network_link:
        assert network_link.kernel_bytes() == {"uplink": 0, "downlink": 0}
        _ping(network_link, run_on)
    # 72 bytes of data, 8 of UDP, 20 of IP, five times.
    assert network_link.kernel_bytes() == {"uplink": 500, "downlink": 500}
    part = network_link.part()
    for direction in part.directions.values():
        assert (direction.packets_in, direction.bytes_in) == (5, 500)
        assert (direction.packets_delivered, direction.bytes_delivered) == (5, 500)
    for counted in part.kernel.values():
        assert (counted.sent, counted.received) == (500, 500)


@needs_namespaces
def test_lost_packets_are_counted_and_not_delivered(tmp_path: Path, run_on: RunOn) -> None:
    conditions = NetworkConditions(DirectionConditions(loss=1.0))
    with NamespaceLink(conditions, tmp_path) as network_link:
        assert _ping(network_link, run_on, timeout_s=0.1, count=3) == []
    part = network_link.part()
    assert part.directions["uplink"].dropped == {"loss": 3, "queue": 0, "outage": 0, "write": 0}
    assert part.kernel["remote"].received == 0


@needs_namespaces
def test_packets_of_an_outage_are_dropped_and_the_outage_is_recorded(tmp_path: Path, run_on: RunOn) -> None:
    # Silent but for 10 ms of each 0.5 s, from 0.5 s on.
    conditions = NetworkConditions(outage_every_s=0.5, outage_s=0.49)
    with NamespaceLink(conditions, tmp_path) as network_link:
        answered = _ping(network_link, run_on, timeout_s=0.05, count=40, pause_s=0.02)
    part = network_link.part()
    dropped = sum(direction.dropped["outage"] for direction in part.directions.values())
    assert dropped == 40 - len(answered) > 0
    first = part.outages[0]
    assert first.start_monotonic_ns == part.start_monotonic_ns + 500_000_000
    assert first.end_monotonic_ns == part.start_monotonic_ns + 990_000_000
    assert all(outage.end_monotonic_ns <= part.written_monotonic_ns for outage in part.outages)


@needs_namespaces
def test_a_command_keeps_its_process_id_and_cannot_leave_the_emulated_network(tmp_path: Path, run_on: RunOn) -> None:
    program = "import os, socket; print(os.getpid(), [name for _, name in socket.if_nameindex()])"
    with NamespaceLink(NetworkConditions(), tmp_path) as network_link:
        process = run_on(network_link, "remote", program)
        assert process.communicate(timeout=10)[0] == f"{process.pid} ['lo', 'net0']\n"


@needs_namespaces
def test_the_hosts_have_the_congestion_control_that_was_chosen(tmp_path: Path, run_on: RunOn) -> None:
    program = "print(open('/proc/sys/net/ipv4/tcp_congestion_control').read())"
    with NamespaceLink(NetworkConditions(congestion_control="reno"), tmp_path) as network_link:
        for host in HOSTS:
            assert run_on(network_link, host, program).communicate(timeout=10)[0].split() == ["reno"]


@needs_namespaces
def test_a_congestion_control_that_the_kernel_lacks_is_refused_with_those_it_has(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"network.congestion_control = 'fast': this kernel allows .*reno"):
        NamespaceLink(NetworkConditions(congestion_control="fast"), tmp_path).__enter__()
    assert _own_namespaces() == []


@needs_namespaces
def test_nothing_is_left_after_a_link_whatever_ended_it(tmp_path: Path) -> None:
    network_link = NamespaceLink(NetworkConditions(), tmp_path)
    network_link.__enter__()
    assert _own_namespaces() == [namespace_name("local"), namespace_name("remote")]
    process = network_link._process._process
    assert process is not None
    network_link.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)
    assert _own_namespaces() == []
    assert process.returncode == 0


@needs_namespaces
def test_nothing_is_left_if_the_link_process_does_not_come_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(LinkUnavailable, match="ended before it was ready"):
        NamespaceLink(NetworkConditions(), tmp_path).__enter__()
    assert _own_namespaces() == []


@needs_namespaces
def test_a_second_link_of_one_launcher_is_refused_and_leaves_the_first_alone(tmp_path: Path, run_on: RunOn) -> None:
    with NamespaceLink(NetworkConditions(), tmp_path) as network_link:
        with pytest.raises(LinkUnavailable, match="exists already"):
            NamespaceLink(NetworkConditions(), tmp_path / "second").__enter__()
        assert len(_ping(network_link, run_on, count=1)) == 1


@needs_namespaces
def test_a_crashed_launcher_takes_the_link_process_along_and_its_namespaces_are_removed_later(
    tmp_path: Path,
) -> None:
    launcher = subprocess.Popen(
        [sys.executable, "-c", _CRASHING_LAUNCHER, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    link_pid = int(launcher.communicate(timeout=20)[0])
    assert launcher.returncode == -signal.SIGKILL
    _wait_until_gone(link_pid)
    names = [f"relod-{launcher.pid}-{host}" for host in ("local", "remote")]
    assert all((_NAMESPACES / name).exists() for name in names)
    assert set(names) <= set(remove_stale_namespaces())
    assert not any((_NAMESPACES / name).exists() for name in names)


@needs_namespaces
def test_namespaces_of_others_are_not_stale(tmp_path: Path) -> None:
    foreign = f"relod-{os.getpid()}-robot"
    subprocess.run(["ip", "netns", "add", foreign], check=True)
    try:
        with NamespaceLink(NetworkConditions(), tmp_path):
            assert foreign not in remove_stale_namespaces()
            assert len(_own_namespaces()) == 3
    finally:
        subprocess.run(["ip", "netns", "delete", foreign], check=True)


def test_a_machine_without_the_ip_command_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(LinkUnavailable, match="install iproute2"):
        NamespaceLink(NetworkConditions(), tmp_path).__enter__()


def test_a_machine_without_tun_says_what_to_load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: f"/sbin/{name}")
    monkeypatch.setattr(namespaces_module, "_TUN", tmp_path / "tun")
    with pytest.raises(LinkUnavailable, match="load the kernel module 'tun'"):
        NamespaceLink(NetworkConditions(), tmp_path).__enter__()


def test_a_user_without_privileges_is_told_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: f"/sbin/{name}")
    monkeypatch.setattr(namespaces_module, "_TUN", tmp_path)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(LinkUnavailable, match="sudo, or choose the relay"):
        NamespaceLink(NetworkConditions(), tmp_path).__enter__()


def _wait_until_gone(pid: int) -> None:
    """Wait for the end of a process that is not a child of this one."""
    try:
        handle = os.pidfd_open(pid)
    except ProcessLookupError:
        return
    try:
        assert select.select([handle], [], [], 5)[0], f"process {pid} has not ended"
    finally:
        os.close(handle)
