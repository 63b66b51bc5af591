"""Two services of a run on this computer, each in its process, connected as the launcher connects them."""

from __future__ import annotations

import gc
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from common.run_settings import RunSettings, TransportSettings
from common.service import Service
from common.transport import ZenohTransport

PORTS = 4
"""That two services listen on: real-time and bulk lane each."""
RUN = "bench"


def first_service(resources: ExitStack, name: str, ports: list[int], directory: Path | None = None) -> Service:
    """Start the service that waits for the other to connect; see :func:`second_service`."""
    return _service(resources, name, TransportSettings(_tcp(ports[0]), _tcp(ports[1])), directory)


def second_service(resources: ExitStack, name: str, ports: list[int], directory: Path | None = None) -> Service:
    """Start the service that connects to the first.

    Args:
        resources: what closes it.
        name: of the service.
        ports: the same :data:`PORTS` free ones as the first's.
        directory: of the run; None: a temporary one.
    """
    first, own = ports[:2], ports[2:]
    settings = TransportSettings(
        listen_real_time=_tcp(own[0]),
        listen_bulk=_tcp(own[1]),
        connect_real_time=[_tcp(first[0])],
        connect_bulk=[_tcp(first[1])],
    )
    return _service(resources, name, settings, directory)


def run_in_background(resources: ExitStack, service: Service, run: Callable[[], None]) -> None:
    """Run a service's loop on a thread, until ``resources`` are closed."""
    thread = threading.Thread(target=run, name="service", daemon=True)
    thread.start()

    def stop() -> None:
        service.stop("measured")
        thread.join(3.0)

    resources.callback(stop)


def _service(resources: ExitStack, name: str, settings: TransportSettings, directory: Path | None) -> Service:
    """A service as its own process makes it (:mod:`common.run_service`)."""
    sys.setswitchinterval(5e-4)
    folder = directory or resources.enter_context(tempfile.TemporaryDirectory())
    run = RunSettings(id=RUN, directory=str(folder))
    service = Service(name, run, ZenohTransport(run, settings))
    resources.callback(service.close)
    service.start()
    gc.freeze()
    return service


def _tcp(port: int) -> str:
    return f"tcp/127.0.0.1:{port}"
