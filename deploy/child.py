"""One service's process, as the launcher sees it: started by the launcher, and perhaps again by hand."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from common.record import read_parts
from deploy.parts import Part
from deploy.run_file import REPOSITORY

FRESH_S = 3.0
"""A part that was written this long ago, three of its periods, belongs to a process that lives."""
_TAIL_LINES = 6
TIED_COMMAND = Path(__file__).resolve().with_name("tied_command.py")
"""Program that ties the process which it becomes to the one that started it."""


@dataclass(frozen=True)
class LaunchedService:
    """What to start."""

    name: str
    command: tuple[str, ...]
    """Program and arguments, with whatever takes it to its host."""
    environment: Mapping[str, str] = field(default_factory=dict)
    """Variables set beside those of the launcher."""

    def command_line(self) -> str:
        """What to type to start it by hand, in the repository's root."""
        variables = ["env", *(f"{name}={value}" for name, value in self.environment.items())]
        return shlex.join([*(variables if self.environment else []), *self.command])


class Child:
    """A service's process; its console goes to ``RUN_DIR/logs/NAME.console.log``."""

    def __init__(self, service: LaunchedService, run_dir: Path) -> None:
        self.service = service
        self.console = run_dir / "logs" / f"{service.name}.console.log"
        self.died = False
        """It ended by itself, and not as it should."""
        self.by_hand: Part | None = None
        """Newest part of the incarnation that somebody else started after this one had ended."""
        self._run_dir = run_dir
        self._process: subprocess.Popen[bytes] | None = None
        self._started_ns = 0

    @property
    def name(self) -> str:
        """The service's."""
        return self.service.name

    def start(self) -> None:
        """Start the service's command; it ends with the thread that calls this, at the latest."""
        self.console.parent.mkdir(parents=True, exist_ok=True)
        self._started_ns = time.time_ns()
        # -S -E: nothing but the standard library is needed before it becomes the command.
        tied = [sys.executable, "-S", "-E", str(TIED_COMMAND), str(os.getpid())]
        with self.console.open("ab") as console:
            self._process = subprocess.Popen(
                [*tied, *self.service.command],
                stdin=subprocess.DEVNULL,
                stdout=console,
                stderr=subprocess.STDOUT,
                env={**os.environ, **self.service.environment},
                cwd=REPOSITORY,
                # Ctrl-C in the launcher's terminal must reach the launcher only: there is an order to keep.
                start_new_session=True,
            )

    @property
    def exit_code(self) -> int | None:
        """Of the launched process, -N if signal N killed it; None while it runs or was never started."""
        return self._process.poll() if self._process else None

    @property
    def launched_is_alive(self) -> bool:
        """True while the process that the launcher started runs."""
        return self._process is not None and self._process.poll() is None

    @property
    def alive(self) -> bool:
        """True while the launched process or its successor by hand runs."""
        return self.launched_is_alive or self._by_hand_is_alive()

    @property
    def ended_well(self) -> bool:
        """True if it has ended, and its last incarnation as it should."""
        if self.alive:
            return False
        if self.by_hand is not None:
            self.newer_incarnation()  # its last word may have come since the last look
            return self.by_hand.get("state") == "stopped" and self.by_hand.get("failure") is None
        return not self.died

    def newer_incarnation(self) -> bool:
        """Look for a living successor that somebody has started by hand; True if one is new."""
        parts = read_parts(self._run_dir, self.name)
        if not parts or int(parts[-1]["incarnation"]) < self._started_ns:
            return False
        newest = parts[-1]
        if self._process is not None and newest.get("pid") == self._process.pid:
            return False
        known = self.by_hand
        if known is not None and known["incarnation"] == newest["incarnation"]:
            self.by_hand = newest
            return False
        if self._part_age_s(newest) > FRESH_S:
            return False
        self.by_hand = newest
        return True

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to whichever process runs the service now; SIGKILL to what it has started too."""
        if self.launched_is_alive:
            assert self._process is not None
            if number is signal.SIGKILL:
                os.killpg(self._process.pid, number)
            else:
                self._process.send_signal(number)
        elif self.by_hand is not None and self._by_hand_is_alive():
            os.kill(int(self.by_hand["pid"]), number)

    def reason(self) -> str:
        """Why the launched process ended: its part's word, or else the end of what it printed."""
        for part in read_parts(self._run_dir, self.name):
            if self._process is not None and part.get("pid") == self._process.pid and part.get("failure"):
                return str(part["failure"])
        try:
            lines = self.console.read_text(encoding="utf-8", errors="replace").rstrip().splitlines()
        except OSError:
            lines = []
        return "\n".join(lines[-_TAIL_LINES:])

    def _by_hand_is_alive(self) -> bool:
        part = self.by_hand
        if part is None or part.get("state") == "stopped":
            return False
        return _is_running(int(part["pid"]))

    def _part_age_s(self, part: Part) -> float:
        path = self._run_dir / "parts" / f"{self.name}-{part['incarnation']}.json"
        try:
            return time.time() - path.stat().st_mtime
        except OSError:
            return float("inf")


def exit_text(code: int) -> str:
    """An exit code in words."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"killed by signal {-code}"


def _is_running(pid: int) -> bool:
    """True if the process exists and is not only waiting for its parent to notice its end."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    return stat.rpartition(")")[2].split()[0] not in ("Z", "X")
