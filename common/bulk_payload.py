"""Payloads whose bytes are nearly all one array's: packed with a single copy of it, unpacked with none.

msgpack copies bytes twice when it packs them and once when it unpacks them; for a policy or a minibatch that takes
longer than everything else done with the message. So the array's field comes last, everything before it is packed as
usual, and its bytes are put behind that. They begin at a multiple of four bytes, where processors want float32: for
that, a length before them may be written in more bytes than it needs. Any msgpack reader reads the result.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy.typing as npt

ALIGNMENT = 4
"""The array's bytes begin at a multiple of this many bytes from the payload's begin."""
_LONGEST_HEAD = 1 << 16
"""Of a payload with more than this many bytes before its array, msgpack unpacks the array as well, with a copy."""
_BIN_32 = b"\xc6"


@dataclass(frozen=True)
class Seal:
    """A text before the array that depends on the array's bytes, and how to make it while they are copied."""

    field: str
    """The text's field. It is packed with another text of the same length, which is overwritten."""
    copy: Callable[[Sequence[npt.NDArray[Any]], int, int], str]
    """Copies the bytes of contiguous arrays, one after the other, and returns the text. Its arguments: the arrays, how
    many bytes they have, and the address to copy to."""


def pack_bulk(
    values: Mapping[str, Any],
    name: str,
    dtype: str,
    shape: Sequence[int],
    pieces: Sequence[npt.NDArray[Any]],
    default: Callable[[Any], Any],
    seal: Seal | None = None,
) -> bytes:
    """Return a map of ``values`` and, last, an array.

    Args:
        values: the other fields.
        name: the array's field.
        dtype: of the array, as it is sent.
        shape: of the array.
        pieces: contiguous arrays whose bytes, one after the other, are the array's.
        default: what msgpack packs instead of something it does not know.
        seal: makes one of ``values``, in ASCII, while it copies the pieces; None: they are copied as they are.
    """
    packer = msgpack.Packer(default=default, use_bin_type=True, autoreset=False)
    packer.pack_map_header(len(values) + 1)
    seal_end = 0
    for key, value in values.items():
        packer.pack(key)
        packer.pack(value)
        if seal is not None and key == seal.field:
            seal_end = len(packer.getbuffer())
    packer.pack(name)
    before, text = packer.bytes(), dtype.encode()
    packed_shape = msgpack.packb(list(shape))
    size = sum(piece.nbytes for piece in pieces)
    missing = -(len(before) + 2 + len(text) + len(packed_shape) + 5) % ALIGNMENT
    head = [
        before,
        b"\xdc\x00\x03" if missing & 2 else b"\x93",  # array of three, in three bytes or in one
        bytes([0xD9, len(text)] if missing & 1 else [0xA0 | len(text)]),  # length of a text, in two or in one
        text,
        packed_shape,
        _BIN_32,
        size.to_bytes(4, "big"),
    ]
    if seal is None:
        return b"".join([*head, *(piece.data for piece in pieces if piece.size)])
    joined = b"".join(head)
    payload, address = _new_bytes(len(joined) + size)
    sealed = seal.copy(pieces, size, address + len(joined)).encode("ascii")
    if len(sealed) != len(values[seal.field]):
        raise ValueError(f"{seal.field}: expected a text as long as {values[seal.field]!r}, got {sealed!r}")
    ctypes.memmove(address, joined, len(joined))
    ctypes.memmove(address + seal_end - len(sealed), sealed, len(sealed))
    return payload


def unpack_bulk(payload: bytes) -> dict[str, Any] | None:
    """Return the map in a payload as :func:`pack_bulk` makes it, the array's bytes as a view of the payload.

    None if the payload is anything else: msgpack then says what is wrong with it, if something is.
    """
    unpacker = msgpack.Unpacker(raw=False, strict_map_key=True)
    unpacker.feed(memoryview(payload)[:_LONGEST_HEAD])
    values: dict[str, Any] = {}
    try:
        for _ in range(unpacker.read_map_header() - 1):
            key = unpacker.unpack()
            values[key] = unpacker.unpack()
        name = unpacker.unpack()
        if not isinstance(name, str) or unpacker.read_array_header() != 3:
            return None
        dtype, shape, start = unpacker.unpack(), unpacker.unpack(), unpacker.tell() + 5
    except (msgpack.UnpackException, ValueError, TypeError, RecursionError):
        return None
    marker, size = payload[start - 5 : start - 4], int.from_bytes(payload[start - 4 : start], "big")
    if marker != _BIN_32 or start + size != len(payload):
        return None
    values[name] = [dtype, shape, memoryview(payload)[start:]]
    return values


def as_aligned(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return ``array``, or a copy where its bytes begin at an address that processors do not want."""
    return array if array.flags.aligned else array.copy()


def _new_bytes(size: int) -> tuple[bytes, int]:
    """Return bytes with nothing in them yet, and their address.

    Whoever makes bytes may write to them as long as nobody else has seen them: so says the documentation of the two
    functions of CPython that are called here. A bytearray, or what BytesIO makes room for, would be zeroed first, and
    ``bytes`` of a bytearray is a copy.
    """
    payload = _PyBytes_FromStringAndSize(None, size)
    return payload, _PyBytes_AsString(payload)


_PyBytes_FromStringAndSize = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.c_char_p, ctypes.c_ssize_t)(
    ("PyBytes_FromStringAndSize", ctypes.pythonapi)
)
_PyBytes_AsString = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object)(("PyBytes_AsString", ctypes.pythonapi))
