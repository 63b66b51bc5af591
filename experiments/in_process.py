"""The four services of one run in one process, each in a simulated thread."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from common import topics
from common.codec import decode
from common.errors import RelodError, ServiceError
from common.messages import TaskSpec
from common.run_settings import RunSettings
from common.service import Service
from common.topics import LEARNER, ROBOT_BRIDGE, SERVICES
from common.transport import Transport
from deploy.watch import OVERTIME_S
from experiments.simulation import SimulatedClock, SimulatedNetwork, SimulationEnded

logger = logging.getLogger(__name__)

_LOOK_S = 1.0
"""Simulated time between two looks at what is going on."""
CUT_OFF_S = 2 * OVERTIME_S
"""Longest simulated time that a run's end may take, seconds: services that have heard of it late need less."""
STANDSTILL_S = 3600.0
"""A robot that has made no step for so long, in simulated seconds, makes none any more: nobody comes to help."""
_ANSWER = "an answer"
"""What a robot waits for that names nothing else."""


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
        self.cut_off: str | None = None
        """Why the services were ended in the middle of what they did; None if they were not."""
        self.unheard: list[str] = []
        """Services that the network kept from hearing that the run is over, so that they had to be told."""
        self._end_ns: int | None = None
        """When the run began to end."""
        self._steps, self._stepped_ns = 0.0, clock.now_ns()
        """The bridge's count, and when it was last seen to change."""
        self._standstill: str | None = None
        self._services = {name: self._service(name, number) for number, name in enumerate(SERVICES, 1)}

    def run(self, look: Callable[[InProcessRun], None], hurried: Callable[[], bool] = lambda: False) -> None:
        """Run to the end.

        Args:
            look: called once in a while.
            hurried: asked all the time; once it says so the services are cut off, and leave what they have.

        Raises:
            RelodError: a service has failed, or the robot makes no steps any more; the others have been stopped.
        """
        self._clock.interrupted = hurried
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
                self._look_for_standstill()
                if self._is_overdue(threads):
                    self.cut_off = f"the end of the run has taken more than {CUT_OFF_S:.0f} s"
                    break
        except SimulationEnded:
            self.cut_off = "asked once more to stop"
        finally:
            self._clock.end()
        for name, failure in self._failures.items():
            if isinstance(failure, RelodError):
                raise failure
            raise ServiceError(f"{name}: unexpected {type(failure).__name__}: {failure}") from failure
        if self._standstill:
            raise ServiceError(self._standstill)

    def stop(self, reason: str) -> None:
        """Let the run end early."""
        self.told_to_stop = self.told_to_stop or reason
        for service in self._services.values():
            if service.name == ROBOT_BRIDGE or self._failures:
                service.stop(reason)

    def _bridge_has_started(self) -> None:
        """Called before the other services start."""

    def _look_for_standstill(self) -> None:
        """Stop a run that would never come to its end."""
        bridge, now_ns = self._services[ROBOT_BRIDGE], self._clock.now_ns()
        if (steps := bridge.counters().get("steps", 0.0)) != self._steps:
            self._steps, self._stepped_ns = steps, now_ns
        elif now_ns - self._stepped_ns > STANDSTILL_S * 1e9 and not self.told_to_stop:
            waits_for = bridge.details().get("waits_for") or _ANSWER
            self._standstill = (
                f"no step for {STANDSTILL_S:.0f} s of simulated time, at {steps:.0f} steps: the robot waits for "
                f"{waits_for}"
            )
            if any(what in waits_for for what in (_ANSWER, *SERVICES)):
                self._standstill += "; look whether the network carries anything"
            self.stop(self._standstill)

    def _is_overdue(self, threads: Sequence[threading.Thread]) -> bool:
        """Tell services that the run is over if the network does not; True once nobody may be waited for any more."""
        now_ns = self._clock.now_ns()
        if self._end_ns is None:
            if self.told_to_stop or not threads[0].is_alive():
                self._end_ns = now_ns
            return False
        if now_ns - self._end_ns > OVERTIME_S * 1e9:
            running = [self._services[thread.name] for thread in threads if thread.is_alive()]
            # The learner last, because the others' last data are for it.
            for service in sorted(running, key=lambda service: service.name == LEARNER):
                if service.name != ROBOT_BRIDGE and service.finished is None and not service.stopping.is_set():
                    self.unheard.append(service.name)
                    service.note = f"had not heard {OVERTIME_S:.0f} s later that the run is over, and was told to stop"
                    service.stop(service.note)
        return now_ns - self._end_ns > CUT_OFF_S * 1e9

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
            self._serve_to_the_end(service)
        except SimulationEnded:
            # Not closed: it would wait, for its heartbeat at least, and nobody can any more.
            service.failure = service.failure or f"cut off in state {service.state!r}: {self.cut_off}"
            service.close_record()
            raise

    def _serve_to_the_end(self, service: Service) -> None:
        try:
            service.start()
            _serve_function(service.name)(service, self._configurations[service.name])
        except Exception as error:
            service.failure = f"{type(error).__name__}: {error}"
            self._failures[service.name] = error
            logger.exception("%s has failed", service.name)
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
            from services.robot_bridge.serve import serve
        case "actor":
            from services.actor.__main__ import serve
        case "replay":
            from services.replay.__main__ import serve
        case _:
            from services.learner.__main__ import serve
    return serve
