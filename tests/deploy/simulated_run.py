"""Bridge and actor in simulated time, each with a clock of its own, over a link whose delays are known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common import topics
from common.clock import SkewedClock
from common.policies import ChosenAction
from common.run_settings import RunSettings
from common.service import Service
from experiments.simulation import SimulatedClock, SimulatedNetwork
from services.actor.actor import Actor
from services.actor.config import ActorSettings
from services.robot_bridge.bookkeeping import Totals
from services.robot_bridge.bridge import RobotBridge
from services.robot_bridge.config import RobotBridgeSettings
from services.robot_bridge.tasks.base import SensorReading
from services.robot_bridge.tasks.noise_frames import NoiseFrames, NoiseFramesSettings

MS = 1_000_000
CAMERA_MS = 7.0
"""Age of a frame when it is read."""
INFERENCE_MS = 5.0
"""Time that the policy takes."""


class SlowCamera(NoiseFrames):
    """Frames that were taken a while before they are read."""

    def read(self) -> SensorReading:
        reading = super().read()
        return SensorReading(
            frames=reading.frames,
            frame_ids=reading.frame_ids,
            frame_capture_ns=reading.frame_capture_ns - round(CAMERA_MS * MS),
            proprioception=reading.proprioception,
        )


class SlowPolicy:
    """Takes its time on a clock."""

    version = 0

    def __init__(self, clock: SimulatedClock) -> None:
        self._clock = clock

    def act(self, observation, rng, deterministic=False) -> ChosenAction:
        self._clock.wait_until(self._clock.now_ns() + round(INFERENCE_MS * MS), self._clock.condition())
        return ChosenAction(np.zeros(2, np.float32), 0.0)


@dataclass
class Hosts:
    """What a test looks at, and what it may do to the clocks, while the run goes on."""

    clock: SimulatedClock
    bridge: RobotBridge
    bridge_clock: SkewedClock
    actor_clock: SkewedClock
    actor_service: Service


def simulate(
    run_dir: Path,
    seconds: float,
    uplink_ms: float,
    downlink_ms: float,
    *,
    jitter_ms: float = 1.0,
    offset_s: float = 3.0,
    drift_ppm: float = 50.0,
    events: dict[float, Callable[[Hosts], None]] | None = None,
) -> Hosts:
    """Run for a while and leave the record; messages take their way's time, give or take the jitter."""
    clock = SimulatedClock()
    network = SimulatedNetwork(clock)
    rng = np.random.default_rng(0)

    def way(mean_ms: float) -> Callable[[], int]:
        return lambda: round(rng.uniform(mean_ms - jitter_ms, mean_ms + jitter_ms) * MS)

    network.delays_ns = {
        topics.TIME_STEP.name: way(uplink_ms),
        topics.ACTION.name: way(downlink_ms),
        topics.CLOCK.name: way(uplink_ms),  # the bridge's answer
    }
    network.question_delays_ns = {topics.CLOCK.name: way(downlink_ms)}
    run = RunSettings(id="test", directory=str(run_dir))
    bridge_clock, actor_clock = SkewedClock(clock), SkewedClock(clock, offset_s, drift_ppm)
    clocks = {topics.ROBOT_BRIDGE: bridge_clock, topics.ACTOR: actor_clock, topics.REPLAY: clock}
    services = {
        name: Service(name, run, network.transport(run), clocks[name], incarnation=number)
        for number, name in enumerate(clocks, 1)
    }
    task = SlowCamera(
        NoiseFramesSettings(height=8, width=8), name="noise", preset="demo", pacing="realtime", rng=rng.spawn(1)[0]
    )
    bridge = RobotBridge(services[topics.ROBOT_BRIDGE], task, RobotBridgeSettings(steps=10**6), Totals())
    actor = Actor(services[topics.ACTOR], task.spec, SlowPolicy(clock), ActorSettings())
    hosts = Hosts(clock, bridge, bridge_clock, actor_clock, services[topics.ACTOR])
    for service in services.values():
        service.start()
    services[topics.REPLAY].state = "running"
    begun_ns = clock.now_ns()
    try:
        for name, act in (("bridge", bridge.run), ("actor", actor.run)):
            clock.thread(act, name).start()
        for at_s, event in {**(events or {}), seconds: lambda _: None}.items():
            clock.wait_until(begun_ns + round(at_s * 1e9), clock.condition())
            event(hosts)
    finally:
        for service in services.values():
            service.record.close(timeout_s=60.0)
        clock.end()
    return hosts
