"""XXH3-128 of a policy's bytes, and whether its numbers are finite, in one pass over memory.

A policy with camera is larger than a processor's own caches: fetching it takes longer than computing with it, and the
xxhash library and NumPy would each fetch it. LLVM compiles the pass in .2 s; through numba, which finds
no vectors in loops over eight lanes, it would take a second, and twice the memory. Only :func:`load` imports LLVM.

The digest is that of https://github.com/Cyan4973/xxHash/blob/dev/doc/xxhash_spec.md, "XXH3 Algorithm Description (for
large inputs)", with seed 0 and the default secret.
"""

from __future__ import annotations

import ctypes
import struct
import sys
from collections.abc import Callable
from functools import cache
from operator import xor
from typing import Any, cast

import numpy as np
import xxhash

from common.messages import UInt8Array
from common.native_code import compile_function

_SECRET = bytes.fromhex(
    "b8fe6c3923a44bbe7c01812cf721ad1cded46de9839097db7240a4a4b7b3671fcb79e64eccc0e578825ad07dccff7221"
    "b8084674f743248ee03590e6813a264c3c2852bb91c300cb88d0658b1b532ea371644897a20df94e3819ef46a9deacd8"
    "a8fa763fe39c343ff9dcbbc7c70b4f1d8a51e04bcdb45931c89f7ec9d9787364eac5ac8334d3ebc3c581a0fffa1363eb"
    "170ddd51b7f0da49d316552629d4689e2b16be587d47a1fc8ff8b8d17ad031ce45cb3a8f95160428afd7fbcabb4b407e"
)
_PRIME32_1, _PRIME32_2, _PRIME32_3 = 0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D
_PRIME64_1, _PRIME64_2, _PRIME64_3 = 0x9E3779B185EBCA87, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9
_PRIME64_4, _PRIME64_5, _PRIME_MX1 = 0x85EBCA77C2B2AE63, 0x27D4EB2F165667C5, 0x165667919E3779F9
_START = (_PRIME32_3, _PRIME64_1, _PRIME64_2, _PRIME64_3, _PRIME64_4, _PRIME32_2, _PRIME64_5, _PRIME32_1)
_LOW_KEY, _HIGH_KEY = struct.unpack_from("<8Q", _SECRET, 11), struct.unpack_from("<8Q", _SECRET, len(_SECRET) - 75)
_U64 = (1 << 64) - 1
_STRIPE, _STRIPES = 64, 16
"""Bytes of a stripe, and stripes of a block."""
_AHEAD = 2048
"""Bytes between what is taken in and what is fetched; past the end nothing happens."""
_SHORTEST = 241
"""Shorter inputs have digests of another kind."""
_OVERFLOWN = 0x80000000_80000000
"""What an exponent of nothing but ones leaves of a pair of float32, when one is added to it: a bit where the sign was.

No other exponent gets that far, and none further, into the other float32."""


def digest_and_finite(buffer: UInt8Array) -> tuple[str, bool]:
    """Return the digest of the little-endian float32 in ``buffer``, in hexadecimal, and whether all are finite."""
    size = buffer.size
    if size < _SHORTEST or size % 4 or sys.byteorder != "little":
        whole = buffer[: size // 4 * 4].view("<f4")
        return xxhash.xxh3_128_hexdigest(buffer.data), bool(np.isfinite(whole).all())
    take_in, buffer = load(), np.ascontiguousarray(buffer)
    data, _ = buffer.__array_interface__["data"]
    state = _State(*_START)
    blocks, rest = divmod(size - 1, _STRIPE * _STRIPES)  # the last block is not a whole one, even if it is as long
    if blocks:
        take_in(data, blocks, _STRIPES, 0, True, state)
    if rest >= _STRIPE:
        take_in(data + size - 1 - rest, 1, rest // _STRIPE, 0, False, state)
    take_in(data + size - _STRIPE, 1, 1, len(_SECRET) - 71, False, state)
    accumulators, exponents = state[:8], state[8:]
    low = _merged(accumulators, size * _PRIME64_1, _LOW_KEY)
    high = _merged(accumulators, ~(size * _PRIME64_2), _HIGH_KEY)
    return f"{high:016x}{low:016x}", not any(pair & _OVERFLOWN for pair in exponents)


def _merged(accumulators: list[int], value: int, key: tuple[int, ...]) -> int:
    a, b, c, d, e, f, g, h = map(xor, accumulators, key)
    for product in (a * b, c * d, e * f, g * h):
        value += (product & _U64) ^ (product >> 64)
    value &= _U64
    value = (value ^ value >> 37) * _PRIME_MX1 & _U64
    return value ^ value >> 32


_State = ctypes.c_uint64 * 16


@cache
def load() -> Callable[[int, int, int, int, bool, Any], None]:
    """Compile what takes in blocks of stripes; call it before anybody waits.

    Its arguments: address of the data, blocks, stripes in each, place in the secret of the key of each block's first
    stripe (every other stripe's is 8 bytes further on), whether each block ends with a scramble, and the state: eight
    accumulators, eight pairs of exponents.
    """
    address, integer = ctypes.c_void_p, ctypes.c_int64
    prototype = ctypes.CFUNCTYPE(None, address, integer, integer, integer, ctypes.c_bool, address)
    return cast("Callable[[int, int, int, int, bool, Any], None]", compile_function(_TAKE_IN, "take_in", prototype))


def _all(number: int) -> str:
    return "<" + ", ".join([f"i64 {number}"] * 8) + ">"


# Within a block its sums may be taken in any order: what a lane adds to its neighbour's accumulator is summed apart,
# and exchanged once at the end.
_TAKE_IN = f"""
@secret = private constant [{len(_SECRET)} x i8] [{", ".join([f"i8 {byte}" for byte in _SECRET])}]

declare void @llvm.prefetch.p0(ptr, i32, i32, i32)

define void @take_in(ptr %data, i64 %blocks, i64 %stripes, i64 %secret.offset, i1 zeroext %scrambles, ptr %state) {{
start:
  %state.exponents = getelementptr i8, ptr %state, i64 64
  %accumulators.0 = load <8 x i64>, ptr %state, align 8
  %exponents.0 = load <8 x i64>, ptr %state.exponents, align 8
  %key = getelementptr i8, ptr @secret, i64 %secret.offset
  %scramble.at = getelementptr i8, ptr @secret, i64 {len(_SECRET) - _STRIPE}
  br label %block

block:
  %b = phi i64 [0, %start], [%b.next, %end]
  %b.data = phi ptr [%data, %start], [%next, %end]
  %b.accumulators = phi <8 x i64> [%accumulators.0, %start], [%b.accumulators.next, %end]
  %b.exponents = phi <8 x i64> [%exponents.0, %start], [%exponents.next, %end]
  br label %stripe

stripe:
  %s = phi i64 [0, %block], [%s.next, %stripe]
  %at = phi ptr [%b.data, %block], [%next, %stripe]
  %accumulators = phi <8 x i64> [%b.accumulators, %block], [%accumulators.next, %stripe]
  %neighbours = phi <8 x i64> [zeroinitializer, %block], [%neighbours.next, %stripe]
  %exponents = phi <8 x i64> [%b.exponents, %block], [%exponents.next, %stripe]
  %ahead = getelementptr i8, ptr %at, i64 {_AHEAD}
  call void @llvm.prefetch.p0(ptr %ahead, i32 0, i32 0, i32 1)
  %lanes = load <8 x i64>, ptr %at, align 1
  %key.at = getelementptr i64, ptr %key, i64 %s
  %key.lanes = load <8 x i64>, ptr %key.at, align 1
  %keyed = xor <8 x i64> %lanes, %key.lanes
  %keyed.low = and <8 x i64> %keyed, {_all(0xFFFFFFFF)}
  %keyed.high = lshr <8 x i64> %keyed, {_all(32)}
  %product = mul <8 x i64> %keyed.low, %keyed.high
  %accumulators.next = add <8 x i64> %accumulators, %product
  %neighbours.next = add <8 x i64> %neighbours, %lanes
  %exponent = and <8 x i64> %lanes, {_all(0x7F800000_7F800000)}
  %one.more = add <8 x i64> %exponent, {_all(0x00800000_00800000)}
  %exponents.next = or <8 x i64> %exponents, %one.more
  %next = getelementptr i8, ptr %at, i64 {_STRIPE}
  %s.next = add i64 %s, 1
  %s.more = icmp ult i64 %s.next, %stripes
  br i1 %s.more, label %stripe, label %end

end:
  %exchanged = shufflevector <8 x i64> %neighbours.next, <8 x i64> poison,
                             <8 x i32> <i32 1, i32 0, i32 3, i32 2, i32 5, i32 4, i32 7, i32 6>
  %sum = add <8 x i64> %accumulators.next, %exchanged
  %sum.high = lshr <8 x i64> %sum, {_all(47)}
  %mixed = xor <8 x i64> %sum, %sum.high
  %scramble.key = load <8 x i64>, ptr %scramble.at, align 1
  %mixed.keyed = xor <8 x i64> %mixed, %scramble.key
  %scrambled = mul <8 x i64> %mixed.keyed, {_all(_PRIME32_1)}
  %b.accumulators.next = select i1 %scrambles, <8 x i64> %scrambled, <8 x i64> %sum
  %b.next = add i64 %b, 1
  %b.more = icmp ult i64 %b.next, %blocks
  br i1 %b.more, label %block, label %return

return:
  store <8 x i64> %b.accumulators.next, ptr %state, align 8
  store <8 x i64> %exponents.next, ptr %state.exponents, align 8
  ret void
}}
"""
