"""From the bridge's configuration to the task, its camera and the action cycle."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from common import topics
from common.errors import ConfigError
from common.priority import BRIDGE_PRIORITY, run_before_others
from common.record import read_parts, settle_parts, unreadable_parts
from common.service import Service
from common.surviving_counts import SurvivingCounts
from services.robot_bridge.bookkeeping import Totals
from services.robot_bridge.bridge import SURVIVING_COUNTS, RobotBridge
from services.robot_bridge.cameras import Camera, PictureSize, open_camera
from services.robot_bridge.config import RobotBridgeConfig
from services.robot_bridge.tasks import Task, load_task

logger = logging.getLogger(__name__)


def serve(service: Service, config: RobotBridgeConfig) -> None:
    """Build the task and run the bridge."""
    settings = config.robot_bridge
    settle_parts(Path(config.run.directory))
    totals, latched = _earlier(Path(config.run.directory))
    task = load_task(
        config.task.name,
        config.task.preset,
        config.task.overrides,
        config.tasks.rows,
        pacing=settings.pacing,
        # A restarted bridge must not repeat the starts of the one before.
        rng=np.random.default_rng([config.run.seed, totals.attempts]),
    )
    _give_camera(task, config, service)
    surviving_counts = SurvivingCounts(topics.ROBOT_BRIDGE, service.incarnation, SURVIVING_COUNTS)
    service.closing.callback(surviving_counts.close)
    bridge = RobotBridge(service, task, settings, totals, latched, surviving_counts)
    service.write_record()  # before the first count: whoever reads it must know where it is
    if settings.real_time_priority and settings.pacing == "realtime":
        logger.info("%s", run_before_others(BRIDGE_PRIORITY))
    bridge.run()


def _give_camera(task: Task, config: RobotBridgeConfig, service: Service) -> None:
    """Open the camera that is configured, if one is, and let the task see through it."""
    if not config.camera.name:
        return
    if config.robot_bridge.pacing != "realtime":
        raise ConfigError(
            f"[camera] name = {config.camera.name!r}: expected robot_bridge.pacing = realtime, got "
            f"{config.robot_bridge.pacing}; a camera's time does not wait for answers"
        )

    def opened(size: PictureSize) -> Camera:
        choice = config.camera
        camera = open_camera(choice.name, choice.overrides, config.cameras.rows, size=size, clock=service.clock)
        service.closing.callback(camera.close)
        return camera

    task.use_camera(opened)


def _earlier(directory: Path) -> tuple[Totals, str | None]:
    """What the last incarnation of this run's bridge has left: its counts, and an emergency stop in force."""
    for path in unreadable_parts(directory, topics.ROBOT_BRIDGE):
        logger.warning("%s is empty or damaged: what that robot_bridge of this run has counted is unknown", path)
    # A bridge that has not come as far as its task, as this one, has written a part without counts.
    parts = [part for part in read_parts(directory, topics.ROBOT_BRIDGE) if "steps" in part.get("counters", {})]
    if not parts:
        return Totals(), None
    counters = parts[-1]["counters"]
    names = ("steps", "acted_steps", "episodes", "attempts")
    totals = Totals(**{name: int(counters.get(name, 0)) for name in names})
    logger.warning("this run has had a robot_bridge before: going on from step %d", totals.steps)
    latched = "e_stop" if parts[-1].get("latched") == "e_stop" else None
    return totals, latched
