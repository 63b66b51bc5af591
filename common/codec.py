"""Messages to bytes and back, by msgpack.

Not pickle: a pickle executes what a peer sends. A payload is one msgpack map: ``schema`` (version), ``message``
(type name) and the message's fields; an array is ``[dtype, shape, raw little-endian bytes]``. Decoding checks type,
shape, dtype, finiteness and bounds, so that what a service receives is safe to use as it is. Decoded arrays are
read-only views of bytes: of the payload itself for the large array of :data:`BULK_FIELDS`. Encoded camera frames keep
their bytes, to be sent on unchanged, beside the pixels.
"""

from __future__ import annotations

import math
import reprlib
import sys
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import StrEnum
from functools import cache
from itertools import chain
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import msgpack
import numpy as np
import numpy.typing as npt

from common.bulk_payload import Seal, pack_bulk, unpack_bulk
from common.errors import MessageError, SchemaVersionError
from common.frame_encoding import EncodedFrames, FrameEncoding
from common.messages import (
    MESSAGES,
    SCHEMA_VERSION,
    Array,
    ArrayMinibatch,
    Bounds,
    CameraFrames,
    Dimensions,
    PolicyWeights,
)

Message = TypeVar("Message")
Sizes = dict[str, Any]
"""Values of :class:`Dimensions`, and of the letters that a message uses besides."""
Decoder = Callable[[Any, str, Sizes], Any]

_UNBOUNDED = Bounds()
_LARGEST = sys.float_info.max
_FEW = 64
"""Numbers of an array that are looked at one by one."""
_shown = reprlib.repr
"""Text of what came, short enough for a log whatever it is."""
_BY_NAME = {message.__name__: message for message in MESSAGES}
BULK_FIELDS: dict[type, str] = {PolicyWeights: "buffer", ArrayMinibatch: "frames"}
"""Of messages with megabytes in one array: its field, which comes last (:mod:`common.bulk_payload`)."""


def encode(message: Any) -> bytes:
    """Return the payload of a message of :data:`common.messages.MESSAGES`."""
    bulk = BULK_FIELDS.get(type(message))
    if bulk is not None:
        values = dict(vars(message))
        array = values.pop(bulk)
        head = {"schema": SCHEMA_VERSION, "message": type(message).__name__, **values}
        return pack_bulk(head, bulk, array.dtype.str, array.shape, [np.ascontiguousarray(array)], _plain)
    values = {"schema": SCHEMA_VERSION, "message": type(message).__name__, **vars(message)}
    packed = msgpack.packb(values, default=_plain, use_bin_type=True)
    assert isinstance(packed, bytes)
    return packed


def encode_gathered(
    message: type, values: Mapping[str, Any], pieces: Sequence[npt.NDArray[Any]], seal: Seal | None = None
) -> bytes:
    """Return the payload of a message of :data:`BULK_FIELDS` whose large array is bytes that lie in several places.

    Args:
        message: the message's type.
        values: its other fields.
        pieces: contiguous arrays, whose bytes follow each other in the message.
        seal: makes one of ``values`` while it copies the pieces.
    """
    head = {"schema": SCHEMA_VERSION, "message": message.__name__, **values}
    return pack_bulk(head, BULK_FIELDS[message], "|u1", [sum(piece.nbytes for piece in pieces)], pieces, _plain, seal)


def decode(payload: bytes, expected: type[Message], dimensions: Dimensions | None = None) -> Message:
    """Return the message in ``payload``.

    Args:
        payload: bytes made by :func:`encode` of this or another implementation.
        expected: the type that belongs on the key expression the payload arrived on.
        dimensions: sizes the arrays must have, and the encoding of frames; None accepts any encoding, and any sizes
            that agree with each other.

    Raises:
        SchemaVersionError: the sender speaks another schema version.
        MessageError: anything else is wrong; the text names the field, what was expected and what came.
    """
    name = expected.__name__
    try:
        values = unpack_bulk(payload) if expected in BULK_FIELDS else None
        if values is None:
            values = msgpack.unpackb(payload, raw=False, strict_map_key=True)
    except (ValueError, msgpack.UnpackException, RecursionError) as error:
        raise MessageError(f"{name}: {len(payload)} bytes are not one msgpack value: {error}") from error
    if not isinstance(values, dict):
        raise MessageError(f"{name}: expected a msgpack map, got {type(values).__name__}")
    schema = values.pop("schema", None)
    if type(schema) is not int or schema != SCHEMA_VERSION:
        raise SchemaVersionError(
            f"{name}: expected schema version {SCHEMA_VERSION}, got {_shown(schema)}; "
            "run the same release on all computers"
        )
    message = values.pop("message", None)
    if message != name:
        known = "" if isinstance(message, str) and message in _BY_NAME else " (unknown to this release)"
        raise MessageError(f"expected message {name}, got {_shown(message)}{known}")
    sizes = {} if dimensions is None else dict(vars(dimensions))
    decoded: Message = _decode_dataclass(expected, values, name, sizes)
    return decoded


def _plain(value: Any) -> Any:
    """Return what msgpack packs instead of something it does not know."""
    if isinstance(value, np.ndarray):
        contiguous = np.ascontiguousarray(value)
        return [value.dtype.str, list(value.shape), contiguous.data if contiguous.size else b""]
    if isinstance(value, EncodedFrames):
        return [value.encoding, value.shape, value.parts, value.digest]
    if isinstance(value, np.generic):
        return value.item()
    return vars(value)


@dataclass(frozen=True)
class _Plan:
    """How to decode one message type. Looked up once per message, so that little code runs on a cold processor."""

    names: frozenset[str]
    numbers: tuple[tuple[str, Any, float, float, Bounds], ...]
    """Name, type, finite inclusive bounds to compare with at once, and the declared ones."""
    others: tuple[tuple[str, Decoder], ...]


@cache
def _plan(cls: Any) -> _Plan:
    hints = get_type_hints(cls, include_extras=True)
    numbers: list[tuple[str, Any, float, float, Bounds]] = []
    others: list[tuple[str, Decoder]] = []
    for item in fields(cls):
        hint, bounds = hints[item.name], _UNBOUNDED
        if get_origin(hint) is Annotated and isinstance(get_args(hint)[1], Bounds):
            hint, bounds = get_args(hint)
        if hint in (int, float):
            low = -_LARGEST if bounds.low is None else bounds.low
            high = _LARGEST if bounds.high is None else bounds.high
            numbers.append((item.name, hint, low, high, bounds))
        else:
            others.append((item.name, _decoder(hint)))
    return _Plan(frozenset(hints), tuple(numbers), tuple(others))


def _decode_dataclass(cls: Any, values: Any, where: str, sizes: Sizes) -> Any:
    if not isinstance(values, dict):
        raise MessageError(f"{where}: expected a map, got {type(values).__name__}")
    plan = _plan(cls)
    if values.keys() != plan.names:
        missing, unknown = sorted(plan.names - values.keys()), sorted(map(str, values.keys() - plan.names))
        raise MessageError(f"{where}: missing fields {missing}, unknown fields {_shown(unknown)}")
    for name, kind, low, high, bounds in plan.numbers:
        value = values[name]
        # Not a number is not within any bounds either.
        if type(value) is not kind or not low <= value <= high:
            values[name] = _number(kind, value, f"{where}.{name}", bounds)
    for name, decoder in plan.others:
        values[name] = decoder(values[name], f"{where}.{name}", sizes)
    # As the generated constructor of a frozen dataclass would, but all fields in one call.
    decoded = object.__new__(cls)
    vars(decoded).update(values)
    return decoded


def _decoder(hint: Any, bounds: Bounds = _UNBOUNDED) -> Decoder:
    """Return the function that checks and converts one field."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        inner, rule = arguments
        if isinstance(rule, CameraFrames):
            return _frames_decoder(np.dtype(rule.dtype), rule.shape)
        return _array_decoder(np.dtype(rule.dtype), rule.shape) if isinstance(rule, Array) else _decoder(inner, rule)
    if origin in (Union, types.UnionType):
        present = _decoder(next(a for a in arguments if a is not type(None)))
        return lambda value, where, sizes: None if value is None else present(value, where, sizes)
    if origin is dict:
        element = _decoder(arguments[1])
        return lambda value, where, sizes: {
            _text(key, where): element(item, f"{where}[{key:.40}]", sizes)
            for key, item in _instance(value, dict, where).items()
        }
    if origin is list:
        element = _decoder(arguments[0])
        if arguments[0] in (str, int):
            return _plain_list_decoder(arguments[0], element)
        if arguments[0] == list[int]:
            return _nested_list_decoder(element)
        return lambda value, where, sizes: [element(item, where, sizes) for item in _instance(value, list, where)]
    if isinstance(hint, type) and is_dataclass(hint):
        return lambda value, where, sizes: _decode_dataclass(hint, value, where, sizes)
    if issubclass(hint, StrEnum):
        return _enumeration_decoder(hint)
    if hint is bool:
        return lambda value, where, sizes: _instance(value, bool, where)
    if hint is str:
        return lambda value, where, sizes: value if type(value) is str else _text(value, where)
    low = -_LARGEST if bounds.low is None else bounds.low
    high = _LARGEST if bounds.high is None else bounds.high
    return lambda value, where, sizes: (
        value if type(value) is hint and low <= value <= high else _number(hint, value, where, bounds)
    )


def _plain_list_decoder(kind: type, element: Decoder) -> Decoder:
    """Return what decodes a list of texts or of any integers: if their types are right, so are they."""
    kinds = {kind}

    def decode_list(value: Any, where: str, sizes: Sizes) -> list[Any]:
        if type(value) is list and kinds.issuperset(map(type, value)):
            return value
        return [element(item, where, sizes) for item in _instance(value, list, where)]

    return decode_list


def _nested_list_decoder(element: Decoder) -> Decoder:
    """Return what decodes a list of lists of any integers: if all their types are right, so are they."""
    lists, integers = {list}, {int}

    def decode_lists(value: Any, where: str, sizes: Sizes) -> list[Any]:
        if (
            type(value) is list
            and lists.issuperset(map(type, value))
            and integers.issuperset(map(type, chain.from_iterable(value)))
        ):
            return value
        return [element(item, where, sizes) for item in _instance(value, list, where)]

    return decode_lists


def _instance(value: Any, cls: type, where: str) -> Any:
    if not isinstance(value, cls):
        raise MessageError(f"{where}: expected {cls.__name__}, got {type(value).__name__}")
    return value


def _text(value: Any, where: str) -> str:
    text: str = _instance(value, str, where)
    return text


def _enumeration(cls: type[StrEnum], value: Any, where: str) -> StrEnum:
    try:
        return cls(value)
    except ValueError:
        raise MessageError(f"{where}: expected one of {[m.value for m in cls]}, got {_shown(value)}") from None


def _enumeration_decoder(cls: type[StrEnum]) -> Decoder:
    members: dict[str, StrEnum] = {member.value: member for member in cls}

    def decode_enumeration(value: Any, where: str, sizes: Sizes) -> StrEnum:
        # A look-up, because an enumeration's constructor is a good deal of code.
        member = members.get(value) if type(value) is str else None
        return member if member is not None else _enumeration(cls, value, where)

    return decode_enumeration


def _number(kind: type, value: Any, where: str, bounds: Bounds) -> Any:
    accepted = (int, float) if kind is float else (int,)
    if not isinstance(value, accepted) or isinstance(value, bool):
        raise MessageError(f"{where}: expected {kind.__name__}, got {type(value).__name__}")
    if not math.isfinite(value):
        raise MessageError(f"{where}: expected a finite number, got {value}")
    low, high = bounds.low, bounds.high
    if (low is not None and value < low) or (high is not None and value > high):
        raise MessageError(f"{where}: expected a value in [{low}, {high}], got {value}")
    return kind(value)


def _array_decoder(dtype: np.dtype[Any], shape: tuple[str | int, ...]) -> Decoder:
    code, item_size, is_float = dtype.str, dtype.itemsize, dtype.kind == "f"

    def decode_array(value: Any, where: str, sizes: Sizes) -> np.ndarray[Any, Any]:
        if not (isinstance(value, list) and len(value) == 3):
            raise MessageError(f"{where}: expected [dtype, shape, bytes], got {type(value).__name__}")
        sent_dtype, sent_shape, raw = value
        if sent_dtype != code:
            raise MessageError(f"{where}: expected dtype {code}, got {_shown(sent_dtype)}")
        _check_shape(sent_shape, shape, where, sizes)
        if not isinstance(raw, (bytes, memoryview)) or len(raw) != math.prod(sent_shape) * item_size:
            raise MessageError(f"{where}: {sent_shape} of {dtype} do not fit the bytes that came")
        try:
            result: np.ndarray[Any, Any] = np.ndarray(sent_shape, dtype, raw)
        except (ValueError, OverflowError) as error:
            raise MessageError(f"{where}: {sent_shape} cannot be the shape of an array: {error}") from error
        if is_float and not _is_finite(result):
            raise MessageError(f"{where}: expected finite numbers, got NaN or infinity")
        return result

    return decode_array


def _is_finite(array: np.ndarray[Any, Any]) -> bool:
    # A sum is finite only of finite numbers. NumPy's functions are for many numbers: after some milliseconds of sleep
    # they take 60 us for a few, this takes 15.
    if array.size <= _FEW and math.isfinite(sum(array.ravel().tolist())):
        return True
    return bool(np.isfinite(array).all())


def _frames_decoder(dtype: np.dtype[Any], shape: tuple[str | int, ...]) -> Decoder:
    decode_raw = _array_decoder(dtype, shape)

    def decode_frames(value: Any, where: str, sizes: Sizes) -> Any:
        encoded = isinstance(value, list) and len(value) == 4
        encoding = _enumeration(FrameEncoding, value[0], where) if encoded else FrameEncoding.RAW
        announced = sizes.get("frame_encoding") or encoding
        if encoding is not announced or (encoded and encoding is FrameEncoding.RAW):
            raise MessageError(f"{where}: expected the run's encoding {announced.value!r}, got {encoding.value!r}")
        if not encoded:
            return decode_raw(value, where, sizes)
        _, sent_shape, parts, digest = value
        _check_shape(sent_shape, shape, where, sizes)
        if not (isinstance(parts, list) and all(isinstance(part, bytes) for part in parts)):
            raise MessageError(f"{where}: expected a list of encoded frames, got {_shown(parts)}")
        frames = EncodedFrames(FrameEncoding(encoding), tuple(sent_shape), tuple(parts), _text(digest, where))
        try:
            _ = frames.pixels  # now, so that what cannot be decoded goes no further
        except MessageError as error:
            raise MessageError(f"{where}: {error}") from error
        return frames

    return decode_frames


def _check_shape(sent_shape: Any, shape: tuple[str | int, ...], where: str, sizes: Sizes) -> None:
    """Hold a shape that was sent against the declared one; letters that have no size yet get theirs."""
    if not isinstance(sent_shape, list) or len(sent_shape) != len(shape):
        raise MessageError(f"{where}: expected shape {_described(shape, sizes)}, got {_shown(sent_shape)}")
    for letter, size in zip(shape, sent_shape, strict=True):
        if type(size) is not int or size < 0:
            raise MessageError(f"{where}: expected shape {_described(shape, sizes)}, got {_shown(sent_shape)}")
        wanted = letter if isinstance(letter, int) else sizes.setdefault(letter, size)
        if size != wanted:
            raise MessageError(f"{where}: expected shape {_described(shape, sizes)}, got {sent_shape}")


def _described(shape: tuple[str | int, ...], sizes: Sizes) -> str:
    return "(" + ", ".join(str(s if isinstance(s, int) else sizes.get(s, s)) for s in shape) + ")"
