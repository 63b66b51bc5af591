"""Running services are watched to their end: who dies, how far they are, Ctrl-C, and why a run has to end early."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from common.console import Console
from common.service import DRAIN_TIMEOUT_S
from common.stop_signals import StopSignals
from deploy.child import LaunchedService
from deploy.curve import load_drawing
from deploy.progress import ProgressReader, progress_line
from deploy.supervise import Supervisor

OVERTIME_S = DRAIN_TIMEOUT_S + 10.0
"""Longest time that the others may need after the bridge has ended; then the network has kept its word from them."""
_POLL_S = 0.05
_PROGRESS_S = 1.0
_CURVE_UNTIL_S = 4.0
"""After Ctrl-C: from here on there is no time left to wait for the drawing library."""


@dataclass(frozen=True)
class EarlyEnd:
    """Why the services have to end before they do so by themselves."""

    reason: str
    is_failure: bool = True


class Drawing:
    """Loads what the learning curve is drawn with while the run is going on, so that its end is not delayed."""

    def __init__(self) -> None:
        self._thread = threading.Thread(target=self._load, name="load drawing", daemon=True)

    def start(self) -> None:
        """Begin to load; before this the launcher has one thread, and can start processes without harm."""
        self._thread.start()

    def is_loaded(self, stop: StopSignals) -> bool:
        """Wait until it is; after Ctrl-C only as long as there is time."""
        if self._thread.ident is None:  # never begun: whoever draws loads for himself
            return True
        left_s = None if stop.asked_s is None else max(0.0, stop.asked_s + _CURVE_UNTIL_S - time.monotonic())
        self._thread.join(left_s)
        return not self._thread.is_alive()

    def _load(self) -> None:
        # The run comes first.
        thread = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, thread, max(10, os.getpriority(os.PRIO_PROCESS, thread)))
        load_drawing()


def watch(
    services: Sequence[LaunchedService],
    reader: ProgressReader,
    run_dir: Path,
    drawing: Drawing,
    stop: StopSignals,
    console: Console,
    *,
    early_end: Callable[[], EarlyEnd | None],
    report: Callable[[str], None],
) -> list[str]:
    """Run the services to their end; return what has not gone well, a line each.

    Args:
        services: what to start.
        reader: of the run's progress.
        run_dir: folder of the run's record.
        drawing: is loaded meanwhile.
        stop: ends the services.
        console: where the progress is shown.
        early_end: asked over and over whether the services have to end.
        report: told of services that die and return.
    """
    supervisor = Supervisor(services, run_dir, report, run_has_begun=lambda: reader.read().steps > 0)
    end: EarlyEnd | None = None
    try:
        supervisor.start(lambda: stop.asked)
        drawing.start()
        next_progress_s = time.monotonic()
        while supervisor.running and not stop.asked and not supervisor.cannot_start:
            supervisor.check()
            if end := early_end():
                console.error(end.reason)
                break
            if time.monotonic() >= next_progress_s:
                next_progress_s = time.monotonic() + _PROGRESS_S
                console.status(progress_line(reader.read()))
            if supervisor.overdue(OVERTIME_S):
                end = EarlyEnd(
                    f"{' and '.join(supervisor.still_running)} did not end within {OVERTIME_S:.0f} s after the "
                    "robot_bridge: the network has kept from them that the run is over, or they had not yet begun"
                )
                console.error(end.reason)
                break
            time.sleep(_POLL_S)
        if not stop.asked:
            supervisor.check()
    finally:
        # Also when this program has an error: nothing may be left running.
        if supervisor.running:
            asked_s = stop.asked_s if stop.asked_s is not None else time.monotonic()
            console.line("stopping the services")
            supervisor.stop(asked_s)
    console.line(progress_line(reader.read()))
    failures = [f"not well at the end: {', '.join(supervisor.failed)}"] if supervisor.failed else []
    if failures and not stop.asked:
        console.error(failures[0])
    if end and end.is_failure:
        failures.append(end.reason)
    return failures
