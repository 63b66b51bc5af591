"""The table of every topic: what travels on which key, from whom to whom, and how it is delivered.

Read it and you know what the services say to each other. Key expressions are ``relod/<run>/<robot>/<topic>``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from common import messages as m

ROBOT_BRIDGE, ACTOR, REPLAY, LEARNER = "robot_bridge", "actor", "replay", "learner"
SERVICES = (ROBOT_BRIDGE, ACTOR, REPLAY, LEARNER)
"""The ring, in the order in which data flows through it."""


class Delivery(Enum):
    """What the transport promises for a topic."""

    NEWEST = "newest"
    """The receiver sees the newest message; older ones may be dropped on the way."""
    NUMBERED = "numbered"
    """Every message: gaps are noticed by number and sent again, by :mod:`common.journal` or for open credit."""
    CACHED = "cached"
    """The newest message, also for a receiver that comes later."""
    QUERY = "query"
    """Asked for and answered."""


class Lane(Enum):
    """Which of a service's two sessions carries a topic.

    Each lane is a connection of its own, because a large message delays everything behind it on its connection.
    """

    REAL_TIME = "real_time"
    BULK = "bulk"


@dataclass(frozen=True)
class Topic:
    """One row of the table."""

    name: str
    """Key expression below ``relod/<run>/<robot>/``."""
    message: type
    """Type of the payload; for a query, of the reply."""
    publishers: tuple[str, ...]
    """Services that send it (that answer it, for a query)."""
    subscribers: tuple[str, ...]
    """Services that receive it (that ask, for a query)."""
    delivery: Delivery
    lane: Lane
    rate: str
    """How often, for the reader."""
    urgent: bool = False
    """Sent ahead of everything else on its lane."""
    waits: bool = False
    """Large: a put waits for the network, so the publisher has a thread of its own for it."""

    def key(self, run: str, robot: str) -> str:
        """Full key expression in a run."""
        return f"relod/{run}/{robot}/{self.name}"


_REAL_TIME, _BULK = Lane.REAL_TIME, Lane.BULK
_NEWEST, _NUMBERED, _CACHED, _QUERY = Delivery.NEWEST, Delivery.NUMBERED, Delivery.CACHED, Delivery.QUERY

# fmt: off
SPEC = Topic("spec", m.TaskSpec, (ROBOT_BRIDGE,), (ACTOR, REPLAY, LEARNER), _QUERY, _REAL_TIME, "at start")
CLOCK = Topic("clock", m.ClockReading, (ROBOT_BRIDGE,), (ACTOR, REPLAY, LEARNER), _QUERY, _REAL_TIME, "0.1 s, 1 s")
TIME_STEP = Topic("timestep", m.TimeStep, (ROBOT_BRIDGE,), (ACTOR,), _NUMBERED, _REAL_TIME, "action cycle", urgent=True)
TIME_STEP_RESENT = Topic("timestep/resent", m.TimeStep, (ROBOT_BRIDGE,), (ACTOR,), _NUMBERED, _BULK, "gaps, paced")
TIME_STEP_HEAD = Topic("timestep/head", m.StreamHead, (ROBOT_BRIDGE,), (ACTOR,), _NEWEST, _REAL_TIME, "0.2 s")
TIME_STEP_ACK = Topic("timestep/ack", m.Acknowledgement, (ACTOR,), (ROBOT_BRIDGE,), _NEWEST, _REAL_TIME, "0.1 s")
ACTION = Topic("action", m.Action, (ACTOR,), (ROBOT_BRIDGE,), _NEWEST, _REAL_TIME, "action cycle", urgent=True)
EXPERIENCE = Topic("experience", m.Experience, (ACTOR,), (REPLAY,), _NUMBERED, _BULK, "action cycle")
EXPERIENCE_RESENT = Topic("experience/resent", m.Experience, (ACTOR,), (REPLAY,), _NUMBERED, _BULK, "gaps, paced")
EXPERIENCE_HEAD = Topic("experience/head", m.StreamHead, (ACTOR,), (REPLAY,), _NEWEST, _REAL_TIME, "0.2 s")
EXPERIENCE_ACK = Topic("experience/ack", m.Acknowledgement, (REPLAY,), (ACTOR,), _NEWEST, _REAL_TIME, "0.1 s")
CREDIT = Topic("credit", m.Credit, (LEARNER,), (REPLAY,), _NEWEST, _REAL_TIME, "update, 0.2 s")
ROW_MINIBATCH = Topic("minibatch/rows", m.RowMinibatch, (REPLAY,), (LEARNER,), _NUMBERED, _BULK, "update")
ARRAY_MINIBATCH = Topic(
    "minibatch/arrays", m.ArrayMinibatch, (REPLAY,), (LEARNER,), _NUMBERED, _BULK, "update", waits=True
)
POLICY = Topic("policy", m.PolicyWeights, (LEARNER,), (ACTOR,), _CACHED, _BULK, "push interval", waits=True)
POLICY_ACK = Topic("policy/ack", m.PolicyAcknowledgement, (ACTOR,), (LEARNER,), _NEWEST, _REAL_TIME, "push")
STATUS = Topic("status", m.Status, SERVICES, SERVICES, _NEWEST, _REAL_TIME, "0.2 s")
FINISHED = Topic("finished", m.Finished, (ROBOT_BRIDGE,), (ACTOR, REPLAY, LEARNER), _NEWEST, _REAL_TIME, "end, 0.2 s")
# fmt: on

TOPICS = (
    SPEC,
    CLOCK,
    TIME_STEP,
    TIME_STEP_RESENT,
    TIME_STEP_HEAD,
    TIME_STEP_ACK,
    ACTION,
    EXPERIENCE,
    EXPERIENCE_RESENT,
    EXPERIENCE_HEAD,
    EXPERIENCE_ACK,
    CREDIT,
    ROW_MINIBATCH,
    ARRAY_MINIBATCH,
    POLICY,
    POLICY_ACK,
    STATUS,
    FINISHED,
)


def command_topic(service: str) -> Topic:
    """Return the query by which people and tools command one service."""
    return Topic(f"command/{service}", m.CommandReply, (service,), (), _QUERY, _REAL_TIME, "on request")
