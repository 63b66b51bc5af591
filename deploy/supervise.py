"""Starts the services of a run, notices who dies and who comes back, and stops them in order."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from common.record import read_parts
from common.topics import LEARNER, ROBOT_BRIDGE
from deploy.child import Child, LaunchedService, exit_text
from deploy.run_file import REPOSITORY

_LOOK_FOR_RETURN_S = 0.5
_POLL_S = 0.02
_KILLING_TAKES_S = 0.4
_EARLY_END_S = 3.0
"""At the end of a run the others may leave before the bridge; after this its part says whether it is the end."""


@dataclass(frozen=True)
class StopTimes:
    """When what happens after Ctrl-C, seconds; all processes have to be gone within 5."""

    rest_after_s: float = 1.5
    """The bridge stops the robot and tells the others that the run is over; who runs now is told by a signal."""
    kill_after_s: float = 4.5
    """Who runs now is killed. Whoever waits for one that hangs has given up by then, and closed its record."""


class Supervisor:
    """The four processes of a run."""

    def __init__(
        self,
        services: Iterable[LaunchedService],
        run_dir: Path,
        report: Callable[[str], None],
        run_has_begun: Callable[[], bool] = lambda: True,
        stop_times: StopTimes = StopTimes(),
    ) -> None:
        """Args:
        services: what to start.
        run_dir: folder of the run's record.
        report: tells the user at once.
        run_has_begun: True once the run has made a step; until then a service that fails has failed to start.
        stop_times: of :meth:`stop`.
        """
        self.children = {service.name: Child(service, run_dir) for service in services}
        self.cannot_start = False
        """A service failed before the run had begun: waiting for it makes no sense."""
        self._run_dir = run_dir
        self._report = report
        self._run_has_begun = run_has_begun
        self._stop_times = stop_times
        self._next_look_s = 0.0
        self._bridge_ended_s = 0.0
        self._seen_end: set[str] = set()
        self._left_early: dict[str, float] = {}
        self._seen_end_by_hand: set[int] = set()

    def start(self, asked_to_stop: Callable[[], bool] = lambda: False) -> None:
        """Start all services, unless asked to stop in between."""
        for child in self.children.values():
            if asked_to_stop():
                return
            child.start()

    @property
    def running(self) -> bool:
        """True while any service runs, whoever has started it."""
        return any(child.alive for child in self.children.values())

    @property
    def still_running(self) -> list[str]:
        """Services that run, whoever has started them."""
        return [child.name for child in self.children.values() if child.alive]

    def overdue(self, limit_s: float) -> bool:
        """True if the bridge ended well more than ``limit_s`` ago and somebody still runs."""
        bridge = self.children.get(ROBOT_BRIDGE)
        if bridge is None or not bridge.ended_well:
            return False
        self._bridge_ended_s = self._bridge_ended_s or time.monotonic()
        return time.monotonic() - self._bridge_ended_s > limit_s

    @property
    def failed(self) -> list[str]:
        """Services that died and never returned, or whose last incarnation failed."""
        return [child.name for child in self.children.values() if not child.ended_well]

    def check(self) -> None:
        """Report who has died and who has returned since the last call."""
        for child in self.children.values():
            code = child.exit_code
            if code is not None and child.name not in self._seen_end:
                self._seen_end.add(child.name)
                self._note_end(child, code)
        now_s = time.monotonic()
        for name in [name for name, due_s in self._left_early.items() if now_s >= due_s]:
            del self._left_early[name]
            self._note_early_end(self.children[name])
        if now_s >= self._next_look_s:
            self._next_look_s = now_s + _LOOK_FOR_RETURN_S
            for child in self.children.values():
                if child.name in self._seen_end:
                    self._look_for_return(child)

    def stop(self, begun_s: float) -> None:
        """Stop all services in order; ``begun_s`` is when the user asked for it, monotonic.

        First the bridge, which stops the robot and tells the others that the run is over. Then who is still there,
        the learner last, because the others' last data are for it. Then force.
        """
        bridge = self.children.get(ROBOT_BRIDGE)
        rest_s = begun_s  # unless the bridge tells them
        if bridge is not None and bridge.alive:
            if self._run_has_begun():
                rest_s += self._stop_times.rest_after_s
            bridge.signal(signal.SIGINT)
        self._wait_until(rest_s)
        for child in sorted(self.children.values(), key=lambda child: child.name == LEARNER):
            if child.name != ROBOT_BRIDGE:
                child.signal(signal.SIGINT)
        self._wait_until(begun_s + self._stop_times.kill_after_s)
        for child in self.children.values():
            if child.alive:
                self._report(f"{child.name} has not ended in time and is killed; its log: {child.console}")
                child.signal(signal.SIGKILL)
        self._wait_until(begun_s + self._stop_times.kill_after_s + _KILLING_TAKES_S)

    def _wait_until(self, deadline_s: float) -> None:
        while self.running and time.monotonic() < deadline_s:
            for child in self.children.values():
                if child.by_hand is not None:
                    child.newer_incarnation()  # refreshes what it says of itself
            time.sleep(_POLL_S)

    def _note_end(self, child: Child, code: int) -> None:
        if code == 0:
            if child.name != ROBOT_BRIDGE:
                self._left_early[child.name] = time.monotonic() + _EARLY_END_S
            return
        child.died = True
        lines = [f"{child.name} has died: {exit_text(code)}"]
        lines += [f"  {line}" for line in child.reason().splitlines() if code != -signal.SIGKILL]
        lines += [f"  log: {child.console}"]
        if code > 0 and not self._run_has_begun():
            self.cannot_start = True
            lines += ["  it could not start, so the run ends"]
        elif self._run_goes_on():
            lines += _how_to_return(child)
        else:
            lines += ["  the run is over: started again, it would find nobody"]
        self._report("\n".join(lines))

    def _run_goes_on(self) -> bool:
        """False once the bridge has ended well; one that died may return."""
        bridge = self.children.get(ROBOT_BRIDGE)
        return bridge is None or bridge.alive or not bridge.ended_well

    def _note_early_end(self, child: Child) -> None:
        """Somebody has asked a service to stop, which then ends with code 0, and the run goes on without it."""
        bridge = self.children.get(ROBOT_BRIDGE)
        parts = read_parts(self._run_dir, ROBOT_BRIDGE)
        if bridge is None or not bridge.alive or not parts or parts[-1].get("state") != "running":
            return
        child.died = True
        self._report("\n".join([f"{child.name} has ended before the run is over", *_how_to_return(child)]))

    def _look_for_return(self, child: Child) -> None:
        if child.newer_incarnation():
            assert child.by_hand is not None
            self._report(f"{child.name} has returned (process {child.by_hand.get('pid')})")
        part = child.by_hand
        if part is None or child.alive or part["incarnation"] in self._seen_end_by_hand:
            return
        self._seen_end_by_hand.add(part["incarnation"])
        if not child.ended_well:
            reason = part.get("failure") or "killed"
            self._report(f"{child.name} has died again: {reason}\n  {child.service.command_line()}")


def _how_to_return(child: Child) -> list[str]:
    return [f"  the others go on until Ctrl-C; start it again, in {REPOSITORY}:", f"  {child.service.command_line()}"]
