"""The four services of one run in one process, each in a simulated thread."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from common import topics
from common.codec import decode
from common.errors import RelodError, ServiceError
from common.messages import TaskSpec
from common.run_settings import RunSettings
from common.service import Service
from common.topics import ROBOT_BRIDGE, SERVICES
from common.transport import Transport
from experiments.simulation import SimulatedClock, SimulatedNetwork

logger = logging.getLogger(__name__)

_LOOK_S = 1.0
"""Simulated time between two looks at what is going on."""


class ServiceNetwork(Protocol):
    """Connects the services of a simulation."""

    def transport_of(self, service: str, run: RunSettings) -> Transport:
        """Join the mesh as ``service``."""
        ...


class InProcessRun:
    """Runs the services to the end of their run. The thread that makes it is the one that runs it."""

    def __init__(self, configurations: Mapping[str, Any], clock: SimulatedClock, network: ServiceNetwork) -> None:
        self._configurations, self._clock, self._network = configurations, clock, network
        self._failures: dict[str, Exception] = {}
        self.told_to_stop: str | None = None
        """Why the run was to end early; None if it was not."""
        self._services = {name: self._service(name, number) for number, name in enumerate(SERVICES, 1)}

    def run(self, look: Callable[[InProcessRun], None]) -> None:
        """Run to the end; ``look`` is called once in a while.

        Raises:
            RelodError: a service has failed; the others have been stopped.
        """
        try:
            threads = [self._clock.thread(lambda name=name: self._serve(name), name) for name in SERVICES]  # type: ignore[misc]
            threads[0].start()
            self._bridge_has_started()
            for thread in threads[1:]:
                thread.start()
            while any(thread.is_alive() for thread in threads):
                look(self)
                self._wait()
                if self._failures:
                    self.stop("another service has failed")
        finally:
            self._clock.end()
        for name, failure in self._failures.items():
            if isinstance(failure, RelodError):
                raise failure
            raise ServiceError(f"{name}: unexpected {type(failure).__name__}: {failure}") from failure

    def stop(self, reason: str) -> None:
        """Let the run end early."""
        self.told_to_stop = self.told_to_stop or reason
        for service in self._services.values():
            if service.name == ROBOT_BRIDGE or self._failures:
                service.stop(reason)

    def _bridge_has_started(self) -> None:
        """Called before the other services start."""

    def _service(self, name: str, number: int) -> Service:
        run = self._configurations[name].run
        # Random numbers depend on the incarnation, so that a restart does not repeat them: here it has to be known.
        service = Service(name, run, self._network.transport_of(name, run), self._clock, incarnation=number)
        begun_s = time.monotonic()
        service.wall_s = lambda: time.monotonic() - begun_s
        return service

    def _serve(self, name: str) -> None:
        service = self._services[name]
        try:
            service.start()
            _serve_function(name)(service, self._configurations[name])
        except Exception as error:
            service.failure = f"{type(error).__name__}: {error}"
            self._failures[name] = error
            logger.exception("%s has failed", name)
        finally:
            service.close()

    def _wait(self, seconds: float = _LOOK_S) -> None:
        condition = self._clock.condition()
        with condition:
            self._clock.wait(condition, seconds)


class LockstepRun(InProcessRun):
    """Every action cycle waits for its action; the only delay is that of the answer."""

    def __init__(self, configurations: Mapping[str, Any]) -> None:
        clock = SimulatedClock()
        self._lockstep_network = SimulatedNetwork(clock)
        super().__init__(configurations, clock, self._lockstep_network)

    def _bridge_has_started(self) -> None:
        """An answer takes one action cycle of simulated time, so that heartbeat and record go by the robot's time."""
        client = self._lockstep_network.transport(self._configurations[ROBOT_BRIDGE].run)
        while not self._failures:
            if payload := client.query(topics.SPEC):
                spec = decode(payload, TaskSpec)
                self._lockstep_network.delays_ns[topics.ACTION.name] = round(spec.action_cycle_time_s * 1e9)
                return
            self._wait(0.01)


def _serve_function(name: str) -> Callable[[Service, Any], None]:
    """What ``python -m services.NAME`` runs."""
    match name:
        case "robot_bridge":
            from services.robot_bridge.__main__ import serve
        case "actor":
            from services.actor.__main__ import serve
        case "replay":
            from services.replay.__main__ import serve
        case _:
            from services.learner.__main__ import serve
    return serve
