"""Services to put on both ends of a link, and the links to put between them."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from deploy.network import (
    Crossing,
    Host,
    LinkUnavailable,
    NamespaceLink,
    NetworkConditions,
    NetworkLink,
    NoLink,
    RelayLink,
)

OpenLink = Callable[[NetworkConditions], contextlib.AbstractContextManager[NetworkLink]]
RunOn = Callable[..., subprocess.Popen[str]]

_ECHO_SERVICE = """
import socket, sys
listener = socket.create_server((sys.argv[1], int(sys.argv[2])))
print("listening", flush=True)
while True:
    connection, _ = listener.accept()
    while data := connection.recv(65536):
        connection.sendall(data)
    connection.close()
"""


@pytest.fixture(scope="session")
def why_no_namespaces(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Why network namespaces cannot be made here; empty if they can."""
    try:
        with NamespaceLink(NetworkConditions(), tmp_path_factory.mktemp("link")):
            return ""
    except LinkUnavailable as error:
        return str(error)


@pytest.fixture
def namespaces(why_no_namespaces: str) -> None:
    """Skips the test where network namespaces cannot be made."""
    if why_no_namespaces:
        pytest.skip(why_no_namespaces)


@pytest.fixture
def port() -> int:
    """A TCP port that is free on loopback."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture(params=["none", "relay", "namespaces"])
def open_any_link(request: pytest.FixtureRequest, tmp_path: Path, port: int) -> OpenLink:
    """Opens a link of each kind; ``port`` is the service that ``local`` dials on ``remote``."""
    if request.param == "none":
        return lambda conditions: NoLink()
    if request.param == "relay":
        return lambda conditions: RelayLink(conditions, tmp_path, [Crossing("local", "remote", port)])
    request.getfixturevalue("namespaces")
    return lambda conditions: NamespaceLink(conditions, tmp_path)


@pytest.fixture
def run_on() -> Iterator[RunOn]:
    """Runs a Python program on a host of a link: ``run_on(network_link, host, program, *arguments)``."""
    with contextlib.ExitStack() as stack:

        def run(network_link: NetworkLink, host: Host, program: str, *arguments: object) -> subprocess.Popen[str]:
            command = [sys.executable, "-I", "-S", "-c", program, *map(str, arguments)]
            process = subprocess.Popen(
                [*network_link.command_prefix(host), *command], stdout=subprocess.PIPE, text=True
            )
            stack.enter_context(process)  # waits for it, and closes its pipe
            stack.callback(process.kill)
            return process

        yield run


@pytest.fixture
def serve_echo(run_on: RunOn) -> Callable[[NetworkLink, Host, int], None]:
    """Starts an echo service on a host and waits until it listens."""

    def serve(network_link: NetworkLink, host: Host, port: int) -> None:
        service = run_on(network_link, host, _ECHO_SERVICE, network_link.listen_address(host), port)
        assert service.stdout is not None
        assert service.stdout.readline() == "listening\n"

    return serve
