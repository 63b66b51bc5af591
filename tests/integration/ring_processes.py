"""Starts the four services as a user does, from configuration files that the launcher wrote."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from common import topics
from common.codec import decode
from common.config import load_config
from common.messages import TimeStep
from common.record import read_parts
from common.run_settings import TransportSettings
from common.topics import SERVICES
from common.transport import ZenohTransport
from services.robot_bridge.config import RobotBridgeConfig
from tests.helpers import free_port

ROOT = Path(__file__).parents[2]
START_S = 120.0
"""Longest wait for anything that includes importing torch on a busy machine."""
SMALL_AND_FAST = (
    "task.height=44",
    "task.width=60",
    "task.action_cycle_time=0.02",
    "task.time_limit=40",
    "task.reset_steps=3",
    "algorithm.min_size_to_sample=40",
    "algorithm.batch_size=8",
    "algorithm.hidden_size=32",
    "algorithm.replay_capacity=150",
    "algorithm.policy_push_interval=5",
)
"""Noise frames small enough that a run takes seconds and wraps the ring."""


def wait_until(condition: Callable[[], Any], what: str, limit_s: float = START_S) -> Any:
    """Poll until ``condition`` holds; fail with ``what`` if it never does."""
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        if result := condition():
            return result
        time.sleep(0.05)
    raise AssertionError(f"not within {limit_s:.0f} s: {what}")


class RingProcesses:
    """Four service processes of one run; ends what it started."""

    def __init__(self, folder: Path, task: str, *options: str) -> None:
        self.run_dir = folder / "run"
        self._configs = folder / "config"
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        command = [sys.executable, "-m", "deploy.launch", "local_only", "--task", task, "--run-dir", str(self.run_dir)]
        subprocess.run([*command, "--write-config", str(self._configs), *options], cwd=ROOT, check=True)

    def __enter__(self) -> RingProcesses:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes.values():
            if process.poll() is None:
                process.kill()
            process.wait()

    def start(self, service: str) -> None:
        """Type the service's command."""
        log = (self._configs / f"{service}.out").open("ab")
        self._processes[service] = subprocess.Popen(
            [sys.executable, "-m", f"services.{service}", "--config", str(self._configs / f"{service}.toml")],
            cwd=ROOT,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        )
        log.close()

    def interrupt(self, service: str) -> None:
        """Press Ctrl-C in the service's terminal."""
        self._processes[service].send_signal(signal.SIGINT)

    def kill(self, service: str) -> None:
        """End a service without a chance to say goodbye."""
        self._processes[service].kill()
        self._processes[service].wait()

    def wait(self, limit_s: float = START_S) -> dict[str, int]:
        """Wait until all have ended by themselves; return their exit codes."""
        wait_until(lambda: all(p.poll() is not None for p in self._processes.values()), "all services end", limit_s)
        return {name: process.returncode for name, process in self._processes.items()}

    def output(self, service: str) -> str:
        """What the service printed."""
        return (self._configs / f"{service}.out").read_text(errors="replace")

    def counter(self, service: str, name: str) -> float:
        """A count of the service's newest incarnation, as of its last part; -1 before there is one."""
        parts = self.parts(service)
        return float(parts[-1]["counters"].get(name, 0)) if parts else -1.0

    def parts(self, service: str) -> list[dict[str, Any]]:
        """What each incarnation of the service has left in the record."""
        return read_parts(self.run_dir, service)

    def incarnations(self, service: str) -> int:
        """How often the service has been started."""
        return len(self.parts(service))

    def listen_to_bridge(self) -> BridgeListener:
        """Hear what the running bridge publishes, beside the services."""
        return BridgeListener(self._configs / "robot_bridge.toml")

    def summary(self) -> dict[str, Any]:
        """The run's summary, made by the user's command."""
        subprocess.run([sys.executable, "-m", "deploy.summary", str(self.run_dir)], cwd=ROOT, check=True)
        summary: dict[str, Any] = json.loads((self.run_dir / "summary.json").read_text())
        return summary


class BridgeListener:
    """Numbers of the TimeSteps that went by, per incarnation of the bridge."""

    def __init__(self, config: Path) -> None:
        settings = load_config(RobotBridgeConfig, config)
        bridge = settings.transport
        endpoints = TransportSettings(
            listen_real_time=f"tcp/127.0.0.1:{free_port()}",
            listen_bulk=f"tcp/127.0.0.1:{free_port()}",
            connect_real_time=[bridge.listen_real_time],
            connect_bulk=[bridge.listen_bulk],
        )
        self._heard_s = time.monotonic()
        self.heard: defaultdict[int, set[int]] = defaultdict(set)
        self._transport = ZenohTransport(settings.run, endpoints)
        for topic in (topics.TIME_STEP, topics.TIME_STEP_RESENT):
            self._transport.subscribe(topic, self._hear)

    def __enter__(self) -> BridgeListener:
        return self

    def __exit__(self, *_: object) -> None:
        self._transport.close()

    def _hear(self, payload: bytes) -> None:
        time_step = decode(payload, TimeStep)
        self.heard[time_step.incarnation].add(time_step.seq)
        self._heard_s = time.monotonic()

    @property
    def quiet_for_s(self) -> float:
        """Seconds since the last TimeStep."""
        return time.monotonic() - self._heard_s


def start_all(ring: RingProcesses, order: tuple[str, ...] = SERVICES) -> None:
    """Start the four services one after the other."""
    for service in order:
        ring.start(service)


def options(*settings: str) -> list[str]:
    """Command-line options for settings."""
    return [text for setting in settings for text in ("--set", setting)]
