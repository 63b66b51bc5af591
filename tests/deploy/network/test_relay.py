from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from common.errors import ConfigError
from deploy.network import (
    Crossing,
    DirectionConditions,
    Host,
    LinkFailedError,
    NetworkConditions,
    NetworkLink,
    NetworkPart,
    NoLink,
    RelayLink,
    Trace,
)

ServeEcho = Callable[[NetworkLink, Host, int], None]


@contextlib.contextmanager
def _dialled(network_link: NetworkLink, port: int) -> Iterator[socket.socket]:
    with socket.create_connection(network_link.dial_address("local", "remote", port), timeout=10) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        yield connection


def _inside_an_outage(time_ns: int, part: NetworkPart, margin_ns: int) -> bool:
    """Whether it is neither outside an outage nor within ``margin_ns`` of its start."""
    return any(o.start_monotonic_ns + margin_ns < time_ns < o.end_monotonic_ns for o in part.outages)


def test_bytes_come_back_no_earlier_than_both_delays(serve_echo: ServeEcho, tmp_path: Path, port: int) -> None:
    conditions = NetworkConditions(DirectionConditions(delay_ms=60), DirectionConditions(delay_ms=20))
    serve_echo(NoLink(), "remote", port)
    with (
        RelayLink(conditions, tmp_path, [Crossing("local", "remote", port)]) as network_link,
        _dialled(network_link, port) as connection,
    ):
        round_trips_s = []
        for _ in range(3):
            sent_s = time.monotonic()
            connection.sendall(b"ping")
            assert connection.recv(4) == b"ping"
            round_trips_s.append(time.monotonic() - sent_s)
    assert min(round_trips_s) >= 0.08
    part = network_link.part()
    assert (part.directions["uplink"].bytes_in, part.directions["downlink"].bytes_in) == (12, 12)


def test_a_crossing_from_the_remote_host_enters_the_downlink(serve_echo: ServeEcho, tmp_path: Path, port: int) -> None:
    serve_echo(NoLink(), "local", port)
    with RelayLink(NetworkConditions(), tmp_path, [Crossing("remote", "local", port)]) as network_link:
        address = network_link.dial_address("remote", "local", port)
        with socket.create_connection(address, timeout=10) as connection:
            connection.sendall(b"from remote")
            connection.shutdown(socket.SHUT_WR)
            while connection.recv(64):
                pass
    directions = network_link.part().directions
    assert directions["downlink"].bytes_in == directions["uplink"].bytes_in == len(b"from remote")


def test_nothing_moves_during_an_outage_and_nothing_is_lost(serve_echo: ServeEcho, tmp_path: Path, port: int) -> None:
    conditions = NetworkConditions(outage_every_s=0.5, outage_s=0.3)
    serve_echo(NoLink(), "remote", port)
    with (
        RelayLink(conditions, tmp_path, [Crossing("local", "remote", port)]) as network_link,
        _dialled(network_link, port) as connection,
    ):
        messages = [number.to_bytes(8, "big") for number in range(300)]

        def send() -> None:
            for message in messages:
                connection.sendall(message)
                time.sleep(0.005)
            connection.shutdown(socket.SHUT_WR)

        sender = threading.Thread(target=send)
        sender.start()
        received, times_ns = b"", []
        while data := connection.recv(4096):
            times_ns.append(time.monotonic_ns())
            received += data
        sender.join()
    part = network_link.part()
    assert received == b"".join(messages)
    assert len(part.outages) >= 2
    # What was delivered just before an outage may be read 0.1 s late on a busy machine.
    assert not [t for t in times_ns if _inside_an_outage(t, part, margin_ns=100_000_000)]


def test_a_connection_made_during_an_outage_is_accepted_and_waits(
    serve_echo: ServeEcho, tmp_path: Path, port: int
) -> None:
    conditions = NetworkConditions(outage_every_s=0.6, outage_s=0.5)
    serve_echo(NoLink(), "remote", port)
    with RelayLink(conditions, tmp_path, [Crossing("local", "remote", port)]) as network_link:
        first_outage_s = network_link.part().start_monotonic_ns / 1e9 + 0.65
        time.sleep(max(0.0, first_outage_s - time.monotonic()))
        with _dialled(network_link, port) as connection:
            connection.sendall(b"ping")
            assert connection.recv(4) == b"ping"
            replied_ns = time.monotonic_ns()
    assert not _inside_an_outage(replied_ns, network_link.part(), margin_ns=0)


def test_a_full_queue_stops_the_sender(serve_echo: ServeEcho, tmp_path: Path, port: int) -> None:
    # 125 bytes/ms: the queue is 12.5 kB long, and one read of 32 KiB may exceed it.
    conditions = NetworkConditions(DirectionConditions(rate_mbit=1, queue_ms=100))
    serve_echo(NoLink(), "remote", port)
    with (
        RelayLink(conditions, tmp_path, [Crossing("local", "remote", port)]) as network_link,
        _dialled(network_link, port) as connection,
    ):
        connection.settimeout(0.5)
        with pytest.raises(TimeoutError):
            connection.sendall(bytes(50_000_000))
    uplink = network_link.part().directions["uplink"]
    assert 0 < uplink.bytes_in - uplink.bytes_delivered <= 12_500 + 32_768


def test_a_dialler_is_hung_up_on_if_no_service_listens_and_served_when_it_does(
    serve_echo: ServeEcho, tmp_path: Path, port: int
) -> None:
    with RelayLink(NetworkConditions(), tmp_path, [Crossing("local", "remote", port)]) as network_link:
        with _dialled(network_link, port) as connection:
            assert connection.recv(1) == b""
        serve_echo(network_link, "remote", port)
        with _dialled(network_link, port) as connection:
            connection.sendall(b"ping")
            assert connection.recv(4) == b"ping"


def test_a_dialler_hears_that_the_service_is_gone(tmp_path: Path, port: int) -> None:
    with (
        socket.create_server(("127.0.0.1", port)) as service,
        RelayLink(NetworkConditions(), tmp_path, [Crossing("local", "remote", port)]) as network_link,
        _dialled(network_link, port) as connection,
    ):
        accepted, _ = service.accept()
        accepted.close()
        assert connection.recv(1) == b""


def test_a_crossing_that_was_not_announced_cannot_be_dialled(tmp_path: Path, port: int) -> None:
    with (
        RelayLink(NetworkConditions(), tmp_path, [Crossing("local", "remote", port)]) as network_link,
        pytest.raises(LinkFailedError, match="was not among the crossings"),
    ):
        network_link.dial_address("remote", "local", port)


def test_the_relay_refuses_a_congestion_control_that_it_cannot_have(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"congestion_control = 'cubic'.*expected '', or namespaces"):
        RelayLink(NetworkConditions(congestion_control="cubic"), tmp_path, []).__enter__()


def test_a_crossing_joins_two_hosts() -> None:
    with pytest.raises(ValueError, match="7447 stays on local"):
        Crossing("local", "local", 7447)


def test_a_trace_that_stops_ends_the_link_and_one_that_loops_does_not(tmp_path: Path, port: int) -> None:
    # 10,000 rows: more than a command line or a pipe would take.
    rows = tuple(number / 5e6 for number in range(10_000))
    for end, reason in (("stop", "the trace t.csv is over after 0.002 s, and trace_end = 'stop'"), ("loop", None)):
        trace = Trace("t.csv", rows, loss=(0.0,) * len(rows), end=end)
        conditions = NetworkConditions(DirectionConditions(trace=trace))
        with RelayLink(conditions, tmp_path, [Crossing("local", "remote", port)]) as network_link:
            time.sleep(0.002)  # the trace's own time
            assert network_link.failure() is None
            over = network_link.over()
            assert (over or "").startswith(reason or "")
            assert (over is None) == (reason is None)


def test_a_relay_that_died_is_a_failure(tmp_path: Path, port: int) -> None:
    with RelayLink(NetworkConditions(), tmp_path, [Crossing("local", "remote", port)]) as network_link:
        assert network_link.failure() is None
        process = network_link._process._process
        assert process is not None
        os.kill(process.pid, signal.SIGKILL)
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        failure = network_link.failure()
        assert network_link.over() is None
    assert failure is not None
    assert "exit code -9" in failure
