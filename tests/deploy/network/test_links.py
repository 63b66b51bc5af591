"""What every kind of link must do."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from deploy.network import PRESETS, DirectionConditions, Host, NetworkConditions, NetworkLink
from tests.deploy.network.conftest import OpenLink, RunOn

ServeEcho = Callable[[NetworkLink, Host, int], None]

_ECHO_CLIENT = """
import random, socket, sys, threading
sent = random.Random(5).randbytes(int(sys.argv[3]))
with socket.create_connection((sys.argv[1], int(sys.argv[2])), timeout=20) as connection:
    def send():
        connection.sendall(sent)
        connection.shutdown(socket.SHUT_WR)
    sender = threading.Thread(target=send)
    sender.start()
    received = bytearray()
    while data := connection.recv(65536):
        received += data
    sender.join()
print(len(received), bytes(received) == sent)
"""


@pytest.mark.parametrize(
    ("conditions", "size_bytes"),
    [
        (PRESETS["ideal"], 3_000_000),
        (PRESETS["wifi_office"], 300_000),
        (NetworkConditions(DirectionConditions(delay_ms=10, jitter_ms=5, loss=0.05)), 100_000),
    ],
    ids=["ideal", "wifi_office", "uplink_only"],
)
def test_bytes_cross_intact_and_in_order_both_ways(
    open_any_link: OpenLink,
    serve_echo: ServeEcho,
    run_on: RunOn,
    port: int,
    conditions: NetworkConditions,
    size_bytes: int,
) -> None:
    with open_any_link(conditions) as network_link:
        serve_echo(network_link, "remote", port)
        address, dialled_port = network_link.dial_address("local", "remote", port)
        client = run_on(network_link, "local", _ECHO_CLIENT, address, dialled_port, size_bytes)
        output, _ = client.communicate(timeout=30)
        assert output == f"{size_bytes} True\n"
        assert network_link.failure() is None
        counted = network_link.kernel_bytes()
    if counted is not None:
        assert counted["uplink"] >= size_bytes
        assert counted["downlink"] >= size_bytes
    part = network_link.part()
    if part is not None:
        for direction in part.directions.values():
            assert direction.bytes_in >= direction.bytes_delivered >= size_bytes
            assert direction.packets_in >= direction.packets_delivered + sum(direction.dropped.values())


def test_a_service_on_the_same_host_is_reached_directly(
    open_any_link: OpenLink, serve_echo: ServeEcho, run_on: RunOn, port: int
) -> None:
    # 30 s of delay would not let a byte through the link in time.
    slow = DirectionConditions(delay_ms=30_000)
    with open_any_link(NetworkConditions(slow, slow)) as network_link:
        serve_echo(network_link, "local", port)
        address = network_link.dial_address("local", "local", port)
        client = run_on(network_link, "local", _ECHO_CLIENT, *address, 1000)
        assert client.communicate(timeout=10)[0] == "1000 True\n"
