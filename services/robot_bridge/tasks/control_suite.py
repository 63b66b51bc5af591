"""What the minimum-time tasks made from the DeepMind Control Suite have in common (thesis 6.2.1, 7.1).

Models, starts and success are dm_control's own. What differs is the formulation: -1 a step, an episode ends only where
dm_control's sparse reward is 1, and a time-out moves the agent only (thesis 6.1). As in dm_control, a start may lie at
the goal: the hits at the shortest time limits are such starts.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from common.config import setting
from common.messages import Float32Array, TaskSpec
from services.robot_bridge.rendering import OffscreenCamera, Window
from services.robot_bridge.robots.mujoco_world import MujocoWorld, load_suite_model
from services.robot_bridge.tasks.base import Outcome, SensorReading, Task

WORLD_NS_PER_CYCLE = 20_000_000
"""dm_control's control step; an action cycle of 40 ms therefore runs at half speed."""
LONGEST_GAP_CYCLES = 250
"""A longer gap between two looks at the clock, as after a suspended computer, counts as this many cycles: the world
would be at rest or anywhere by then, and catching up must not take long (some 10 ms)."""
FRAME_STACK = 3
"""Thesis 6.2.1 and 7.1."""


@dataclass(frozen=True)
class ControlSuiteSettings:
    """Keys of ``[task]``."""

    time_limit: int = setting(50, low=1)
    """Action cycles before the agent is reset."""
    reset_steps: int = setting(20, low=0)
    """Action cycles that a reset takes."""
    action_cycle_time: float = setting(0.04, low=0.001, high=10.0)
    """Seconds; the world goes on by 20 ms in it, whatever its length."""


class ControlSuiteTask(Task):
    """A task on one model of the suite; a subclass says what is drawn, observed and sought.

    A subclass with a :attr:`WINDOW` has a camera: one frame per reading, rendered when it is read.
    """

    SETTINGS = ControlSuiteSettings
    MODEL: ClassVar[str]
    """Name of the model's file in dm_control's suite."""
    ALGORITHM_PRESET: ClassVar[str]
    WINDOW: ClassVar[Window | None] = None
    """What is seen of dm_control's default picture; None without camera."""

    def __init__(
        self, settings: ControlSuiteSettings, *, name: str, preset: str, pacing: str, rng: np.random.Generator
    ) -> None:
        self._rng = rng
        self._world = MujocoWorld(load_suite_model(self.MODEL))
        self._camera: OffscreenCamera | None = None
        self._next_frame_id = 0
        self._now_ns: int | None = None
        self._cycle_ns = round(settings.action_cycle_time * 1e9)
        self._owed = 0
        """World time not yet lived through, ns times :attr:`_cycle_ns`: whole numbers, so no time is ever lost."""
        self._prepare_model()
        self.begin_episode()
        self.spec = self._describe(settings, name, preset, pacing)

    # ------------------------------------------------------------------ what a subclass says

    @abstractmethod
    def _draw_goal(self) -> None:
        """Choose a new goal."""

    @abstractmethod
    def _place_agent(self) -> None:
        """Reset the world to random joint positions, distributed as in dm_control, and leave the goal."""

    @abstractmethod
    def _at_goal(self) -> bool:
        """True where dm_control's sparse reward is 1."""

    @abstractmethod
    def _proprioception(self) -> np.ndarray:
        """Return what is observed besides the frames, (P,)."""

    @abstractmethod
    def _proprioception_limits(self) -> np.ndarray:
        """Return the largest magnitudes (P,) that the learner should expect."""

    def _prepare_model(self) -> None:
        """Change the model before the first reset."""

    # ------------------------------------------------------------------ the task

    def begin_episode(self) -> None:
        self._draw_goal()
        self.begin_attempt()

    def begin_attempt(self) -> None:
        self._place_agent()

    def command(self, action: Float32Array) -> None:
        self._world.command(action)

    def stop(self) -> None:
        self._world.stop()

    def advance_to(self, now_ns: int) -> None:
        if self._now_ns is None:
            self._now_ns = now_ns
        elapsed_ns = now_ns - self._now_ns
        if elapsed_ns <= 0:  # a clock never runs back
            return
        self._now_ns = now_ns
        self._owed += min(elapsed_ns, LONGEST_GAP_CYCLES * self._cycle_ns) * WORLD_NS_PER_CYCLE
        world_ns, self._owed = divmod(self._owed, self._cycle_ns)
        self._world.advance(world_ns)

    def read(self) -> SensorReading:
        proprioception = self._proprioception().astype(np.float32)
        if self.WINDOW is None:
            return SensorReading(
                frames=np.zeros((0, 0, 0, 0), np.uint8),
                frame_ids=np.zeros(0, np.int64),
                frame_capture_ns=np.zeros(0, np.int64),
                proprioception=proprioception,
            )
        if self._camera is None:  # Not before: a world that nobody looks at needs no OpenGL.
            self._camera = OffscreenCamera(self._world.model, self.WINDOW)
        frame_id = self._next_frame_id
        self._next_frame_id += 1
        return SensorReading(
            frames=self._camera.picture(self._world.data)[None],
            frame_ids=np.array([frame_id], np.int64),
            frame_capture_ns=np.array([self._now_ns or 0], np.int64),
            proprioception=proprioception,
        )

    def outcome(self) -> Outcome:
        return Outcome(reward=-1.0, terminated=self._at_goal())

    def close(self) -> None:
        super().close()
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def _describe(self, settings: ControlSuiteSettings, name: str, preset: str, pacing: str) -> TaskSpec:
        limits = self._proprioception_limits().astype(np.float32)
        window = self.WINDOW
        frame_shape = (window.height, window.width, 3) if window else (0, 0, 0)
        return TaskSpec(
            task=name,
            preset=preset,
            pacing=pacing,
            algorithm_presets={"sac": self.ALGORITHM_PRESET, "ppo": self.ALGORITHM_PRESET},
            action_low=self._world.model.actuator_ctrlrange[:, 0].astype(np.float32),
            action_high=self._world.model.actuator_ctrlrange[:, 1].astype(np.float32),
            proprioception_low=-limits,
            proprioception_high=limits,
            frame_shape=np.array(frame_shape, np.int64),
            frame_stack=FRAME_STACK if window else 0,
            crop_margin=np.array(frame_shape[:2], np.int64) // 10,  # thesis 3.6
            action_cycle_time_s=settings.action_cycle_time,
            world_seconds_per_cycle=WORLD_NS_PER_CYCLE * 1e-9,
            time_limit_steps=settings.time_limit,
            reset_steps=settings.reset_steps,
            has_goal=True,
        )
