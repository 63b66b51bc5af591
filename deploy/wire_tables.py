"""``python -m deploy.wire_tables``: write the tables of ``docs/wire-format.md`` anew, from the code they describe.

The document's prose is written by hand. What would drift (topics, messages, fields, periods, ports) stands between
two comments and comes from here; a test fails while the document shows anything else.
"""

from __future__ import annotations

import inspect
import re
import sys
import types
from collections.abc import Callable, Iterable
from dataclasses import MISSING, fields, is_dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import common.clock_exchange
import common.frame_encoding
import common.journal
import common.messages
import common.retained_messages
import common.service
import common.transport
import services.actor.forwarding
import services.learner.minibatches
import services.learner.policy_pushes
import services.replay.minibatch_senders
import services.replay.replay
import services.robot_bridge.answers
import services.robot_bridge.bridge
from common.frame_encoding import EncodedFrames, FrameEncoding
from common.messages import (
    MESSAGES,
    SCHEMA_VERSION,
    ActionSource,
    Array,
    Bounds,
    CameraFrames,
    Command,
    CommandReply,
)
from common.topics import SERVICES, TOPICS, Delivery, Lane, Topic, command_topic
from deploy.docstrings import docstrings, markdown
from deploy.plan import PORTS, PortMap, connections
from deploy.ports import DEFAULT_BASE_PORT
from services.actor.config import ActorSettings
from services.learner.config import LearnerSettings
from services.replay.config import ReplaySettings
from services.robot_bridge.config import RobotBridgeSettings

DOCUMENT = Path(__file__).parents[1] / "docs" / "wire-format.md"

PHYSICAL = "the task's own"
UNITS = {
    **dict.fromkeys(["incarnation", "actor_incarnation", "learner_incarnation", "stream", "peers"], "ns since 1970"),
    **dict.fromkeys(["seq", "answered_seq", "oldest_seq", "next_seq", "missing", "episode", "attempt"], "ordinal"),
    **dict.fromkeys(["ordinal", "part", "frame_ids", "rows"], "ordinal"),
    **dict.fromkeys(["step_index", "steps", "acted_steps", "time_limit_steps", "reset_steps"], "action cycles"),
    **dict.fromkeys(["action", "action_low", "action_high", "chosen_action", "previous_action"], PHYSICAL),
    **dict.fromkeys(["proprioception", "proprioception_low", "proprioception_high", "next_proprioception"], PHYSICAL),
    **dict.fromkeys(["want_total", "received_total"], "minibatches"),
    **dict.fromkeys(["frame_index", "next_frame_index"], "index"),
    **dict.fromkeys(["updates", "updates_owed"], "updates"),
    **dict.fromkeys(["version", "policy_version"], "pushes"),
    **dict.fromkeys(["frame_shape", "crop_margin", "encoder_strides"], "pixels"),
    "frame_stack": "frames",
    "frames": "0 to 255",
    "world_seconds_per_cycle": "s of the world",
    "reward": "1",
    "log_probability": "nats",
    "parts": "messages",
    "terminated": "0 or 1",
    "hidden_size": "neurons",
    "shapes": "elements",
    "buffer": "bytes",
    "counters": "each its own",
    "produced": "TimeSteps",
}
"""Field -> unit of its numbers. Times have theirs in the name."""

CONSTANTS = (
    (common.transport, "LEASE_MS"),
    (common.service, "HEARTBEAT_S"),
    (common.service, "GONE_AFTER_S"),
    (common.service, "OUTAGE_S"),
    (common.service, "DRAIN_TIMEOUT_S"),
    (common.service, "STOP_TIMEOUT_S"),
    (common.frame_encoding, "MAX_PIXEL_BYTES"),
    (common.clock_exchange, "EXCHANGE_S"),
    (common.clock_exchange, "EXCHANGE_TIMEOUT_S"),
    (common.journal, "HEAD_PERIOD_S"),
    (common.retained_messages, "LEAST_TIMEOUT_S"),
    (common.retained_messages, "INITIAL_WINDOW_BYTES"),
    (common.retained_messages, "MAX_RANGES"),
    (services.actor.forwarding, "ACKNOWLEDGE_S"),
    (services.replay.replay, "ACKNOWLEDGE_S"),
    (services.replay.minibatch_senders, "LOST_AFTER_S"),
    (services.replay.replay, "ACTOR_LOST_AFTER_S"),
    (services.learner.minibatches, "CREDIT_S"),
    (services.learner.policy_pushes, "ACKNOWLEDGED_WITHIN_S"),
    (services.robot_bridge.answers, "REMEMBERED_STEPS"),
    (services.robot_bridge.bridge, "REPUBLISH_NS"),
)
"""Module-level numbers that a peer can notice."""

SETTINGS: tuple[tuple[str, type, tuple[str, ...]], ...] = (
    ("robot_bridge", RobotBridgeSettings, ("encoding", "on_missing_action", "stop_after", "peer_grace")),
    ("robot_bridge", RobotBridgeSettings, ("journal_s", "journal_mib", "resend_kib_per_s")),
    ("actor", ActorSettings, ("journal_s", "journal_mib", "resend_kib_per_s", "lockstep_surplus")),
    ("replay", ReplaySettings, ("access", "max_surplus", "message_mib")),
    ("learner", LearnerSettings, ("access", "prefetch", "push_share")),
)
"""Settings that a peer can notice: (section, its class, keys)."""


# ------------------------------------------------------------------ the document


def render(document: str) -> str:
    """Return ``document`` with each of its tables as the code has them now.

    Raises:
        ValueError: the document has not exactly one place for each table.
    """
    names = re.findall(r"^<!-- table: (.*?) -->$", document, re.MULTILINE)
    if sorted(names) != sorted(TABLES):
        raise ValueError(f"wire-format.md: expected one `<!-- table: NAME -->` for each of {list(TABLES)}, got {names}")

    def replaced(match: re.Match[str]) -> str:
        return f"{match[1]}\n{TABLES[match[2]]()}\n{match[3]}"

    pattern = re.compile(r"(<!-- table: (.*?) -->)\n.*?(<!-- end of table -->)", re.DOTALL)
    rendered, count = pattern.subn(replaced, document)
    if count != len(TABLES):
        raise ValueError("wire-format.md: a table has no `<!-- end of table -->`")
    return rendered


def main() -> int:
    """Write the document's tables; return the exit code."""
    before = DOCUMENT.read_text(encoding="utf-8")
    after = render(before)
    if after != before:
        DOCUMENT.write_text(after, encoding="utf-8")
    print(f"{DOCUMENT.name}: {'written' if after != before else 'up to date'}")
    return 0


# ------------------------------------------------------------------ topics


def topic_table() -> str:
    """Every key, what travels on it and how."""
    every = [*TOPICS, *(command_topic(service) for service in SERVICES)]
    return _table(
        ("topic", "message", "from", "to", "delivery", "lane", "sent as", "how often"),
        (
            (
                f"`{topic.name}`",
                _message_link(topic.message),
                _names(topic.publishers),
                _names(topic.subscribers) or "whoever asks",
                topic.delivery.value,
                topic.lane.value,
                _quality_of_service(topic),
                topic.rate,
            )
            for topic in every
        ),
    )


def _quality_of_service(topic: Topic) -> str:
    """Priority, congestion control and express flag, as :class:`common.transport.ZenohTransport` publishes it."""
    match topic.delivery:
        case Delivery.QUERY:
            return "query"
        case Delivery.CACHED:
            return "`DATA_LOW` `BLOCK`"
    if topic.waits:
        return "`DATA` `BLOCK`"
    return "`REAL_TIME` `DROP` express" if topic.urgent else "`DATA` `DROP`"


def _message_link(message: type) -> str:
    return f"[{message.__name__}](#{message.__name__.lower()})"


def _names(services: Iterable[str]) -> str:
    listed = tuple(services)
    return "all" if listed == SERVICES else ", ".join(listed)


def mesh_table() -> str:
    """Who listens where and connects to whom, as the launcher arranges it."""
    ports = PortMap(range(DEFAULT_BASE_PORT, DEFAULT_BASE_PORT + PORTS))
    return _table(
        ("service", *(f"`listen_{lane.value}`" for lane in Lane), "connects to"),
        (
            (
                f"`{service}`",
                *(str(ports.port(service, lane)) for lane in Lane),
                ", ".join(f"`{listener}`" for dialler, listener in connections() if dialler == service) or "nobody",
            )
            for service in SERVICES
        ),
    )


# ------------------------------------------------------------------ messages


def message_tables() -> str:
    """Every message, and what is nested in one, with every field."""
    return "\n\n".join(message_table(message) for message in [*MESSAGES, *_nested(MESSAGES)])


def message_table(message: type) -> str:
    """One message: what it is, what it travels on, and a row for each field."""
    heading = f"#### {message.__name__}\n\n{markdown(inspect.getdoc(message) or '')}\n\n{_carriers(message)}\n\n"
    hints = get_type_hints(message, include_extras=True)
    documented = docstrings(sys.modules[message.__module__])
    rows = []
    for field in fields(message):
        name = f"{message.__name__}.{field.name}"
        meaning = documented.get(name)
        if meaning is None:
            raise ValueError(f"{name}: expected a docstring")
        hint = hints[field.name]
        rows.append((f"`{field.name}`", wire_type(hint), _unit(name, hint), _bounds(hint), markdown(meaning)))
    return heading + _table(("field", "on the wire", "unit", "bounds", "meaning"), rows)


def _carriers(message: type) -> str:
    """Where a message travels."""
    if message in (Command, CommandReply):
        return f"Payload of a `command/<service>` query's {'question' if message is Command else 'answer'}."
    names = [f"`{topic.name}`" for topic in TOPICS if topic.message is message]
    return f"On {' and '.join(names)}." if names else "No message of its own: a map inside another."


def wire_type(hint: Any) -> str:
    """How a field stands in a payload, for the reader."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        inner, rule = arguments
        if not isinstance(rule, Array):
            return wire_type(inner)
        array = f"{rule.dtype} ({', '.join(map(str, rule.shape))})"
        return f"{array} or [encoded](#camera-frames)" if isinstance(rule, CameraFrames) else array
    if origin in (Union, types.UnionType):
        return " or ".join("nil" if argument is type(None) else wire_type(argument) for argument in arguments)
    if origin is dict:
        return f"map of {wire_type(arguments[0])} to {wire_type(arguments[1])}"
    if origin is list:
        return f"list of {wire_type(arguments[0])}"
    if is_dataclass(hint):
        return f"map [{hint.__name__}](#{hint.__name__.lower()})"
    if issubclass(hint, StrEnum):
        return f"str [{hint.__name__}](#{hint.__name__.lower()})"
    return str(hint.__name__)


def action_source_table() -> str:
    """The values of ActionSource."""
    return _enumeration_table(ActionSource)


def frame_encoding_table() -> str:
    """The values of FrameEncoding."""
    return _enumeration_table(FrameEncoding)


def _enumeration_table(enumeration: type[StrEnum]) -> str:
    name, documented = enumeration.__name__, docstrings(sys.modules[enumeration.__module__])
    rows = ((f"`{member.value}`", markdown(documented[f"{name}.{member.name}"])) for member in enumeration)
    return f"#### {name}\n\n{markdown(inspect.getdoc(enumeration) or '')}\n\n{_table(('value', 'meaning'), rows)}"


def version_line() -> str:
    """The schema version in force."""
    return f"The schema version is **{SCHEMA_VERSION}**."


def _unit(name: str, hint: Any) -> str:
    if not _is_numeric(hint):
        return ""
    field = name.rpartition(".")[2]
    if field.endswith("_ns"):
        return "ns"
    if field.endswith("_s"):
        return "s"
    if field not in UNITS:
        raise ValueError(f"{name}: expected its unit in UNITS")
    return UNITS[field]


def _is_numeric(hint: Any) -> bool:
    arguments = get_args(hint)
    match get_origin(hint):
        case origin if origin is Annotated:
            return isinstance(arguments[1], Array) or _is_numeric(arguments[0])
        case origin if origin is dict:
            return _is_numeric(arguments[1])
        case origin if origin is list:
            return _is_numeric(arguments[0])
    return hint in (int, float)


def _bounds(hint: Any) -> str:
    rule = get_args(hint)[1] if get_origin(hint) is Annotated else None
    if isinstance(rule, Bounds):
        low = None if rule.low is None else f"≥ {_number(rule.low)}"
        high = None if rule.high is None else f"≤ {_number(rule.high)}"
        return ", ".join(filter(None, (low, high)))
    if isinstance(rule, Array):
        return "finite" if rule.dtype.startswith("float") else ""
    return "finite" if hint is float or (get_origin(hint) is dict and get_args(hint)[1] is float) else ""


def _number(value: float) -> str:
    if value == 2**62:
        return "2^62"
    return f"{value:g}"


def _nested(messages: Iterable[type]) -> list[type]:
    """Dataclasses inside messages that are no messages themselves, in the order of their first use."""
    found: dict[type, None] = {}
    for message in messages:
        for hint in get_type_hints(message).values():
            for part in (hint, *get_args(hint)):
                # Encoded frames are no map, but a list of their own kind.
                if is_dataclass(part) and part not in MESSAGES and part is not EncodedFrames:
                    found[part] = None
    return list(found)


# ------------------------------------------------------------------ periods


def period_table() -> str:
    """Numbers of the code that a peer can notice."""
    rows = []
    for module, name in CONSTANTS:
        shown = f"`{module.__name__}.{name}`"
        rows.append((shown, _value(getattr(module, name)), markdown(docstrings(module)[name])))
    return _table(("constant", "value", "meaning"), rows)


def setting_table() -> str:
    """Settings that a peer can notice, with their defaults."""
    rows = []
    for section, cls, names in SETTINGS:
        by_name = {field.name: field for field in fields(cls)}
        for name in names:
            owner = next(base for base in cls.__mro__ if name in vars(base).get("__annotations__", {}))
            meaning = docstrings(sys.modules[owner.__module__])[f"{owner.__name__}.{name}"]
            default = by_name[name].default
            assert default is not MISSING
            rows.append((f"`{section}.{name}`", _value(default), markdown(meaning)))
    return _table(("setting", "default", "meaning"), rows)


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"`{key}`: {_value(item)}" for key, item in value.items())
    return f"`{value}`" if isinstance(value, str) else f"{value:_d}" if isinstance(value, int) else f"{value:g}"


# ------------------------------------------------------------------ text


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


TABLES: dict[str, Callable[[], str]] = {
    "schema version": version_line,
    "topics": topic_table,
    "mesh": mesh_table,
    "messages": message_tables,
    "action sources": action_source_table,
    "frame encodings": frame_encoding_table,
    "periods": period_table,
    "settings": setting_table,
}
"""Name of a place in the document -> what stands there."""


if __name__ == "__main__":
    sys.exit(main())
