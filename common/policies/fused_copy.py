"""A policy's parameters brought together, and XXH3-128 of their bytes, in one pass over memory.

A policy with camera is larger than a processor's own caches: what is copied first and taken in later is fetched twice.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy.typing as npt
import xxhash

from common.policies.xxh3 import BLOCK, Digest, address_of, compile_take_in_and_copy, is_taken_in

_LARGE = 64 * BLOCK
"""Fewer bytes are still in the cache after they have been copied. Two blocks at least, so that one lies in them."""


def copy_and_digest(pieces: Sequence[npt.NDArray[Any]], size: int, target: int) -> str:
    """Copy the bytes of contiguous arrays, one array's after the other's; return the digest of all, in hexadecimal.

    Args:
        pieces: the arrays.
        size: number of their bytes.
        target: address to copy to.
    """
    if not is_taken_in(size):
        ctypes.memmove(target, joined := _joined(pieces), size)
        return xxhash.xxh3_128_hexdigest(joined)
    take_in, digest = compile_take_in_and_copy(), Digest.of_nothing()
    copied = taken = 0
    small: list[npt.NDArray[Any]] = []
    for piece in pieces:
        if piece.nbytes < _LARGE:
            small.append(piece)
            continue
        # Bytes up to the next whole block are copied first; then all those that have been are taken in where they are.
        joined, source = _joined(small), address_of(piece)
        small.clear()
        ctypes.memmove(target + copied, joined, len(joined))
        copied += len(joined)
        begin, end = -(-copied // BLOCK) * BLOCK, copied + piece.nbytes
        blocks_end = min(end, size - 1) // BLOCK * BLOCK
        ctypes.memmove(target + copied, source, begin - copied)
        take_in(target + taken, begin - taken, 0, digest, target + taken)
        take_in(source + begin - copied, blocks_end - begin, 0, digest, target + begin)
        ctypes.memmove(target + blocks_end, source + blocks_end - copied, end - blocks_end)
        copied, taken = end, blocks_end
    ctypes.memmove(target + copied, _joined(small), size - copied)
    take_in(target + taken, size - taken, size, digest, target + taken)
    return digest.hexadecimal()


def _joined(pieces: Sequence[npt.NDArray[Any]]) -> bytes:
    # For a few kilobytes it takes less time than to ask for each array's address.
    return b"".join([piece.data for piece in pieces if piece.size])
