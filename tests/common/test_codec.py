"""Messages survive the way through bytes, and whatever else arrives is a MessageError that names the field."""

from __future__ import annotations

import ast
import datetime
import random
import types
from dataclasses import dataclass, fields, is_dataclass, replace
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Annotated, Union, get_args, get_origin, get_type_hints

import msgpack
import numpy as np
import pytest

from common.codec import decode, encode
from common.errors import MessageError, SchemaVersionError
from common.messages import (
    MESSAGES,
    SCHEMA_VERSION,
    Acknowledgement,
    Action,
    ActionSource,
    ArrayMinibatch,
    Command,
    CommandReply,
    Credit,
    Dimensions,
    Experience,
    PolicyWeights,
    RowMinibatch,
    Status,
    TaskSpec,
    TimeStep,
)
from tests.helpers import make_experience, make_spec, make_time_step

ROOT = Path(__file__).parents[2]
WITH_CAMERA = Dimensions(A=2, P=5, H=6, W=8, C=3, S=4)
WITHOUT_CAMERA = Dimensions(A=2, P=5, H=0, W=0, C=0, S=0)
every_message = pytest.mark.parametrize("cls", MESSAGES, ids=lambda cls: cls.__name__)


def random_message(cls, rng, dimensions):
    """Return a message of any type with random contents, made from its fields' annotations."""
    return _random_fields(cls, rng, dict(vars(dimensions)))


def _random_fields(cls, rng, sizes):
    hints = get_type_hints(cls, include_extras=True)
    return cls(**{item.name: _random_value(hints[item.name], rng, sizes) for item in fields(cls)})


def _random_value(hint, rng, sizes):
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated and arguments[0] in (int, float):
        low = -1e6 if arguments[1].low is None else arguments[1].low
        high = 2.0**60 if arguments[1].high is None else arguments[1].high
        value = min(high, low + 2.0 ** rng.uniform(-1, 61))
        return int(value) if arguments[0] is int else value
    if origin is Annotated:
        rule = arguments[1]
        shape = [n if isinstance(n, int) else sizes.setdefault(n, int(rng.integers(0, 5))) for n in rule.shape]
        if np.dtype(rule.dtype).kind == "f":
            return rng.normal(size=shape).astype(rule.dtype)
        limits = np.iinfo(rule.dtype)
        return rng.integers(limits.min, limits.max, size=shape, dtype=rule.dtype, endpoint=True)
    if origin in (Union, types.UnionType):
        present = next(a for a in arguments if a is not type(None))
        return _random_value(present, rng, sizes) if rng.random() < 0.5 else None
    if origin is dict:
        return {f"key {i}": _random_value(arguments[1], rng, sizes) for i in range(rng.integers(0, 4))}
    if origin is list:
        return [_random_value(arguments[0], rng, sizes) for _ in range(rng.integers(0, 4))]
    if is_dataclass(hint):
        return _random_fields(hint, rng, sizes)
    if issubclass(hint, StrEnum):
        return list(hint)[rng.integers(len(hint))]
    return {
        bool: lambda: bool(rng.random() < 0.5),
        int: lambda: int(rng.integers(-(2**40), 2**40)),
        float: lambda: float(rng.normal()),
        str: lambda: "".join(rng.choice(list("abcµ語😀 "), size=rng.integers(0, 9))),
    }[hint]()


def assert_same(one, other, where=""):
    """Fail unless two messages are equal, types and arrays included."""
    assert type(one) is type(other), where
    if is_dataclass(one):
        for item in fields(one):
            assert_same(getattr(one, item.name), getattr(other, item.name), f"{where}.{item.name}")
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype, where
        np.testing.assert_array_equal(one, other, err_msg=where)
    else:
        assert one == other, where


def unpacked(message):
    return msgpack.unpackb(encode(message))


def changed(message, path, value):
    """Return the payload of ``message`` with another value at ``path``, for example ``time_step.reward``."""
    values = unpacked(message)
    table = values
    *outer, last = path.split(".")
    for name in outer:
        table = table[name]
    table[last] = value
    return msgpack.packb(values)


def array(dtype, *shape, raw=None):
    """Return an array as it stands in a payload."""
    data = np.zeros(shape, dtype)
    return [data.dtype.str, list(shape), data.tobytes() if raw is None else raw]


@cache
def example(cls):
    """Return one message with contents in every field."""
    return random_message(cls, np.random.default_rng(5), WITH_CAMERA)


# ------------------------------------------------------------------ round trips


@pytest.mark.parametrize("dimensions", [WITH_CAMERA, WITHOUT_CAMERA], ids=["camera", "no camera"])
@every_message
def test_a_message_comes_back_as_it_was(cls, dimensions):
    for seed in range(20):
        message = random_message(cls, np.random.default_rng(seed), dimensions)
        assert_same(decode(encode(message), cls, dimensions), message)
        assert_same(decode(encode(message), cls), message)


def test_realistic_messages_fit_the_dimensions_of_their_task():
    for spec in (make_spec(), make_spec(camera=False)):
        for seq in (0, 1):
            experience = make_experience(seq, spec)
            assert_same(decode(encode(experience), Experience, spec.dimensions), experience)
        assert_same(decode(encode(spec), TaskSpec), spec)


def test_extreme_numbers_come_back_exactly():
    extremes = np.array([[np.finfo(np.float32).max, -np.finfo(np.float32).tiny, -0.0, 1e-45, 1 / 3]], np.float32)[0]
    step = make_time_step(proprioception=extremes, reward=5e-324, answered_seq=-1)
    decoded = decode(encode(step), TimeStep, WITH_CAMERA)
    assert decoded.proprioception.tobytes() == extremes.tobytes()
    assert decoded.reward == 5e-324


def test_numpy_scalars_travel_as_plain_numbers():
    step = make_time_step(reward=np.float32(-0.25), terminated=np.bool_(True), seq=np.int64(3))
    decoded = decode(encode(step), TimeStep)
    assert (decoded.reward, decoded.terminated, decoded.seq) == (-0.25, True, 3)
    assert [type(v) for v in (decoded.reward, decoded.terminated, decoded.seq)] == [float, bool, int]


def test_arrays_that_are_not_contiguous_travel_in_their_logical_order():
    frames = np.arange(6 * 8 * 3 * 4, dtype=np.uint8).reshape(4, 6, 8, 3)
    ids = np.arange(4)
    strided = make_time_step(frames=frames[::2, ::-1], frame_ids=ids[::2], frame_capture_ns=ids[1::2])
    decoded = decode(encode(strided), TimeStep, WITH_CAMERA)
    np.testing.assert_array_equal(decoded.frames, frames[[0, 2]][:, ::-1])
    np.testing.assert_array_equal(decoded.frame_capture_ns, [1, 3])
    assert decode(encode(make_time_step(frames=np.asfortranarray(frames[:1]))), TimeStep).frames[0, 0, 1, 2] == 5


def test_decoded_arrays_are_read_only():
    decoded = decode(encode(make_time_step()), TimeStep)
    for name in ("frames", "frame_ids", "proprioception", "action"):
        assert not getattr(decoded, name).flags.writeable, name
    with pytest.raises(ValueError, match="read-only"):
        decoded.frames[:] = 0


def test_an_array_travels_as_its_raw_bytes():
    step = make_time_step()
    assert unpacked(step)["frames"] == ["|u1", [1, 6, 8, 3], step.frames.tobytes()]
    assert unpacked(step)["proprioception"] == ["<f4", [5], step.proprioception.tobytes()]
    assert len(encode(step)) - len(encode(replace(step, frames=np.zeros((0, 6, 8, 3), np.uint8)))) < 6 * 8 * 3 + 8


def test_a_payload_states_schema_and_message():
    values = unpacked(Command("stop"))
    assert values == {"schema": SCHEMA_VERSION, "message": "Command", "name": "stop"}


def test_an_integer_is_accepted_where_a_number_is_wanted():
    decoded = decode(changed(make_time_step(), "reward", -3), TimeStep)
    assert decoded.reward == -3.0
    assert type(decoded.reward) is float


# ------------------------------------------------------------------ the envelope


@pytest.mark.parametrize("version", [SCHEMA_VERSION + 1, 0, -1, None, "1", 1.5, True, [1], {}])
def test_another_schema_version_is_told_apart_from_other_errors(version):
    with pytest.raises(SchemaVersionError, match=f"expected schema version {SCHEMA_VERSION}, got"):
        decode(changed(Command("stop"), "schema", version), Command)


def test_a_payload_without_schema_version_is_refused():
    with pytest.raises(SchemaVersionError, match="got None"):
        decode(msgpack.packb({"message": "Command", "name": "stop"}), Command)


def test_another_message_is_refused_by_name():
    with pytest.raises(MessageError, match=r"expected message Command, got 'Credit'$"):
        decode(encode(Credit(1, 2, 3)), Command)


@pytest.mark.parametrize("name", ["Telegram", "command", "", None, 3, ["Command"], {"Command": 1}, b"Command"])
def test_a_message_that_this_release_does_not_know_is_refused(name):
    with pytest.raises(MessageError, match=r"expected message Command, got .*unknown to this release"):
        decode(changed(Command("stop"), "message", name), Command)


def test_a_message_inside_another_has_no_envelope_of_its_own():
    assert not {"schema", "message"} & unpacked(make_experience())["time_step"].keys()


@every_message
def test_every_truncation_is_refused(cls):
    payload = encode(example(cls))
    for length in range(len(payload)):
        with pytest.raises(MessageError):
            decode(payload[:length], cls)


@every_message
def test_bytes_after_the_message_are_refused(cls):
    with pytest.raises(MessageError, match="are not one msgpack value"):
        decode(encode(example(cls)) + b"\0", cls)


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xc1",  # never used in msgpack
        b"\xff" * 100,
        msgpack.packb(None),
        msgpack.packb(7),
        msgpack.packb("text"),
        msgpack.packb([1, 2, 3]),
        msgpack.packb({1: 2}),
        msgpack.packb({b"schema": 1}),
        b"\x81\xc0\xc0",  # a map whose key is nil
        b"\x81\x90\xc0",  # a map whose key is a list, which cannot be one
        b"\x91" * 5000 + b"\xc0",  # nested deeper than any message
        b"\x81\xa1a" * 5000 + b"\xc0",
        b"\xdd\xff\xff\xff\xff",  # a list that claims 4 billion items
        b"\xdf\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\xa4\xff\xfe\xfd\xfc",  # text that is not UTF-8
        b"\xc7\x03\xff\x00\x00\x00",  # a time of impossible length
        b"\xc7\x0c\xff" + b"\xff" * 12,  # a time with impossible nanoseconds
    ],
)
def test_bytes_that_are_no_message_are_refused(payload):
    with pytest.raises(MessageError):
        decode(payload, Command)


# ------------------------------------------------------------------ fields


@every_message
def test_each_missing_field_is_named(cls):
    for item in fields(cls):
        values = unpacked(example(cls))
        del values[item.name]
        with pytest.raises(MessageError, match=rf"{cls.__name__}: missing fields \['{item.name}'\]"):
            decode(msgpack.packb(values), cls)


@every_message
def test_an_unknown_field_is_named(cls):
    with pytest.raises(MessageError, match=r"missing fields \[\], unknown fields \['surprise'\]"):
        decode(changed(example(cls), "surprise", 1), cls)


def test_a_renamed_field_is_missing_and_unknown():
    values = unpacked(Command("stop"))
    values["nom"] = values.pop("name")
    with pytest.raises(MessageError, match=r"missing fields \['name'\], unknown fields \['nom'\]"):
        decode(msgpack.packb(values), Command)


def test_a_field_whose_name_is_bytes_is_unknown():
    values = {**unpacked(Command("stop")), b"name": "stop"}
    with pytest.raises(MessageError, match="unknown fields"):
        decode(msgpack.packb(values), Command)


@pytest.mark.parametrize(
    ("message", "path", "value", "expected"),
    [
        # booleans are no numbers, numbers no booleans
        (make_time_step(), "seq", True, "TimeStep.seq: expected int, got bool"),
        (make_time_step(), "reward", False, "TimeStep.reward: expected float, got bool"),
        (make_time_step(), "terminated", 1, "TimeStep.terminated: expected bool, got int"),
        (make_time_step(), "terminated", None, "TimeStep.terminated: expected bool, got NoneType"),
        # numbers
        (make_time_step(), "seq", 1.0, "TimeStep.seq: expected int, got float"),
        (make_time_step(), "seq", "1", "TimeStep.seq: expected int, got str"),
        (make_time_step(), "seq", None, "TimeStep.seq: expected int, got NoneType"),
        (make_time_step(), "seq", -1, r"TimeStep.seq: expected a value in \[0, .*\], got -1"),
        (make_time_step(), "seq", 2**63, rf"TimeStep.seq: expected a value in \[0, .*\], got {2**63}"),
        (make_time_step(), "answered_seq", -2, r"TimeStep.answered_seq: expected a value in \[-1, .*\], got -2"),
        (make_time_step(), "reward", float("nan"), "TimeStep.reward: expected a finite number, got nan"),
        (make_time_step(), "reward", float("-inf"), "TimeStep.reward: expected a finite number, got -inf"),
        (make_time_step(), "reward", b"0", "TimeStep.reward: expected float, got bytes"),
        (make_spec(), "action_cycle_time_s", 0, r"TaskSpec.action_cycle_time_s: .*\[0.0001, 60.0\], got 0"),
        (make_spec(), "action_cycle_time_s", 60.001, r"TaskSpec.action_cycle_time_s: .* got 60.001"),
        (make_spec(), "time_limit_steps", 0, r"TaskSpec.time_limit_steps: expected a value in \[1, None\], got 0"),
        (Acknowledgement(1, 2, np.zeros((0, 2), np.int64), 0.0), "updates_owed", -0.5, "updates_owed: .* got -0.5"),
        # text
        (Command("stop"), "name", 3, "Command.name: expected str, got int"),
        (Command("stop"), "name", b"stop", "Command.name: expected str, got bytes"),
        (CommandReply(True, ""), "detail", None, "CommandReply.detail: expected str, got NoneType"),
        (make_time_step(), "action_source", "magic", r"TimeStep.action_source: expected one of \['none', .*'magic'"),
        (make_time_step(), "action_source", "POLICY", "TimeStep.action_source: expected one of"),
        (make_time_step(), "action_source", ["policy"], "TimeStep.action_source: expected one of"),
        (make_time_step(), "action_source", None, "TimeStep.action_source: expected one of"),
        # tables and lists
        (
            Status("actor", "r", "robot0", 1, "running", {}, {}),
            "counters",
            [],
            "Status.counters: expected dict, got list",
        ),
        (
            Status("actor", "r", "robot0", 1, "running", {}, {}),
            "counters",
            {"steps": "many"},
            r"Status.counters\[steps\]: expected float",
        ),
        (
            Status("actor", "r", "robot0", 1, "running", {}, {}),
            "counters",
            {"loss": float("nan")},
            r"Status.counters\[loss\]: .*finite",
        ),
        (make_spec(), "algorithm_presets", {"sac": 1}, r"TaskSpec.algorithm_presets\[sac\]: expected str, got int"),
        (example(PolicyWeights), "names", "weight", "PolicyWeights.names: expected list, got str"),
        (example(PolicyWeights), "names", ["a", 1], "PolicyWeights.names: expected str, got int"),
        (example(PolicyWeights), "shapes", [[1], [2.5]], "PolicyWeights.shapes: expected int, got float"),
        (example(PolicyWeights), "shapes", [3], "PolicyWeights.shapes: expected list, got int"),
        # a field inside a message inside a message
        (make_experience(), "time_step", None, "Experience.time_step: expected a map, got NoneType"),
        (make_experience(), "time_step", [1], "Experience.time_step: expected a map, got list"),
        (make_experience(), "time_step.reward", "3", "Experience.time_step.reward: expected float, got str"),
        (make_experience(), "time_step.extra", 1, r"Experience.time_step: .*unknown fields \['extra'\]"),
        (make_experience(), "time_step.action", array("f4", 3), r"Experience.time_step.action: .* shape \(2\)"),
        (make_experience(), "extras.policy_version", -1, "Experience.extras.policy_version: expected a value in"),
        (make_experience(), "extras", "none", "Experience.extras: expected a map, got str"),
    ],
)
def test_a_wrong_value_is_refused_with_its_path(message, path, value, expected):
    with pytest.raises(MessageError, match=expected):
        decode(changed(message, path, value), type(message), WITH_CAMERA)


def test_extras_may_be_absent():
    decoded = decode(changed(make_experience(), "extras", None), Experience, WITH_CAMERA)
    assert decoded.extras is None


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (None, r"expected \[dtype, shape, bytes\], got NoneType"),
        (b"\0\0\0\0", r"expected \[dtype, shape, bytes\], got bytes"),
        ([], r"expected \[dtype, shape, bytes\]"),
        ([1.0, 2.0], r"expected \[dtype, shape, bytes\]"),
        (["<f4", [2], b"\0" * 8, 1], r"expected \[dtype, shape, bytes\]"),
        ({"<f4": 1}, r"expected \[dtype, shape, bytes\], got dict"),
        (array("f8", 2), "expected dtype <f4, got '<f8'"),
        (array("i4", 2), "expected dtype <f4, got '<i4'"),
        (array(">f4", 2), "expected dtype <f4, got '>f4'"),
        (["|O", [2], b"\0" * 16], r"expected dtype <f4, got '\|O'"),
        (["float32", [2], b"\0" * 8], "expected dtype <f4, got 'float32'"),
        ([None, [2], b"\0" * 8], "expected dtype <f4, got None"),
        ([["<f4"], [2], b"\0" * 8], r"expected dtype <f4, got \['<f4'\]"),
        (array("f4", 3), r"expected shape \(2\), got \[3\]"),
        (array("f4"), r"expected shape \(2\), got \[\]"),
        (array("f4", 2, 1), r"expected shape \(2\), got \[2, 1\]"),
        (["<f4", 2, b"\0" * 8], r"expected shape \(2\), got 2"),
        (["<f4", None, b"\0" * 8], r"expected shape \(2\), got None"),
        (["<f4", [-2], b"\0" * 8], r"expected shape \(2\), got \[-2\]"),
        (["<f4", [2.0], b"\0" * 8], r"expected shape \(2\), got \[2.0\]"),
        (["<f4", [True], b"\0" * 4], r"expected shape \(2\), got \[True\]"),
        (["<f4", ["2"], b"\0" * 8], r"expected shape \(2\), got \['2'\]"),
        (array("f4", 2, raw=b"\0" * 7), r"\[2\] of float32 do not fit the bytes"),
        (array("f4", 2, raw=b"\0" * 9), r"\[2\] of float32 do not fit the bytes"),
        (array("f4", 2, raw=b""), r"\[2\] of float32 do not fit the bytes"),
        (array("f4", 2, raw="\0" * 8), r"\[2\] of float32 do not fit the bytes"),
        (array("f4", 2, raw=[0, 0]), r"\[2\] of float32 do not fit the bytes"),
        (["<f4", [2], None], r"\[2\] of float32 do not fit the bytes"),
        (array("f4", 2, raw=np.array([0, np.nan], np.float32).tobytes()), "expected finite numbers"),
        (array("f4", 2, raw=np.array([np.inf, 0], np.float32).tobytes()), "expected finite numbers"),
        (array("f4", 2, raw=np.array([0, -np.inf], np.float32).tobytes()), "expected finite numbers"),
        (array("f4", 2, raw=np.array([np.inf, -np.inf], np.float32).tobytes()), "expected finite numbers"),
    ],
)
def test_a_wrong_array_is_refused_with_what_was_expected(value, expected):
    action = Action(1, 2, 3, np.zeros(2, np.float32), -1.0, 4, 5, 6, 7, 8, 9)
    with pytest.raises(MessageError, match=f"^Action.action: {expected}"):
        decode(changed(action, "action", value), Action, WITH_CAMERA)


@pytest.mark.parametrize("size", [1, 2, 63, 64, 65, 1000])
def test_one_number_that_is_not_finite_is_found_among_few_and_among_many(size):
    for wrong in (np.nan, np.inf, -np.inf):
        values = np.full(size, np.finfo(np.float32).max, np.float32)  # their sum is finite
        action = Action(1, 2, 3, values, -1.0, 4, 5, 6, 7, 8, 9)
        assert_same(decode(encode(action), Action), action)
        values[-1] = wrong
        with pytest.raises(MessageError, match=r"^Action.action: expected finite numbers, got NaN or infinity"):
            decode(encode(action), Action)


def test_equal_letters_mean_equal_sizes_within_a_message():
    step = make_time_step(frame_ids=np.arange(2), frame_capture_ns=np.arange(2))  # and one frame
    with pytest.raises(MessageError, match=r"TimeStep.frames: expected shape \(2, 6, 8, 3\), got \[1, 6, 8, 3\]"):
        decode(encode(step), TimeStep, WITH_CAMERA)


def test_sizes_of_the_task_bind_even_where_the_message_agrees_with_itself():
    step = make_time_step(spec=make_spec(camera=False))
    with pytest.raises(MessageError, match=r"TimeStep.frames: expected shape \(0, 6, 8, 3\), got \[0, 0, 0, 0\]"):
        decode(encode(step), TimeStep, WITH_CAMERA)


def test_without_a_task_a_message_must_still_agree_with_itself():
    spec = make_spec(action_high=np.ones(3, np.float32))
    with pytest.raises(MessageError, match=r"TaskSpec.action_high: expected shape \(2\), got \[3\]"):
        decode(encode(spec), TaskSpec)


def test_free_letters_are_free_from_message_to_message():
    for rows in (0, 1, 5):
        decoded = decode(encode(RowMinibatch(1, 0, np.arange(rows))), RowMinibatch, WITH_CAMERA)
        assert decoded.rows.tolist() == list(range(rows))


def test_a_number_in_a_shape_is_not_free():
    acknowledgement = Acknowledgement(1, 2, np.zeros((1, 3), np.int64), 0.0)
    with pytest.raises(MessageError, match=r"missing: expected shape \(1, 2\), got \[1, 3\]"):
        decode(encode(acknowledgement), Acknowledgement)


@pytest.mark.parametrize("shape", [[2**31, 0, 0, 0], [2**63, 0, 0, 0], [2**64 - 1, 0, 0, 0]])
def test_an_array_without_contents_that_claims_to_be_huge_does_no_harm(shape):
    minibatch = random_message(ArrayMinibatch, np.random.default_rng(0), WITHOUT_CAMERA)
    payload = changed(minibatch, "frames", ["|u1", shape, b""])
    decoded = decodes_or_is_refused(payload, ArrayMinibatch, WITHOUT_CAMERA)
    assert decoded is None or decoded.frames.nbytes == 0


def test_an_error_stays_short_however_long_what_came_is():
    long = "x" * 1_000_000
    for path, value in (("action_source", long), ("action", [long, [2], b""]), ("action", ["<f4", [long], b""])):
        with pytest.raises(MessageError) as caught:
            decode(changed(make_time_step(), path, value), TimeStep)
        assert len(str(caught.value)) < 1000
    for path in ("schema", "message", long):
        with pytest.raises(MessageError) as caught:
            decode(changed(Command("stop"), path, long), Command)
        assert len(str(caught.value)) < 1000
    with pytest.raises(MessageError) as caught:
        decode(changed(Status("actor", "r", "robot0", 1, "running", {}, {}), "counters", {long: None}), Status)
    assert len(str(caught.value)) < 1000


# ------------------------------------------------------------------ at random


def decodes_or_is_refused(payload, cls, dimensions):
    """Decode; any exception but a MessageError fails the test."""
    try:
        return decode(payload, cls, dimensions)
    except MessageError:
        return None


def test_random_bytes_are_refused():
    rng = random.Random(1)
    for _ in range(5000):
        payload = rng.randbytes(rng.randrange(0, 200))
        assert decodes_or_is_refused(payload, rng.choice(MESSAGES), WITH_CAMERA) is None


@every_message
def test_damaged_payloads_give_a_valid_message_or_a_message_error(cls):
    rng = random.Random(cls.__name__)
    payload = encode(example(cls))
    for _ in range(1500):
        damaged = bytearray(payload)
        for _ in range(rng.randint(1, 4)):
            start = rng.randrange(len(damaged))
            end = min(len(damaged), start + rng.randint(0, 8))
            damaged[start:end] = rng.randbytes(rng.choice([end - start, 0, 1, 9]))
        decoded = decodes_or_is_refused(bytes(damaged), cls, WITH_CAMERA)
        if decoded is not None:
            assert_same(decode(encode(decoded), cls, WITH_CAMERA), decoded)


ODD_VALUES = [
    None,
    True,
    -1,
    2**64 - 1,
    -(2**63),
    0.5,
    float("nan"),
    float("inf"),
    "",
    "text",
    b"",
    b"bytes",
    [],
    [None],
    [[], {}, b""],
    {},
    {"": None},
    ["|u1", [2**64 - 1], b""],
    ["<f4", [0, 2**63], b""],
    ["|V0", [], b""],
    msgpack.ExtType(7, b"ext"),
    datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC),
]


@every_message
def test_odd_values_in_any_field_give_a_message_or_a_message_error(cls):
    values = unpacked(example(cls))
    for path in ["schema", "message", *_paths(values)]:
        for odd in ODD_VALUES:
            payload = unpacked(example(cls))
            _put(payload, path, odd)
            for dimensions in (WITH_CAMERA, WITHOUT_CAMERA, None):
                decodes_or_is_refused(msgpack.packb(payload, datetime=True), cls, dimensions)


def _paths(values, outer=()):
    """Yield the way to every value in a payload, those inside arrays' triples and tables included."""
    items = values.items() if isinstance(values, dict) else enumerate(values)
    for name, value in items:
        yield (*outer, name)
        if isinstance(value, (dict, list)):
            yield from _paths(value, (*outer, name))


def _put(values, path, value):
    *outer, last = [path] if isinstance(path, str) else path
    for name in outer:
        values = values[name]
    values[last] = value


# ------------------------------------------------------------------ never pickle


def test_nothing_that_a_peer_sends_is_unpickled():
    """No file of the system imports what executes data, and NumPy's files are opened without pickles."""
    executing = {"pickle", "cPickle", "marshal", "shelve", "dill", "cloudpickle", "joblib"}
    for path in [p for folder in ("common", "services", "deploy") for p in (ROOT / folder).rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                assert not executing & {alias.name.split(".")[0] for alias in node.names}, path
            if isinstance(node, ast.ImportFrom):
                assert (node.module or "").split(".")[0] not in executing, path
            if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
                assert ast.literal_eval(node.value) is False, path
            if isinstance(node, ast.keyword) and node.arg == "weights_only":
                assert ast.literal_eval(node.value) is True, path
            if isinstance(node, ast.Name):
                assert node.id not in ("eval", "exec"), path


def test_what_is_no_message_of_the_table_is_refused_on_arrival():
    @dataclass
    class Stranger:
        value: int

    with pytest.raises(MessageError, match=r"got 'Stranger' \(unknown to this release\)"):
        decode(encode(Stranger(1)), Command)


def test_the_action_source_comes_back_as_the_enumeration():
    assert decode(encode(make_time_step()), TimeStep).action_source is ActionSource.POLICY
