"""Payloads with one large array: any msgpack reader reads them, and ours copies nothing."""

from __future__ import annotations

import ctypes

import msgpack
import numpy as np
import pytest

from common.bulk_payload import ALIGNMENT, Seal, as_aligned, pack_bulk, unpack_bulk


def pack(values, *pieces, shape=None):
    size = sum(piece.size for piece in pieces)
    return pack_bulk(values, "data", pieces[0].dtype.str, shape or [size], pieces, default=vars)


def test_a_plain_reader_gets_the_pieces_one_after_the_other():
    first, second = np.array([[1, 2], [3, 4]], np.float32), np.array([5], np.float32)
    read = msgpack.unpackb(pack({"a": 1, "b": ["x", None]}, first, np.zeros(0, np.float32), second))
    assert list(read) == ["a", "b", "data"]
    assert (read["a"], read["b"]) == (1, ["x", None])
    assert read["data"] == ["<f4", [5], np.arange(1, 6, dtype="<f4").tobytes()]


@pytest.mark.parametrize("length", range(9))
def test_the_bytes_begin_at_a_multiple_of_four_and_are_a_view(length):
    array = np.arange(3, dtype=np.float32)
    payload = pack({"text": "x" * length}, array)
    assert payload.index(array.tobytes()) % ALIGNMENT == 0
    values = unpack_bulk(payload)
    assert values is not None
    assert values["text"] == "x" * length
    data = values["data"][2]
    assert data.obj is payload
    assert bytes(data) == array.tobytes()
    assert msgpack.unpackb(payload)["data"][2] == array.tobytes()


def test_an_array_without_elements_is_packed_too():
    payload = pack({}, np.zeros((0, 4), np.uint8), shape=[0, 4])
    assert unpack_bulk(payload) == {"data": ["|u1", [0, 4], b""]} == msgpack.unpackb(payload)


def sum_of_copied(pieces, size, target):
    """Copy, and return the sum of all bytes in three digits."""
    joined = b"".join(piece.tobytes() for piece in pieces)
    assert len(joined) == size
    ctypes.memmove(target, joined, size)
    return f"{sum(joined):03}"


@pytest.mark.parametrize("length", range(9))
@pytest.mark.parametrize("order", [("seal", "text"), ("text", "seal")])
def test_a_seal_is_made_while_the_pieces_are_copied_and_changes_nothing_else(length, order):
    pieces = [np.array([1, 2], np.uint8), np.zeros(0, np.uint8), np.array([[200], [100]], np.uint8)]
    # The text looks like the placeholder.
    values = {name: {"seal": "000", "text": "0" * length}[name] for name in order}
    sealed = pack_bulk(values, "data", "|u1", [4], pieces, vars, Seal("seal", sum_of_copied))
    assert type(sealed) is bytes
    assert sealed == pack_bulk(values | {"seal": "303"}, "data", "|u1", [4], pieces, vars)


@pytest.mark.parametrize("text", ["0000", "00", ""])
def test_a_seal_of_another_length_is_refused(text):
    with pytest.raises(ValueError, match=f"seal: expected a text as long as '{text}', got b'006'"):
        pack_bulk(
            {"seal": text}, "data", "|u1", [3], [np.array([1, 2, 3], np.uint8)], vars, Seal("seal", sum_of_copied)
        )


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\x80",
        b"\xc1",
        msgpack.packb([1, 2]),
        msgpack.packb({"data": ["|u1", [3], b"abc"]}),  # its length in one byte
        msgpack.packb({"data": 5}),
        msgpack.packb({"data": ["|u1", [3]]}),
        pack({"a": 1}, np.arange(9, dtype=np.uint8))[:-1],
        pack({"a": 1}, np.arange(9, dtype=np.uint8)) + b"\0",
        pack({"a": "x" * 70_000}, np.arange(9, dtype=np.uint8)),
        pack({1: "a"}, np.arange(9, dtype=np.uint8)).replace(b"\xa4data", b"\x93\x01\x02\x03\x80"),
        b"\x82\x91\x01\x01" + pack({}, np.arange(9, dtype=np.uint8))[1:],  # a list is no key
        b"\xdf\xff\xff\xff\xff" + b"\x01" * 1000,
        b"\x81\xa4data" + b"\x91" * 5000,
    ],
)
def test_anything_else_is_left_to_msgpack(payload):
    assert unpack_bulk(payload) is None


def test_only_what_is_not_aligned_is_copied():
    whole = np.arange(20, dtype=np.uint8)
    begin = -whole.ctypes.data % 4
    aligned, shifted = (whole[begin + i :][:8].view(np.float32) for i in (0, 1))
    assert as_aligned(aligned) is aligned
    copied = as_aligned(shifted)
    assert copied.flags.aligned
    np.testing.assert_array_equal(copied, shifted)
