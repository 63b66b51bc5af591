"""How old an action is when the robot obeys it, and where that time went. Pure: times in, parts out.

    captured ─ published ─ sent ──────── received ─ began ─ computed ──────── arrived ─ applied
       camera     encode      uplink        queue    inference     downlink      apply

What happens at the actor is on its clock, all else on the bridge's. Uplink and downlink need the offset between the two
and share its error with opposite signs; their sum, and the age, do not depend on it.
"""

from __future__ import annotations

from dataclasses import dataclass

from common.inbox import Arrived
from common.messages import Action

PARTS = ("camera", "encode", "uplink", "queue", "inference", "downlink", "apply")
"""In the order in which they pass; together they are the age."""


@dataclass
class PublishedStep:
    """What is known of a TimeStep that may be answered; times on the bridge's clock."""

    published_ns: int
    """When the sensors had been read and the TimeStep was begun."""
    sent_ns: int
    """When it was encoded and given to the network."""
    captured_ns: int | None = None
    """When its newest frame was taken; None without camera, or where cameras go by another clock."""
    end_ns: int | None = None
    """When the cycle that it began ended."""
    answered: bool = False
    """Whether an answer has come."""


def age_parts_us(step: PublishedStep, arrived: Arrived[Action], applied_ns: int | None) -> dict[str, int | None]:
    """Return the parts of an action's age and the largest error of the two ways, microseconds.

    None stands for what is not there: no camera, no known offset, or, with ``applied_ns`` None, an action that the
    robot did not obey.
    """
    action = arrived.message
    known = action.offset_bound_ns >= 0
    parts = {
        "camera": None if step.captured_ns is None else step.published_ns - step.captured_ns,
        "encode": step.sent_ns - step.published_ns,
        "uplink": action.received_ns + action.offset_ns - step.sent_ns if known else None,
        "queue": action.began_ns - action.received_ns,
        "inference": action.sent_ns - action.began_ns,
        "downlink": arrived.at_ns - action.sent_ns - action.offset_ns if known else None,
        "apply": None if applied_ns is None else applied_ns - arrived.at_ns,
        "offset_bound": action.offset_bound_ns if known else None,
    }
    return {f"{name}_us": None if value is None else round(value / 1000) for name, value in parts.items()}
