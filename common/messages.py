"""Every message that travels between the services: frozen dataclasses, shapes and units at the field.

A field's annotation is what the codec checks, so a wrong message is refused where it arrives and never reaches a
robot or a replay buffer. Letters in shapes are the task's sizes (:class:`Dimensions`):

====  =============================================================
``A``   action size
``P``   proprioception size
``H W C``   camera frame height, width, channels
``S``   frames stacked in one observation
====  =============================================================

Any other letter (``k``, ``n``, ``B`` ...) is free, but equal letters within one message mean equal sizes.
Times ending in ``_ns`` are on the sender's monotonic clock. Physical units on the wire; the learner normalises.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

import numpy as np
import numpy.typing as npt

from common.frame_encoding import FrameEncoding, Frames, pixels_of

SCHEMA_VERSION = 2
"""Raised with every change that an older peer would misread."""

Float32Array = npt.NDArray[np.float32]
Int64Array = npt.NDArray[np.int64]
UInt8Array = npt.NDArray[np.uint8]


class ActionSource(StrEnum):
    """What determined the command in force at the end of an action cycle."""

    NONE = "none"
    """The first TimeStep of an attempt: no action led into it."""
    POLICY = "policy"
    """An action of the actor that was applied during this cycle."""
    HELD = "held"
    """The command of an earlier cycle went on (``on_missing_action = "hold"``)."""
    ZERO = "zero"
    """The zero command, because no action was there."""
    STOP = "stop"
    """The watchdog's, a pause's or the emergency stop's command."""


@dataclass(frozen=True)
class Array:
    """What an array field must be: NumPy ``dtype`` and ``shape`` (letters as in the module's table); always finite."""

    dtype: str
    shape: tuple[str | int, ...]


@dataclass(frozen=True)
class CameraFrames(Array):
    """An array of camera frames, encoded as the TaskSpec says (:mod:`common.frame_encoding`)."""


@dataclass(frozen=True)
class Bounds:
    """Inclusive bounds of a finite number."""

    low: float | None = None
    high: float | None = None


Count = Annotated[int, Bounds(low=0, high=2**62)]
"""A whole number that is never negative and fits an int64, one more of it too."""


@dataclass(frozen=True)
class Dimensions:
    """Sizes that arrays of a run's messages must have, and how its frames travel; from the TaskSpec."""

    A: int
    P: int
    H: int
    W: int
    C: int
    S: int
    frame_encoding: FrameEncoding | None = None
    """How the frames of TimeSteps must be encoded; None accepts every encoding."""


@dataclass(frozen=True)
class TaskSpec:
    """What a task looks like from outside; answered by the bridge to every query on ``spec``."""

    task: str
    """Task id, a key of the task table."""
    preset: str
    """Task preset, ``demo`` or ``thesis`` where the task has them."""
    pacing: str
    """``realtime`` or ``lockstep``."""
    algorithm_presets: dict[str, str]
    """Algorithm name -> the preset this task asks for, e.g. ``{"sac": "dot_reacher"}``."""
    action_low: Annotated[Float32Array, Array("float32", ("A",))]
    """Smallest action, physical units of the task."""
    action_high: Annotated[Float32Array, Array("float32", ("A",))]
    """Largest action, physical units of the task."""
    proprioception_low: Annotated[Float32Array, Array("float32", ("P",))]
    """Lower end of the range the learner maps to -1, physical units; values outside are allowed."""
    proprioception_high: Annotated[Float32Array, Array("float32", ("P",))]
    """Upper end of the range the learner maps to +1, physical units."""
    frame_shape: Annotated[Int64Array, Array("int64", (3,))]
    """(height, width, channels) of one camera frame; zeros for a task without camera."""
    frame_stack: Count
    """Camera frames in one observation; 0 without camera."""
    crop_margin: Annotated[Int64Array, Array("int64", (2,))]
    """RAD crop margin (h_y, h_x) in pixels on each side (thesis 3.6)."""
    action_cycle_time_s: Annotated[float, Bounds(low=1e-4, high=60.0)]
    """Duration of one action cycle, seconds of the real clock."""
    world_seconds_per_cycle: Annotated[float, Bounds(low=0.0)]
    """World time that passes in one action cycle, seconds of the task's world."""
    time_limit_steps: Annotated[int, Bounds(low=1)]
    """Action cycles in an attempt before the reset is called."""
    reset_steps: Count
    """Action cycles that a reset after a time-out takes; counted into the episode (thesis 6.1)."""
    has_goal: bool
    """True if an attempt can terminate; steps per goal mean something only then."""
    frame_encoding: FrameEncoding = FrameEncoding.RAW
    """How the frames of all TimeSteps of the run travel."""

    @property
    def dimensions(self) -> Dimensions:
        """Sizes for checking the run's other messages."""
        height, width, channels = self.frame_shape.tolist()
        return Dimensions(
            A=len(self.action_low),
            P=len(self.proprioception_low),
            H=height,
            W=width,
            C=channels,
            S=self.frame_stack,
            frame_encoding=self.frame_encoding,
        )

    @property
    def has_camera(self) -> bool:
        """True if observations contain camera frames."""
        return self.frame_stack > 0


@dataclass(frozen=True)
class ClockReading:
    """What the bridge's clock shows: the answer to a query on ``clock``, by which others find their offset to it."""

    incarnation: Count
    """Start of the bridge process, nanoseconds since 1970: another one may run on another computer."""
    received_ns: Count
    """When the question came, bridge's monotonic clock."""
    answered_ns: Count
    """When this answer was made, bridge's monotonic clock."""


@dataclass(frozen=True)
class TimeStep:
    """The observation o_t and what led into it: action, reward, and how the attempt stands.

    Published by the bridge at the end of each action cycle. The first of an attempt has no action behind it. The
    frame stack is rebuilt by the receiver (:mod:`common.frame_stack`) from the new frames and those before.
    """

    incarnation: Count
    """Start of the bridge process, nanoseconds since 1970: larger is newer."""
    seq: Count
    """Number of the TimeStep in its incarnation, contiguous from 0."""
    episode: Count
    """Goal to goal."""
    attempt: Count
    """Reset to reset, counted through the run; frame stack and pairing follow it."""
    step_index: Count
    """Action cycles since the attempt began; 0 for its first TimeStep."""
    published_ns: Count
    """When the bridge had read its sensors and began to publish this TimeStep, its monotonic clock."""
    frame_ids: Annotated[Int64Array, Array("int64", ("k",))]
    """Consecutive ids of the camera frames that are new since the TimeStep before."""
    frame_capture_ns: Annotated[Int64Array, Array("int64", ("k",))]
    """Capture times of the new frames, bridge's monotonic clock."""
    frames: Annotated[Frames, CameraFrames("uint8", ("k", "H", "W", "C"))]
    """The new camera frames, oldest first; channels are red, green, blue."""
    proprioception: Annotated[Float32Array, Array("float32", ("P",))]
    """Physical units of the task."""
    action: Annotated[Float32Array, Array("float32", ("A",))]
    """Command in force at the cycle's end, clipped to the TaskSpec; zeros, so clipped, if ``action_source`` is none."""
    action_source: ActionSource
    """What determined ``action``."""
    answered_seq: Annotated[int, Bounds(low=-1)]
    """``seq`` of the TimeStep that ``action`` answers; -1 if it is not an actor's."""
    action_applied_ns: Count
    """When ``action`` took effect, bridge's monotonic clock; 0 if ``action_source`` is none."""
    reward: float
    """Reward of the cycle that ended here; 0 in the first TimeStep of an attempt."""
    terminated: bool
    """The goal was reached: the only thing that cuts the bootstrap."""
    truncated: bool
    """The attempt ended without the goal: the value of this observation still counts."""
    steps: Count
    """Action cycles of the run so far, resets included."""
    acted_steps: Count
    """Action cycles of the run so far, without resets."""

    @property
    def pixels(self) -> UInt8Array:
        """(k, H, W, C): ``frames`` as whoever receives them sees them."""
        return pixels_of(self.frames)

    @property
    def is_first(self) -> bool:
        """True for the TimeStep that starts an attempt."""
        return self.step_index == 0

    @property
    def is_last(self) -> bool:
        """True for the TimeStep that ends an attempt."""
        return self.terminated or self.truncated


@dataclass(frozen=True)
class Action:
    """The actor's answer to one TimeStep."""

    actor_incarnation: Count
    """Start of the actor process, nanoseconds since 1970: larger is newer."""
    incarnation: Count
    """Bridge incarnation of the answered TimeStep."""
    answered_seq: Count
    """``seq`` of the answered TimeStep."""
    action: Annotated[Float32Array, Array("float32", ("A",))]
    """Chosen action before clipping, physical units."""
    log_probability: float
    """Log-density of the chosen action in the normalised action space."""
    policy_version: Count
    """Version of the policy that acted; 0 is the initial policy."""
    received_ns: Count
    """When the TimeStep arrived, actor's monotonic clock."""
    began_ns: Count
    """When the policy began to compute, actor's monotonic clock."""
    sent_ns: Count
    """When the action was computed and sent, actor's monotonic clock."""
    offset_ns: Annotated[int, Bounds(low=-(2**62), high=2**62)]
    """Bridge's monotonic clock minus the actor's at ``sent_ns``, as the actor knows it (``clock``); else 0."""
    offset_bound_ns: Annotated[int, Bounds(low=-1, high=2**62)]
    """Largest error of ``offset_ns``; -1 where the actor does not know the offset."""


@dataclass(frozen=True)
class PolicyExtras:
    """What the actor knows of its answer to the TimeStep before, applied or not; travels with the Experience."""

    chosen_action: Annotated[Float32Array, Array("float32", ("A",))]
    """Action before clipping, physical units."""
    log_probability: float
    """Log-density of the chosen action in the normalised action space."""
    policy_version: Count
    """Version of the policy that chose it."""


@dataclass(frozen=True)
class Experience:
    """A TimeStep as it came, plus the policy's extras for the action that was chosen on the TimeStep before."""

    actor_incarnation: Count
    """Start of the actor process, nanoseconds since 1970."""
    seq: Count
    """Number of the Experience in the actor's incarnation, contiguous from 0."""
    time_step: TimeStep
    """Unchanged."""
    extras: PolicyExtras | None
    """None for the first of an attempt, and where this actor did not answer the TimeStep before."""


@dataclass(frozen=True)
class Acknowledgement:
    """What the receiver of a numbered stream has and misses (:mod:`common.journal`)."""

    stream: Count
    """Sender incarnation whose messages are acknowledged."""
    next_seq: Count
    """All before this number have been taken over by the receiver."""
    missing: Annotated[Int64Array, Array("int64", ("n", 2))]
    """Half-open ranges [start, end) that are known to exist and have not arrived; an empty one at the end, [n, n),
    tells that n - 1 is the newest that has."""
    updates_owed: Annotated[float, Bounds(low=0.0)]
    """What the learner has still to do: unspent updates, or on-policy the transitions of a rollout that it has not
    answered with a new policy; in lockstep the actor waits for it. 0 on other streams."""


@dataclass(frozen=True)
class StreamHead:
    """What the sender of a numbered stream still holds; tells a receiver of losses at the tail."""

    stream: Count
    """Sender incarnation."""
    oldest_seq: Count
    """Oldest message that can still be resent; anything missing before it is lost."""
    next_seq: Count
    """Number the next message will get."""


@dataclass(frozen=True)
class Credit:
    """How many minibatches a learner has asked for since it started; re-sent, so one lost does no harm."""

    learner_incarnation: Count
    """Start of the learner process, nanoseconds since 1970."""
    want_total: Count
    """Cumulative count of minibatches wanted."""
    received_total: Count
    """Ordinal of the next minibatch expected; one that was sent and is still missing later has been lost."""


@dataclass(frozen=True)
class RowMinibatch:
    """A minibatch for a learner that maps the experience ring."""

    learner_incarnation: Count
    """Learner this answers."""
    ordinal: Count
    """Count of minibatches sent to this learner before this one."""
    rows: Annotated[Int64Array, Array("int64", ("B",))]
    """Row ids of the transitions' second experience in the ring (row - 1 is the first)."""


@dataclass(frozen=True)
class ArrayMinibatch:
    """A minibatch for a learner that cannot map the ring: each camera frame once."""

    learner_incarnation: Count
    """Learner this answers."""
    ordinal: Count
    """Count of minibatches sent to this learner before this one."""
    part: Count
    """Index of this piece; frames of a large minibatch are split over several messages."""
    parts: Annotated[int, Bounds(low=1)]
    """Pieces of this minibatch; the fields below ``frames`` are equal in each."""
    frames: Annotated[UInt8Array, Array("uint8", ("n", "H", "W", "C"))]
    """This piece's share of the unique camera frames, in order."""
    rows: Annotated[Int64Array, Array("int64", ("B",))]
    """Row ids of the transitions' second experience in the ring: consecutive ones are consecutive transitions."""
    frame_index: Annotated[Int64Array, Array("int64", ("B", "S"))]
    """Observation stacks: indices into all pieces' frames, oldest first."""
    next_frame_index: Annotated[Int64Array, Array("int64", ("B", "S"))]
    """Next observation stacks."""
    proprioception: Annotated[Float32Array, Array("float32", ("B", "P"))]
    """Of the observations, physical units."""
    previous_action: Annotated[Float32Array, Array("float32", ("B", "A"))]
    """Command in force before the observation, physical units; zeros at the start of an attempt."""
    next_proprioception: Annotated[Float32Array, Array("float32", ("B", "P"))]
    """Of the next observations, physical units."""
    action: Annotated[Float32Array, Array("float32", ("B", "A"))]
    """Applied action, physical units."""
    chosen_action: Annotated[Float32Array, Array("float32", ("B", "A"))]
    """Action the policy chose for the observation, before clipping, physical units; zeros where it chose none."""
    log_probability: Annotated[Float32Array, Array("float32", ("B",))]
    """Log-density of the chosen action in the normalised action space; 0 where there is none."""
    reward: Annotated[Float32Array, Array("float32", ("B",))]
    """Reward of the cycle between the two observations."""
    terminated: Annotated[UInt8Array, Array("uint8", ("B",))]
    """1 where the next observation reached the goal."""


@dataclass(frozen=True)
class PolicyWeights:
    """Weights of the policy alone (no critic), as one flat buffer."""

    version: Annotated[int, Bounds(low=1)]
    """Count of pushes of all learners of this run: larger is newer."""
    updates: Count
    """Policy updates done when the weights were taken."""
    algorithm: str
    """Algorithm that made them."""
    hidden_size: Annotated[int, Bounds(low=1)]
    """Width of the hidden layers."""
    encoder_strides: Annotated[Int64Array, Array("int64", ("n",))]
    """Strides of the encoder's convolutions; empty without camera."""
    names: list[str]
    """Parameter names, in the order of the buffer."""
    shapes: list[list[int]]
    """Parameter shapes, in the same order."""
    dtype: str
    """``float32`` or ``float16``."""
    buffer: Annotated[UInt8Array, Array("uint8", ("m",))]
    """Little-endian values of all parameters, concatenated."""
    digest: str
    """XXH3-128 of the buffer, seed 0, hexadecimal."""


@dataclass(frozen=True)
class PolicyAcknowledgement:
    """A policy has arrived at the actor, be it of use or not; tells the learner how long it was on its way."""

    version: Annotated[int, Bounds(low=1)]
    """Of the PolicyWeights."""


@dataclass(frozen=True)
class Status:
    """A service's heartbeat; who has sent none for a while counts as gone."""

    service: str
    """``robot_bridge``, ``actor``, ``replay`` or ``learner``."""
    run: str
    """Run id, so that a peer of another run on the same mesh is noticed."""
    robot: str
    """Robot the service works for; several may share a run."""
    incarnation: Count
    """Start of the process, nanoseconds since 1970."""
    state: str
    """``starting``, ``running``, ``draining``, ``drained`` or ``stopped``."""
    counters: dict[str, float]
    """The service's own counts and gauges."""
    peers: dict[str, int]
    """Service -> newest incarnation the sender has heard of: an older one learns that it has been replaced."""


@dataclass(frozen=True)
class Finished:
    """The bridge has done its steps; re-sent until it ends."""

    incarnation: Count
    """Bridge incarnation."""
    produced: Count
    """TimeSteps this incarnation published."""
    reason: str
    """``steps`` (the run's steps are done) or ``stopped`` (asked to end early)."""


@dataclass(frozen=True)
class Command:
    """A person's or tool's request to a service; answered by a :class:`CommandReply`."""

    name: str
    """``pause``, ``resume``, ``checkpoint``, ``stop`` or ``e_stop``."""


@dataclass(frozen=True)
class CommandReply:
    """Answer to a Command."""

    accepted: bool
    """True if the service does what was asked."""
    detail: str
    """Why not, or what was done."""


MESSAGES: tuple[type, ...] = (
    TaskSpec,
    ClockReading,
    TimeStep,
    Action,
    Experience,
    Acknowledgement,
    StreamHead,
    Credit,
    RowMinibatch,
    ArrayMinibatch,
    PolicyWeights,
    PolicyAcknowledgement,
    Status,
    Finished,
    Command,
    CommandReply,
)
"""Messages that may stand at the top of a payload."""
