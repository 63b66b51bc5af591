"""``docs/wire-format.md`` says what the code does: tables, example and programs."""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
import types
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any

import msgpack
import numpy as np
import pytest
import zenoh

from common import messages, topics
from common.codec import decode, encode
from common.frame_encoding import EncodedFrames, FrameEncoding, encode_frames
from common.frame_stack import FrameStack
from common.messages import (
    MESSAGES,
    SCHEMA_VERSION,
    Acknowledgement,
    Action,
    Array,
    ArrayMinibatch,
    Bounds,
    ClockReading,
    Command,
    CommandReply,
    Credit,
    Experience,
    Finished,
    Float32Array,
    PolicyAcknowledgement,
    PolicyExtras,
    PolicyWeights,
    RowMinibatch,
    Status,
    StreamHead,
    TaskSpec,
    TimeStep,
)
from common.policies import pack_weights, policy_from_weights
from common.policies.base import Observation
from common.policies.weights import initial_parameters, parameter_shapes
from common.run_settings import TransportSettings
from common.topics import SERVICES, TOPICS, Delivery
from common.transport import ZenohTransport
from deploy import wire_tables
from deploy.docstrings import docstrings
from tests.docs.pages import programs, table_rows, text
from tests.helpers import make_experience, make_run, make_spec, make_time_step
from tests.integration.wire_listener import Tables, plain

SPEC = make_spec()
STRIDES = (2, 1, 1, 1)


def program(name: str) -> types.ModuleType:
    """A program of the document, as a module."""
    module = types.ModuleType(name)
    exec(compile(programs(text())[name], name, "exec"), vars(module))
    return module


def make_weights(spec: TaskSpec, dtype: str = "float32") -> PolicyWeights:
    """Weights with random numbers everywhere, the last layer and all biases too."""
    rng = np.random.default_rng(3)
    strides = STRIDES if spec.has_camera else ()
    parameters = initial_parameters(spec, 16, strides, rng)
    for name, values in parameters.items():
        if name != "log_std_bounds":
            values += rng.normal(scale=0.1, size=values.shape).astype(np.float32)
    arguments = {"version": 4, "updates": 20, "algorithm": "sac", "hidden_size": 16, "encoder_strides": strides}
    return pack_weights(parameters, **arguments, dtype=dtype)


def make_array_minibatch() -> ArrayMinibatch:
    rng = np.random.default_rng(1)
    real = {
        name: rng.normal(size=(3, size)).astype(np.float32)
        for name, size in {
            "proprioception": 5,
            "next_proprioception": 5,
            "action": 2,
            "previous_action": 2,
            "chosen_action": 2,
        }.items()
    }
    return ArrayMinibatch(
        learner_incarnation=3,
        ordinal=7,
        part=0,
        parts=1,
        frames=rng.integers(0, 256, (9, 6, 8, 3), np.uint8),
        frame_index=rng.integers(0, 9, (3, 4)),
        next_frame_index=rng.integers(0, 9, (3, 4)),
        rows=np.array([5, 9, 5]),
        log_probability=np.full(3, -1.5, np.float32),
        reward=np.full(3, -1, np.float32),
        terminated=np.array([0, 1, 0], np.uint8),
        **real,
    )


EXAMPLES = (
    SPEC,
    ClockReading(5, 6, 7),
    make_time_step(3),
    make_time_step(3, frames=encode_frames(make_time_step(3).frames, FrameEncoding.ZSTD)),
    make_time_step(3, frames=encode_frames(make_time_step(3).frames, FrameEncoding.JPEG444)),
    Action(5, 6, 7, np.array([0.5, -1], np.float32), -1.25, 3, 8, 9, 10, -11, 12),
    make_experience(0),
    make_experience(3),
    Acknowledgement(5, 6, np.array([[6, 8], [10, 11]]), 2.5),
    StreamHead(5, 3, 12),
    Credit(4, 12, 10),
    RowMinibatch(4, 11, np.array([5, 9, 5])),
    make_array_minibatch(),
    make_weights(SPEC),
    PolicyAcknowledgement(4),
    Status("actor", "run", "robot0", 5, "running", {"actions": 3.0}, {"robot_bridge": 2**61}),
    Finished(5, 100, "steps"),
    Command("stop"),
    CommandReply(False, "no"),
)
"""Every message."""
every_example = pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)


def as_fields(message: Any) -> dict[str, Any]:
    """A message as a client has it: a dictionary, nested messages too."""
    values = {field.name: getattr(message, field.name) for field in fields(message)}
    for name, value in values.items():
        if isinstance(value, EncodedFrames):
            values[name] = value.pixels
        elif dataclasses.is_dataclass(value):
            values[name] = as_fields(value)
    return values


def assert_same(one: Any, other: Any) -> None:
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_same(one[key], other[key])
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    else:
        assert one == other


# ------------------------------------------------------------------ tables


def test_the_document_shows_what_the_code_says():
    assert wire_tables.render(text()) == text(), "run `python -m deploy.wire_tables`"


def test_the_command_brings_a_document_up_to_date(tmp_path, monkeypatch, capsys):
    behind = tmp_path / "wire-format.md"
    behind.write_text(text().replace("| `timestep/head` |", "| `timestep/heads` |"), encoding="utf-8")
    monkeypatch.setattr(wire_tables, "DOCUMENT", behind)
    for printed in ("written", "up to date"):
        assert wire_tables.main() == 0
        assert capsys.readouterr().out == f"wire-format.md: {printed}\n"
        assert behind.read_text(encoding="utf-8") == wire_tables.render(text())


def test_every_message_of_the_code_has_its_fields_in_the_document_and_no_others():
    documented = Tables(text()).messages
    assert list(documented) == [message.__name__ for message in (*MESSAGES, PolicyExtras)]
    for message in (*MESSAGES, PolicyExtras):
        assert list(documented[message.__name__]) == [field.name for field in fields(message)]


def test_every_row_says_what_the_field_means_and_in_which_unit():
    for message, rows in Tables(text()).messages.items():
        for name, row in rows.items():
            assert row["meaning"], f"{message}.{name}"
            numeric = re.search(r"\b(int|float|uint8|int64|float32)\b", row["on the wire"])
            assert bool(row["unit"]) == bool(numeric), f"{message}.{name}"


def test_rows_written_by_hand():
    rows = {f"{name}.{field}": row for name, table in Tables(text()).messages.items() for field, row in table.items()}
    expected = {
        "TimeStep.seq": ("int", "ordinal", "≥ 0, ≤ 2^62"),
        "TimeStep.frames": ("uint8 (k, H, W, C) or encoded", "0 to 255", ""),
        "TaskSpec.frame_encoding": ("str FrameEncoding", "", ""),
        "TimeStep.frame_capture_ns": ("int64 (k)", "ns", ""),
        "TimeStep.proprioception": ("float32 (P)", "the task's own", "finite"),
        "TimeStep.action_source": ("str ActionSource", "", ""),
        "TimeStep.answered_seq": ("int", "ordinal", "≥ -1"),
        "TimeStep.reward": ("float", "1", "finite"),
        "TimeStep.terminated": ("bool", "", ""),
        "TaskSpec.action_cycle_time_s": ("float", "s", "≥ 0.0001, ≤ 60"),
        "TaskSpec.algorithm_presets": ("map of str to str", "", ""),
        "Experience.extras": ("map PolicyExtras or nil", "", ""),
        "Acknowledgement.missing": ("int64 (n, 2)", "ordinal", ""),
        "PolicyWeights.shapes": ("list of list of int", "elements", ""),
        "Status.counters": ("map of str to float", "each its own", "finite"),
    }
    for name, (kind, unit, bounds) in expected.items():
        row = rows[name]
        assert (plain(row["on the wire"]), row["unit"], row["bounds"]) == (kind, unit, bounds), name
    topic = {plain(row["topic"]): row for row in table_rows("<!-- table: topics -->")}["timestep"]
    assert [plain(cell) for cell in topic.values()] == [
        *("timestep", "TimeStep", "robot_bridge", "actor", "numbered", "real_time"),
        *("REAL_TIME DROP express", "action cycle"),
    ]


CHANGES = {
    "another topic": ("TOPICS", lambda table: (*table, replace(topics.STATUS, name="metrics"))),
    "one topic less": ("TOPICS", lambda table: table[1:]),
    "another publisher": ("TOPICS", lambda table: (replace(table[0], publishers=("actor",)), *table[1:])),
    "another delivery": ("TOPICS", lambda table: (*table[:-1], replace(table[-1], delivery=Delivery.CACHED))),
    "another urgency": ("TOPICS", lambda table: (*table[:-1], replace(table[-1], urgent=True))),
    "one message less": ("MESSAGES", lambda table: table[:-1]),
    "another version": ("SCHEMA_VERSION", lambda version: version + 1),
    "another unit": ("UNITS", lambda units: {**units, "reward": "2"}),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_of_the_code_is_noticed(change, monkeypatch):
    name, changed = CHANGES[change]
    monkeypatch.setattr(wire_tables, name, changed(getattr(wire_tables, name)))
    assert wire_tables.render(text()) != text()


FIELD_CHANGES = {
    "added": lambda hints: {**hints, "seq": int},
    "removed": lambda hints: dict(list(hints.items())[:-1]),
    "in another order": lambda hints: dict(reversed(hints.items())),
    "of another type": lambda hints: {**hints, "reason": int},
    "with other bounds": lambda hints: {**hints, "produced": Annotated[int, Bounds(low=1)]},
    "an array instead": lambda hints: {**hints, "produced": Annotated[Float32Array, Array("float32", ("A",))]},
}


@pytest.mark.parametrize("change", FIELD_CHANGES)
def test_a_change_of_a_message_is_noticed(change, monkeypatch):
    hints = inspect.get_annotations(Finished, eval_str=True)
    changed = dataclasses.make_dataclass("Finished", FIELD_CHANGES[change](hints).items(), frozen=True)
    changed.__doc__, changed.__module__ = Finished.__doc__, Finished.__module__
    monkeypatch.setattr(wire_tables, "docstrings", lambda module: {**docstrings(module), "Finished.seq": "A number."})
    monkeypatch.setattr(wire_tables, "UNITS", {**wire_tables.UNITS, "reason": "1"})
    monkeypatch.setattr(wire_tables, "MESSAGES", tuple(changed if m is Finished else m for m in MESSAGES))
    monkeypatch.setattr(
        wire_tables, "TOPICS", tuple(replace(t, message=changed) if t.message is Finished else t for t in TOPICS)
    )
    assert wire_tables.render(text()) != text()


def test_a_field_without_a_meaning_or_a_unit_is_refused():
    @dataclass(frozen=True)
    class Speed:
        metres: float
        """Per second."""
        nameless: bool

    Speed.__module__ = messages.__name__
    with pytest.raises(ValueError, match=r"Speed.metres: expected a docstring"):
        wire_tables.message_table(Speed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wire_tables, "docstrings", lambda _: {"Speed.metres": "Per second.", "Speed.nameless": "Yes."})
        with pytest.raises(ValueError, match=r"Speed.metres: expected its unit"):
            wire_tables.message_table(Speed)


@pytest.mark.parametrize(
    ("wrong", "right"),
    [
        ("<!-- table: mesh -->", ""),
        ("<!-- table: mesh -->", "<!-- table: meshes -->"),
        ("<!-- table: mesh -->", "<!-- table: topics -->"),
    ],
    ids=["missing", "unknown", "twice"],
)
def test_a_document_without_a_place_for_a_table_is_refused(wrong, right):
    with pytest.raises(ValueError, match="expected one `<!-- table: NAME -->` for each of"):
        wire_tables.render(text().replace(wrong, right))


def test_a_table_without_an_end_is_refused():
    start, _, rest = text().rpartition("<!-- end of table -->")
    with pytest.raises(ValueError, match="a table has no"):
        wire_tables.render(start + rest)


def test_the_table_of_encoder_and_actor_is_what_a_policy_has():
    sizes = {**vars(SPEC.dimensions), "N": 16}
    rows = table_rows("`hidden_size`, the policy has")
    for spec in (SPEC, make_spec(camera=False)):
        shapes = {}
        for row in rows:
            if spec.has_camera or not row["with a camera only"]:
                # [64 +]: the encoder's features, with a camera
                shape = row["shape"].replace("[64 +]", "64 +" if spec.has_camera else "")
                shapes[plain(row["name"])] = [eval(size, {}, sizes) for size in shape.strip("()").split(",")]
        assert shapes == parameter_shapes(spec, 16, STRIDES if spec.has_camera else ())


def test_the_documented_settings_are_what_the_services_give_zenoh(monkeypatch):
    opened = []
    monkeypatch.setattr(zenoh, "open", opened.append)
    ZenohTransport(make_run(), TransportSettings("tcp/127.0.0.1:7450", "tcp/127.0.0.1:7451"))
    assert len(opened) == 2, "a session for each lane"
    for row in table_rows("Of the Zenoh configuration"):
        for config in opened:
            assert json.loads(config.get_json(plain(row["setting"]))) == json.loads(plain(row["value"])), row


def test_every_constant_that_the_text_names_is_in_the_table_of_periods():
    documented = {plain(row["constant"]).rpartition(".")[2] for row in table_rows("<!-- table: periods -->")}
    prose = re.sub(r"```.*?```", "", text(), flags=re.DOTALL)
    named = set(re.findall(r"`([A-Z][A-Z_]*_(?:S|NS|MS|STEPS|RANGES))`", prose))
    assert named
    assert named <= documented


def test_every_link_leads_to_a_heading():
    headings = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", text(), flags=re.DOTALL), re.MULTILINE)
    anchors = {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}
    assert set(re.findall(r"\]\(#([^)]*)\)", text())) <= anchors


def test_all_that_a_role_must_do_names_topics_there_are():
    known = {topic.name for topic in TOPICS} | {"policy_version"}
    for row in table_rows("## Replacing a service"):
        assert set(re.findall(r"`([a-z_/]+)`", row["it"])) <= known, row


# ------------------------------------------------------------------ example


def example_lines() -> list[tuple[bytes, str]]:
    _, _, after = text().partition("<!-- example: Action -->\n```\n")
    block = after.partition("```")[0]
    return [(bytes.fromhex(line[:70]), line[70:]) for line in block.splitlines()]


EXAMPLE = Action(
    actor_incarnation=1767225600000000000,
    incarnation=1767225590000000000,
    answered_seq=41,
    action=np.array([0.5, -1.0], np.float32),
    log_probability=-1.25,
    policy_version=3,
    received_ns=5_000_000,
    began_ns=5_100_000,
    sent_ns=5_400_000,
    offset_ns=-3_000_000,
    offset_bound_ns=200_000,
)


def test_the_example_is_the_payload_of_what_it_says():
    payload = b"".join(part for part, _ in example_lines())
    assert len(payload) == 231
    assert payload == encode(EXAMPLE)
    assert_same(program("client.py").decode(payload, "Action"), as_fields(EXAMPLE))


@pytest.mark.parametrize(("part", "meaning"), example_lines(), ids=lambda value: str(value)[:30])
def test_each_line_of_the_example_is_what_stands_beside_it(part, meaning):
    if match := re.fullmatch(r"(map|array) of (\d+)", meaning):
        code = {"map": 0x80, "array": 0x90}[match[1]]  # fixmap and fixarray of the msgpack specification
        assert part == bytes([code | int(match[2])])
    elif meaning.startswith("float32 "):
        assert np.frombuffer(msgpack.unpackb(part), "<f4").tolist() == json.loads(meaning.removeprefix("float32 "))
    else:
        assert msgpack.unpackb(part) == json.loads(meaning)


# ------------------------------------------------------------------ client.py


def test_the_examples_are_all_messages():
    assert {type(message) for message in EXAMPLES} == set(MESSAGES)


@every_example
def test_the_client_reads_what_a_service_writes_and_it_is_as_the_tables_say(message):
    name = type(message).__name__
    got = program("client.py").decode(encode(message), name)
    assert_same(got, as_fields(message))
    Tables(text()).check(name, got, dict(vars(SPEC.dimensions)))


@every_example
def test_a_service_reads_what_the_client_writes(message):
    payload = program("client.py").encode(type(message).__name__, **as_fields(message))
    assert_same(as_fields(decode(payload, type(message), SPEC.dimensions)), as_fields(message))


def test_the_client_refuses_another_message_schema_and_dtype():
    client = program("client.py")
    ours, newer = SCHEMA_VERSION, SCHEMA_VERSION + 1
    with pytest.raises(ValueError, match=f"expected Action of schema {ours}, got Command of schema {ours}"):
        client.decode(encode(Command("stop")), "Action")
    with pytest.raises(ValueError, match=f"got Command of schema {newer}"):
        client.decode(msgpack.packb({"schema": newer, "message": "Command", "name": "stop"}))
    with pytest.raises(ValueError, match="expected a dtype"):
        client.decode(msgpack.packb({"schema": ours, "message": "X", "x": ["|O", [1], b"12345678"]}))


def test_the_tables_refuse_what_is_not_as_they_say():
    tables, sizes = Tables(text()), dict(vars(SPEC.dimensions))
    good = as_fields(make_time_step(3))
    tables.check("TimeStep", good, dict(sizes))
    wrong = {
        "reward": -1,
        "seq": -1,
        "answered_seq": -2,
        "terminated": 0,
        "action_source": "guess",
        "proprioception": np.zeros(5),
        "action": np.zeros(3, np.float32),
        "frame_capture_ns": np.array([1, 2]),
        "published_ns": 2**62 + 1,
    }
    for name, value in wrong.items():
        with pytest.raises(AssertionError, match=name):
            tables.check("TimeStep", {**good, name: value}, dict(sizes))
    for fewer_or_more in ({**good, "more": 1}, {k: v for k, v in good.items() if k != "seq"}):
        with pytest.raises(AssertionError, match="TimeStep"):
            tables.check("TimeStep", fewer_or_more, dict(sizes))


# ------------------------------------------------------------------ observation.py


@pytest.mark.parametrize("size", [1, 2, 4])
def test_the_documented_frame_stacks_are_those_of_the_services(size):
    ours, theirs = FrameStack[np.ndarray](size), program("observation.py").FrameStacks(size)
    rng = np.random.default_rng(size)
    next_id, attempt, step_index, compared = 0, 0, 0, 0
    for seq in range(300):
        step_index = 0 if seq == 0 or rng.random() < 0.15 else step_index + 1
        attempt += step_index == 0
        count = 1 if seq == 0 else int(rng.integers(0, 4))
        ids = np.arange(next_id, next_id + count)
        next_id += count
        frames = np.repeat(ids, 2 * 3 * 1).reshape(count, 2, 3, 1).astype(np.uint8)
        step = make_time_step(
            seq, attempt=attempt, step_index=step_index, frame_ids=ids, frame_capture_ns=ids, frames=frames
        )
        stack = ours.add(step, ids, list(frames))
        got_ids, got = theirs.add(as_fields(step))
        assert stack is not None
        assert stack.whole
        assert list(stack.frame_ids) == got_ids
        np.testing.assert_array_equal(np.stack(stack.frames), got)
        compared += step_index > 0
    assert compared > 200


def test_a_client_that_comes_in_the_middle_of_an_attempt_waits_for_the_next():
    stacks = program("observation.py").FrameStacks(2)
    assert stacks.add(as_fields(make_time_step(5))) is None
    ids, frames = stacks.add(as_fields(make_time_step(6, step_index=0)))
    assert ids == [6, 6]
    assert frames.shape == (2, 6, 8, 3)


# ------------------------------------------------------------------ policy.py


class KeptNoise(np.random.Generator):
    """A generator that keeps the normal noise it has given."""

    def __init__(self) -> None:
        super().__init__(np.random.PCG64(1))
        self.noise = np.zeros(0)

    def standard_normal(self, *arguments: Any, **keywords: Any) -> Any:
        self.noise = super().standard_normal(*arguments, **keywords)
        return self.noise


def camera_spec() -> TaskSpec:
    return replace(SPEC, frame_shape=np.array([23, 19, 3]), crop_margin=np.array([2, 1]))


@pytest.mark.parametrize("dtype", ["float32", "float16"])
@pytest.mark.parametrize("spec", [camera_spec(), make_spec(camera=False)], ids=["camera", "no camera"])
def test_the_documented_policy_acts_as_ours(spec, dtype):
    policy, client, weights = program("policy.py"), program("client.py"), make_weights(spec, dtype)
    ours = policy_from_weights(spec, weights)
    received, fields_of_spec = client.decode(encode(weights)), client.decode(encode(spec))
    parameters = policy.parameters(received)
    rng = np.random.default_rng(2)
    for _ in range(5):
        proprioception = rng.normal(size=5).astype(np.float32)
        previous = rng.uniform(spec.action_low, spec.action_high).astype(np.float32)
        stack = rng.integers(0, 256, (4, 23, 19, 3), np.uint8) if spec.has_camera else None
        kept = KeptNoise()
        chosen = ours.act(Observation(stack, proprioception, previous), kept)
        distribution = policy.distribution(parameters, received, fields_of_spec, stack, proprioception, previous)
        action, log_probability = policy.act(*distribution, fields_of_spec, kept.noise)
        assert kept.noise.shape == (2,)
        np.testing.assert_allclose(action, chosen.action, atol=1e-5)
        assert log_probability == pytest.approx(chosen.log_probability, abs=1e-4)


def test_the_initial_policy_is_standard_normal_before_the_tanh():
    spec = make_spec(camera=False)
    policy = program("policy.py")
    parameters = initial_parameters(spec, 16, (), np.random.default_rng(0))
    mean, log_std = policy.distribution(
        parameters, {}, as_fields(spec), None, np.ones(5, np.float32), np.zeros(2, np.float32)
    )
    assert (mean.tolist(), log_std.tolist()) == ([0.0, 0.0], [0.0, 0.0])


def test_a_damaged_policy_is_refused_by_the_documented_program():
    policy, weights = program("policy.py"), as_fields(make_weights(make_spec(camera=False)))
    damaged = weights["buffer"].copy()
    damaged[0] ^= 1
    with pytest.raises(ValueError, match="digest"):
        policy.parameters({**weights, "buffer": damaged})
    with pytest.raises(ValueError, match="numbers, got"):
        policy.parameters({**weights, "shapes": weights["shapes"][:-1], "names": weights["names"][:-1]})


def test_every_service_is_in_the_tables_of_commands_and_counters():
    for title in ("The commands are", "What they are:"):
        assert [plain(row["service"]) for row in table_rows(title)] == list(SERVICES)


def test_experience_without_extras_is_nil_and_not_left_out():
    values = msgpack.unpackb(encode(make_experience(0)))
    assert values["extras"] is None
    assert set(values) == {"schema", "message", *(field.name for field in fields(Experience))}
    assert "schema" not in values["time_step"]
    assert set(values["time_step"]) == {field.name for field in fields(TimeStep)}
