"""What the bridge asks of a task: a world that goes on by itself, and what is rewarded in it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from common.clock import Clock
from common.errors import ConfigError
from common.messages import Float32Array, Int64Array, TaskSpec, UInt8Array
from services.robot_bridge.cameras.base import Camera, PictureSize


@dataclass(frozen=True)
class SensorReading:
    """What the robot's sensors show now."""

    frames: UInt8Array
    """(k, H, W, C): camera frames that are new since the reading before, oldest first."""
    frame_ids: Int64Array
    """(k,): consecutive over the task's lifetime; a gap is frames that were lost."""
    frame_capture_ns: Int64Array
    """(k,): capture times on the clock given to :meth:`Task.advance_to`."""
    proprioception: Float32Array
    """(P,), physical units."""

    def without_old_frames(self) -> SensorReading:
        """The same with the newest camera frame alone, if there is any."""
        return replace(
            self,
            frames=self.frames[-1:],
            frame_ids=self.frame_ids[-1:],
            frame_capture_ns=self.frame_capture_ns[-1:],
        )


@dataclass(frozen=True)
class Outcome:
    """Reward and termination of the action cycle that has just ended."""

    reward: float
    terminated: bool


class Task(ABC):
    """A robot, its surroundings and a goal.

    The world never pauses: whoever uses a task tells it the time by :meth:`advance_to`, and the robot goes on with
    its last command until then. In real time that time is the computer's clock, in lockstep it moves by one action
    cycle per step; the task does not know which.
    """

    SETTINGS: ClassVar[type]
    """Dataclass of the task's settings (:func:`common.config.setting`), the keys of ``[task]``."""
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]]
    """Preset name -> settings that differ from the defaults; the first is the task's default preset."""

    spec: TaskSpec

    @abstractmethod
    def __init__(self, settings: Any, *, name: str, preset: str, pacing: str, rng: np.random.Generator) -> None:
        """Build the world; ``name``, ``preset`` and ``pacing`` go into the TaskSpec, ``rng`` is all randomness."""

    def start(self, clock: Clock) -> None:  # noqa: B027 - most worlds need nothing
        """In real time, once, before all else: a world may go on by ``clock`` in threads of its own from now on.

        In lockstep nobody calls it. What a command or a time means is the same either way.
        """

    def renew(self) -> None:  # noqa: B027 - most worlds begin anew with each episode
        """Let the next episode follow from the randomness alone, whatever was before, as in a world just built."""

    @abstractmethod
    def begin_episode(self) -> None:
        """Draw a new goal and put the robot at a random start."""

    @abstractmethod
    def begin_attempt(self) -> None:
        """Keep the goal and move the robot to a random state (thesis 6.1)."""

    @abstractmethod
    def command(self, action: Float32Array) -> None:
        """Give the robot a command, (A,) physical units inside the bounds; it takes effect now and stays."""

    @abstractmethod
    def stop(self) -> None:
        """Bring the robot to rest, as the watchdog does."""

    @abstractmethod
    def advance_to(self, now_ns: int) -> None:
        """Let the world go on until ``now_ns``; the first call only sets its clock."""

    @abstractmethod
    def read(self) -> SensorReading:
        """Read the sensors at the time of the last :meth:`advance_to`."""

    @abstractmethod
    def outcome(self) -> Outcome:
        """Judge the cycle that ended at the last :meth:`advance_to`."""

    def use_camera(self, open_camera: Callable[[PictureSize], Camera]) -> None:
        """See through a camera, opened with the size of the spec's frames, from now on; the task closes it.

        Raises:
            ConfigError: the task draws its frames itself, or has none.
            CameraError: the camera cannot be used.
        """
        own = "draws its frames itself" if self.spec.has_camera else "has no camera"
        raise ConfigError(f"[camera]: {self.spec.task} {own}; expected no camera, leave [camera] empty")

    def newest_frame_ns(self) -> int | None:
        """When the newest camera frame was taken, on the clock of :meth:`advance_to`, whether it has been read or not.

        The bridge truncates an attempt whose frames are too old. None: there is no camera that could stall.
        """
        return None

    def give_up(self) -> None:  # noqa: B027 - most worlds never wait
        """Let whoever waits for the world, as for an attempt's first frame, wait no longer: the run ends.

        Called by any thread; must not wait itself.
        """

    def counters(self) -> dict[str, float]:
        """Counts of the task's own, for the bridge's status and the record; they may be asked for by any thread."""
        return {}

    def close(self) -> None:
        """Let go of the robot."""
        self.stop()
