"""A small task, and a bridge that keeps the truth: what the ring's tests compare against."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from common.messages import ActionSource, Experience, PolicyExtras, TaskSpec, TimeStep, UInt8Array

HEIGHT, WIDTH, CHANNELS, STACK = 6, 8, 3, 3
MARGIN_Y, MARGIN_X = 1, 2


def task_spec(camera: bool = True, action_size: int = 2, channels: int = CHANNELS) -> TaskSpec:
    """Return a task with 2 joints and, if asked for, a camera of 6 x 8 pixels, 3 frames stacked."""
    return TaskSpec(
        task="test",
        preset="demo",
        pacing="realtime",
        algorithm_presets={},
        action_low=np.full(action_size, -1, np.float32),
        action_high=np.full(action_size, 1, np.float32),
        proprioception_low=np.full(2, -1, np.float32),
        proprioception_high=np.full(2, 1, np.float32),
        frame_shape=np.array([HEIGHT, WIDTH, channels] if camera else [0, 0, 0]),
        frame_stack=STACK if camera else 0,
        crop_margin=np.array([MARGIN_Y, MARGIN_X] if camera else [0, 0]),
        action_cycle_time_s=0.04,
        world_seconds_per_cycle=0.04,
        time_limit_steps=50,
        reset_steps=0,
        has_goal=True,
    )


def frame_of(frame_id: int, channels: int = CHANNELS) -> UInt8Array:
    """Return the only frame (H, W, C) with this id: its id in all pixels, plus the pixel's own position."""
    position = np.arange(HEIGHT * WIDTH * channels).reshape(HEIGHT, WIDTH, channels)
    frame = (frame_id * 31 + position).astype(np.uint8)
    frame[..., 0] = frame_id % 256
    frame[0, :, 0] = frame_id // 256
    return frame


def crop_of(frame_ids: list[int], y: int = 0, x: int = 0, h: int = HEIGHT, w: int = WIDTH) -> UInt8Array:
    """Return the stacked, cropped observation (h, w, S * C) of these frames."""
    return np.concatenate([frame_of(i)[y : y + h, x : x + w] for i in frame_ids], axis=-1)


@dataclass
class Bridge:
    """Makes experiences and knows the right stack of each, computed the way a robot with a short queue would."""

    incarnation: int = 1
    camera: bool = True
    next_frame_id: int = 0
    experiences: list[Experience] = field(default_factory=list)
    stacks: dict[tuple[int, int], list[int]] = field(default_factory=dict)
    """(incarnation, seq) -> frame ids of the observation, oldest first."""

    def restart(self) -> None:
        """Start over as a new process would: everything counts from 0 again."""
        self.incarnation += 1
        self.next_frame_id = 0
        self.__post_init__()

    def __post_init__(self) -> None:
        self._seq = self._attempt = self._episode = -1
        self._step_index = 0
        self._stack: deque[int] = deque(maxlen=STACK)
        self._last: TimeStep | None = None

    def start(self, new: int = 1) -> Experience:
        """Return the first experience of an attempt."""
        if self._last is None or self._last.terminated:
            self._episode += 1
        self._attempt += 1
        self._step_index = 0
        newest = list(self._stack)[-1:]
        ids = self._new_ids(new)
        if self.camera:
            self._stack.extend([*ids, *newest][:1] * STACK)
            self._stack.extend(ids[1:])
        return self._make(ids)

    def step(self, new: int = 1, terminated: bool = False, truncated: bool = False) -> Experience:
        """Return the next experience of the attempt."""
        self._step_index += 1
        ids = self._new_ids(new)
        self._stack.extend(ids)
        return self._make(ids, terminated, truncated)

    def wander(self, rng: np.random.Generator, count: int, most_new: int = 2) -> list[Experience]:
        """Return ``count`` experiences of attempts that end at random, with 0 to ``most_new`` frames each."""
        made = []
        for _ in range(count):
            new = int(rng.integers(0, most_new, endpoint=True))
            ended = self._last is None or self._last.is_last
            if ended:
                made.append(self.start(new=max(new, 0 if self._stack else 1)))
            else:
                end = rng.random()
                made.append(self.step(new, terminated=end < 0.05, truncated=0.05 <= end < 0.1))
        return made

    def stack_of(self, experience: Experience) -> list[int]:
        """Return the frame ids of its observation."""
        return self.stacks[experience.time_step.incarnation, experience.time_step.seq]

    def _new_ids(self, new: int) -> list[int]:
        ids = list(range(self.next_frame_id, self.next_frame_id + new)) if self.camera else []
        self.next_frame_id += len(ids)
        return ids

    def _make(self, ids: list[int], terminated: bool = False, truncated: bool = False) -> Experience:
        self._seq += 1
        first = self._step_index == 0
        seq = self._seq
        shape = (HEIGHT, WIDTH, CHANNELS) if self.camera else (0, 0, 0)
        step = TimeStep(
            incarnation=self.incarnation,
            seq=seq,
            episode=self._episode,
            attempt=self._attempt,
            step_index=self._step_index,
            published_ns=1000 + seq,
            frame_ids=np.array(ids, np.int64),
            frame_capture_ns=np.array(ids, np.int64),
            frames=np.array([frame_of(i) for i in ids], np.uint8).reshape(len(ids), *shape),
            proprioception=np.array([seq, self.incarnation], np.float32),
            action=np.array([0, 0] if first else [seq / 1024, -seq / 1024], np.float32),
            action_source=ActionSource.NONE if first else ActionSource.POLICY,
            answered_seq=-1 if first else seq - 1,
            action_applied_ns=0 if first else 900 + seq,
            reward=0.0 if first else -0.5 * seq,
            terminated=terminated,
            truncated=truncated,
            steps=seq,
            acted_steps=seq,
        )
        extras = None if first else PolicyExtras(step.action * 2, -1.5, 7)
        self._last = step
        self.stacks[self.incarnation, seq] = list(self._stack)
        experience = Experience(actor_incarnation=5, seq=len(self.experiences), time_step=step, extras=extras)
        self.experiences.append(experience)
        return experience
