"""Every task of the table as a :class:`gymnasium.Env`, in lockstep: one action cycle a step, as fast as it computes.

``gymnasium.make("relod/DotReacher-v0")``; docs/gymnasium.md says what the spaces, resets and options mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from gymnasium import Env, spaces
from gymnasium.error import ClosedEnvironmentError, InvalidAction, ResetNeeded

from common.errors import ConfigError
from common.frame_stack import FrameStack
from common.messages import Float32Array, TaskSpec, UInt8Array
from common.policies.unit_range import action_range
from services.robot_bridge.bookkeeping import Ledger
from services.robot_bridge.gymnasium_ids import register_tasks
from services.robot_bridge.tasks import load_task

BOUNDS_FACTOR = 10.0
"""The observation's bounds are the task's proprioception range, this much wider about its middle. The range is what a
learner should expect, and values may leave it: a joint that turns freely does for much of a long attempt, and clipped
there it would no longer be known where the arm is."""
RESET_OPTIONS = ("new_goal",)

Observation = Float32Array | dict[str, Float32Array | UInt8Array]
"""(P,) for a task without camera, else ``frames`` (H, W, S * C) and ``proprioception`` (P,)."""
Info = dict[str, Any]


@dataclass(frozen=True)
class _StepIdentity:
    """What the frame stack wants to know of a time step; each attempt has a stack of its own."""

    seq: int
    step_index: int
    incarnation: int = 0
    attempt: int = 0


class TaskEnv(Env[Observation, Float32Array]):
    """A task, its world clock and its minimum-time bookkeeping behind Gymnasium's interface.

    Gymnasium's *episode*, reset to reset, is what this project calls an attempt; an episode here is goal to goal.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"]}

    def __init__(self, task: str, preset: str = "", render_mode: str | None = None, **settings: Any) -> None:
        """Args:
        task: task id, a key of the task table.
        preset: one of the task's presets; empty takes its default.
        render_mode: None or ``rgb_array``; a task without camera shows nothing and stays at None.
        settings: the task's settings that win over the preset's, e.g. ``time_limit=100``; tuples and arrays count as
            lists.

        Raises:
            ConfigError: unknown task, preset, setting or render mode, or a value out of range.
        """
        self._rng = np.random.default_rng()
        plain = {name: _plain(value) for name, value in settings.items()}
        self._task = load_task(task, preset, plain, pacing="lockstep", rng=self._rng)
        self.task_spec = self._task.spec
        """What the task is, in physical units."""
        if render_mode not in (None, *TaskEnv.metadata["render_modes"]):
            raise ConfigError(f"render_mode = {render_mode!r}: expected None or 'rgb_array'")
        has_camera = self.task_spec.has_camera
        # Some learners ask every environment for pictures, so without a camera there are none and no complaint.
        self.render_mode = render_mode if has_camera else None
        self.metadata = {
            "render_modes": TaskEnv.metadata["render_modes"] if has_camera else [],
            "render_fps": 1 / self.task_spec.action_cycle_time_s,
        }
        self.action_space = spaces.Box(-1.0, 1.0, self.task_spec.action_low.shape, np.float32)
        self.observation_space = _observation_space(self.task_spec)
        self._action_range = action_range(self.task_spec)
        self._cycle_ns = round(self.task_spec.action_cycle_time_s * 1e9)
        self._now_ns = 0
        self._task.advance_to(self._now_ns)
        self._ledger: Ledger | None = None
        """Of the running episode; None before the first reset."""
        self._needs_new_goal = True
        self._timed_out = False
        """True if the time limit ended the attempt: its reset takes the task's reset steps."""
        self._acting = False
        """True while the attempt has not ended."""
        self._closed = False
        self._stack: FrameStack[UInt8Array] | None = None
        self._newest_frame: UInt8Array | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, Info]:
        """Begin an attempt: at a new goal after a termination or with a seed, else at the same goal (thesis 6.1).

        Args:
            seed: of everything random from here on; draws a new goal.
            options: ``{"new_goal": True}`` draws a new goal, whatever the last attempt came to.

        Raises:
            ConfigError: unknown option.
        """
        self._refuse_if_closed()
        new_goal = _new_goal_asked_for(options or {})
        super().reset(seed=seed)
        if seed is not None:
            # The task was built with this generator and keeps it, so it is not replaced but set.
            self._rng.bit_generator.state = self.np_random.bit_generator.state
            self._task.renew()
        if self._ledger is None or self._needs_new_goal or new_goal or seed is not None:
            self._ledger = Ledger(self.task_spec)
            self._task.begin_episode()
            self._needs_new_goal = False
        else:
            if self._timed_out:
                self._let_the_reset_pass(self._ledger)
            self._task.begin_attempt()
        self._ledger.begin_attempt()
        self._timed_out = False
        self._acting = True
        if self.task_spec.has_camera:
            self._stack = FrameStack(self.task_spec.frame_stack)
        return self._observe(self._ledger), self._info(self._ledger, is_success=False)

    def step(self, action: Float32Array) -> tuple[Observation, float, bool, bool, Info]:
        """Let one action cycle pass under ``action``, (A,) in [-1, 1] of the task's bounds; beyond them it is clipped.

        Raises:
            ResetNeeded: there is no running attempt.
            InvalidAction: wrong shape, or not finite.
        """
        self._refuse_if_closed()
        if self._ledger is None or not self._acting:
            what = "has not begun" if self._ledger is None else "has ended"
            raise ResetNeeded(f"{self.task_spec.task}: the attempt {what}; call reset() before step()")
        self._task.command(self._physical(action))
        self._advance()
        outcome = self._task.outcome()
        truncated, episode = self._ledger.end_cycle(outcome.reward, outcome.terminated)
        self._timed_out = truncated
        self._acting = not (outcome.terminated or truncated)
        # A task without goal begins a new episode with each attempt.
        self._needs_new_goal = outcome.terminated or episode is not None
        info = self._info(self._ledger, is_success=outcome.terminated)
        return self._observe(self._ledger), float(outcome.reward), outcome.terminated, truncated, info

    def __reduce_ex__(self, protocol: Any) -> Any:
        # A simulator's world and its views of it would come apart, without a word.
        raise TypeError(f"{self.task_spec.task}: an environment cannot be copied or pickled: make another one")

    def render(self) -> UInt8Array | None:
        """Return the newest camera frame, (H, W, C); None without ``render_mode`` or before the first reset."""
        if self.render_mode is None or self._newest_frame is None:
            return None
        return self._newest_frame.copy()

    def close(self) -> None:
        """Let go of the task."""
        if not self._closed:
            self._task.close()
        self._closed = True

    def _advance(self) -> None:
        self._now_ns += self._cycle_ns
        self._task.advance_to(self._now_ns)

    def _let_the_reset_pass(self, ledger: Ledger) -> None:
        """Spend the action cycles that the reset after a time-out takes; nobody sees them but the count of steps."""
        self._task.stop()
        for _ in range(self.task_spec.reset_steps):
            self._advance()
            ledger.end_reset_cycle()

    def _physical(self, action: Any) -> Float32Array:
        shape = self.task_spec.action_low.shape
        try:
            unit = np.asarray(action)
            if np.iscomplexobj(unit):  # NumPy would drop the imaginary part with no more than a warning
                raise TypeError("complex")
            unit = unit.astype(np.float64)
        except (TypeError, ValueError) as error:
            raise InvalidAction(f"{self.task_spec.task}: expected numbers of shape {shape}, got {action!r}") from error
        if unit.shape != shape:
            raise InvalidAction(f"{self.task_spec.task}: expected an action of shape {shape}, got shape {unit.shape}")
        if not np.isfinite(unit).all():
            raise InvalidAction(f"{self.task_spec.task}: expected finite numbers in [-1, 1], got {unit}")
        physical = self._action_range.to_physical(np.clip(unit, -1.0, 1.0).astype(np.float32))
        clipped: Float32Array = np.clip(physical, self.task_spec.action_low, self.task_spec.action_high)
        return clipped

    def _observe(self, ledger: Ledger) -> Observation:
        """Read the sensors; every array is new, because those who store observations keep them."""
        reading = self._task.read()
        space = self.observation_space
        if isinstance(space, spaces.Box):
            return np.clip(reading.proprioception, space.low, space.high)
        assert self._stack is not None
        assert isinstance(space, spaces.Dict)
        identity = _StepIdentity(ledger.step_index, ledger.step_index)
        stack = self._stack.add(identity, reading.frame_ids.tolist(), list(reading.frames))
        if stack is None:
            raise ConfigError(f"{self.task_spec.task}: expected an attempt to begin with a camera frame, got none")
        self._newest_frame = stack.frames[-1]
        limits: Any = space["proprioception"]
        return {
            "frames": np.concatenate(stack.frames, axis=-1),
            "proprioception": np.clip(reading.proprioception, limits.low, limits.high),
        }

    def _info(self, ledger: Ledger, is_success: bool) -> Info:
        return {
            "is_success": is_success,
            "attempt": ledger.totals.attempts,
            "episode_steps": ledger.totals.steps,
        }

    def _refuse_if_closed(self) -> None:
        if self._closed:
            raise ClosedEnvironmentError(f"{self.task_spec.task} is closed; make a new one")


def _observation_space(spec: TaskSpec) -> spaces.Box | spaces.Dict:
    low, high = spec.proprioception_low, spec.proprioception_high
    middle, half = (high + low) / 2, BOUNDS_FACTOR * (high - low) / 2
    proprioception = spaces.Box(middle - half, middle + half, dtype=np.float32)
    if not spec.has_camera:
        return proprioception
    height, width, channels = (int(n) for n in spec.frame_shape)
    frames = spaces.Box(0, 255, (height, width, spec.frame_stack * channels), np.uint8)
    return spaces.Dict({"frames": frames, "proprioception": proprioception})


def _plain(value: Any) -> Any:
    """A setting as a configuration file gives it: without tuples, arrays and NumPy's numbers."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(element) for element in value]
    return value


def _new_goal_asked_for(options: dict[str, Any]) -> bool:
    unknown = [key for key in options if key not in RESET_OPTIONS]
    if unknown:
        raise ConfigError(f"reset(options={options!r}): unknown option {unknown[0]!r}; known: {RESET_OPTIONS[0]}")
    return bool(options.get("new_goal", False))


# `gymnasium.make("MODULE:ID")` asks of a module that its import registers what it has.
register_tasks()
