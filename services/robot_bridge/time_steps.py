"""TimeSteps out, numbered and retained until the actor has them; and what led into each of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from common import topics
from common.codec import encode
from common.errors import ConfigError, ServiceError
from common.frame_encoding import JPEG_CHANNELS, FrameEncoding, encode_frames
from common.journal import JournalSender
from common.messages import ActionSource, Float32Array, TaskSpec, TimeStep
from common.service import Service
from services.robot_bridge.bookkeeping import CycleCounts, Ledger
from services.robot_bridge.config import RobotBridgeSettings
from services.robot_bridge.tasks.base import SensorReading

_LARGEST_REWARD = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class CommandInForce:
    """The robot's command and where it came from."""

    action: Float32Array
    source: ActionSource
    answered_seq: int
    applied_ns: int


def announced_spec(spec: TaskSpec, encoding: str) -> TaskSpec:
    """Return what the bridge tells its peers of a task whose frames travel in ``encoding``.

    Raises:
        ConfigError: the task's frames cannot be encoded so.
    """
    if not spec.has_camera:
        return spec
    channels = spec.dimensions.C
    if encoding == FrameEncoding.JPEG444 and channels != JPEG_CHANNELS:
        raise ConfigError(
            f"robot_bridge.encoding = {encoding}: expected a task with frames of {JPEG_CHANNELS} channels, "
            f"{spec.task} has {channels}; choose zstd or raw"
        )
    return replace(spec, frame_encoding=FrameEncoding(encoding))


class TimeStepStream:
    """Builds, numbers and publishes the TimeSteps of this incarnation."""

    def __init__(self, service: Service, spec: TaskSpec, settings: RobotBridgeSettings, counts: CycleCounts) -> None:
        self._service, self._counts = service, counts
        self._dimensions, self._encoding = spec.dimensions, spec.frame_encoding
        self._payload = b""
        self.sent_ns = 0
        """When the newest TimeStep was encoded and given to the network."""
        self.journal = JournalSender(
            service.transport,
            service.incarnation,
            settings,
            topic=topics.TIME_STEP,
            resent=topics.TIME_STEP_RESENT,
            head=topics.TIME_STEP_HEAD,
            acknowledgement=topics.TIME_STEP_ACK,
            clock=service.clock,
        )

    def publish(
        self,
        reading: SensorReading,
        command: CommandInForce,
        ledger: Ledger,
        *,
        reward: float,
        terminated: bool,
        truncated: bool,
        keep_counts: Callable[[], None],
    ) -> TimeStep:
        """Publish what the sensors show now and what led to it; ``keep_counts`` is called once it has its number.

        Raises:
            ServiceError: a sensor or the reward is not finite or not of the TaskSpec's shape; nothing was published.
        """
        published_ns = self._service.clock.now_ns()
        # A reward travels in 64 bits, but replay keeps 32 of it.
        if not (np.isfinite(reading.proprioception).all() and abs(reward) <= _LARGEST_REWARD):
            given = f"a sensor gave {reading.proprioception}, reward {reward}"
            raise ServiceError(f"{given}: expected finite 32-bit numbers")
        self._check_shapes(reading)
        # Here, in the cycle: the observation waits for it either way, and a thread of its own would add a hand-over.
        frames = encode_frames(reading.frames, self._encoding)
        first = ledger.step_index == 0
        by_actor = command.source in (ActionSource.POLICY, ActionSource.HELD) and not first
        time_step = TimeStep(
            incarnation=self._service.incarnation,
            seq=self._counts.produced,
            episode=ledger.episode,
            attempt=ledger.attempt,
            step_index=ledger.step_index,
            published_ns=published_ns,
            frame_ids=reading.frame_ids,
            frame_capture_ns=reading.frame_capture_ns,
            frames=frames,
            proprioception=reading.proprioception,
            action=command.action,
            action_source=ActionSource.NONE if first else command.source,
            answered_seq=command.answered_seq if by_actor else -1,
            action_applied_ns=0 if first else command.applied_ns,
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            steps=ledger.totals.steps,
            acted_steps=ledger.totals.acted_steps,
        )
        self._payload = encode(time_step)
        self._counts.produced += 1
        keep_counts()
        self.sent_ns = self._service.clock.now_ns()
        self.journal.put(time_step.seq, self._payload)
        return time_step

    def _check_shapes(self, reading: SensorReading) -> None:
        # Receivers refuse what does not fit the TaskSpec, every time it is resent: better to say so here.
        size = self._dimensions
        wanted = {
            "frames": ("uint8", (len(reading.frame_ids), size.H, size.W, size.C)),
            "proprioception": ("float32", (size.P,)),
        }
        for name, expected in wanted.items():
            value = getattr(reading, name)
            if (value.dtype.name, value.shape) != expected:
                raise ServiceError(f"a sensor gave {name} of {value.dtype.name} {value.shape}: expected {expected}")

    def republish(self) -> None:
        """Publish the newest TimeStep once more."""
        self.journal.republish(self._payload)
