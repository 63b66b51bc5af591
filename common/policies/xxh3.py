"""XXH3-128 in LLVM's language, for passes over memory that do something else with each byte as well.

LLVM compiles a pass in .2 s; through numba, which finds no vectors in loops over eight lanes, it would take a second,
and twice the memory. LLVM is imported with the first pass that is compiled, not with this module.

The digest is that of https://github.com/Cyan4973/xxHash/blob/dev/doc/xxhash_spec.md, "XXH3 Algorithm Description (for
large inputs)", with seed 0 and the default secret.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from functools import cache
from typing import Any, cast

import numpy.typing as npt

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
_LOW_KEY_AT, _HIGH_KEY_AT, _LAST_KEY_AT = 11, len(_SECRET) - 75, len(_SECRET) - 71
"""Where in the secret the keys of the digest's halves and of the last stripe begin."""
_STRIPE, _STRIPES = 64, 16
"""Bytes of a stripe, and stripes of a block."""
BLOCK = _STRIPE * _STRIPES
"""Bytes of a block."""
_AHEAD = 2048
"""Bytes between what is taken in and what is fetched; past the end nothing happens."""
_SHORTEST = 241
"""Shorter inputs have digests of another kind."""
_OVERFLOWN = 0x80000000_80000000
"""What an exponent of nothing but ones leaves of a pair of float32, when one is added to it: a bit where the sign was.

No other exponent gets that far, and none further, into the other float32."""


class Digest(ctypes.Structure):
    """What is known of the bytes that have been taken in; after the last, their digest."""

    _fields_ = (
        ("accumulators", ctypes.c_uint64 * 8),
        ("exponents", ctypes.c_uint64 * 8),
        ("low", ctypes.c_uint64),
        ("high", ctypes.c_uint64),
        ("overflown", ctypes.c_uint64),
    )

    @classmethod
    def of_nothing(cls) -> Digest:
        """Return what there is before anything has been taken in."""
        return cls.from_buffer_copy(_BEFORE)

    def hexadecimal(self) -> str:
        """Return the digest as text."""
        return f"{self.high:016x}{self.low:016x}"

    def all_finite(self) -> bool:
        """Return whether the bytes, as little-endian float32, are finite numbers all."""
        return not self.overflown


_BEFORE = bytes(Digest((ctypes.c_uint64 * 8)(*_START)))


def is_taken_in(size: int) -> bool:
    """Return whether there are passes for so many bytes on this computer; xxhash has digests of all."""
    return size >= _SHORTEST and sys.byteorder == "little"


def address_of(array: npt.NDArray[Any]) -> int:
    """Return where the bytes of ``array`` begin."""
    return cast("int", array.__array_interface__["data"][0])


TakeIn = Callable[[int, int, int, Digest], None]
"""Takes in bytes. Arguments: their address; how many there are, whole blocks unless they are the last; then the number
of all bytes, else 0; the :class:`Digest`."""
TakeInAndCopy = Callable[[int, int, int, Digest, int], None]
"""Takes in bytes and copies them; the fifth argument is the address to copy to. The last ones must be there already."""


@cache
def compile_take_in() -> TakeIn:
    """Compile a pass that only reads. Other threads go on meanwhile."""
    address, integer = ctypes.c_void_p, ctypes.c_int64
    prototype = ctypes.CFUNCTYPE(None, address, integer, integer, ctypes.POINTER(Digest))
    return cast("TakeIn", compile_function(_text(copies=False), "take_in", prototype))


@cache
def compile_take_in_and_copy() -> TakeInAndCopy:
    """Compile a pass that copies."""
    address, integer = ctypes.c_void_p, ctypes.c_int64
    # It keeps Python's lock, .1 ms for a policy: it would have to be given away several times for each, and whoever has
    # given it away waits for it, up to 5 ms, beside a thread busy with Python (see common.policies.sparse_layer).
    prototype = ctypes.PYFUNCTYPE(None, address, integer, integer, ctypes.POINTER(Digest), address)
    return cast("TakeInAndCopy", compile_function(_text(copies=True), "take_in", prototype))


def _all(number: int) -> str:
    return "<" + ", ".join([f"i64 {number}"] * 8) + ">"


def _text(*, copies: bool) -> str:
    """Return the module."""
    target, to, store = "", "", ""
    if copies:
        target, to = ", ptr %target", ", ptr %to"
        # What is overwritten is fetched first, too.
        store = f"""
  %copy = getelementptr i8, ptr %to, i64 %offset
  %copy.ahead = getelementptr i8, ptr %copy, i64 {_AHEAD}
  call void @llvm.prefetch.p0(ptr %copy.ahead, i32 1, i32 3, i32 1)
  store <8 x i64> %lanes, ptr %copy, align 1"""
    return f"""
@secret = private constant [{len(_SECRET)} x i8] [{", ".join([f"i8 {byte}" for byte in _SECRET])}]

declare void @llvm.prefetch.p0(ptr, i32, i32, i32)
declare i64 @llvm.vector.reduce.add.v4i64(<4 x i64>)
declare i64 @llvm.vector.reduce.or.v8i64(<8 x i64>)

define void @take_in(ptr %data, i64 %size, i64 %whole, ptr %digest{target}) {{
start:
  %is.end = icmp ne i64 %whole, 0
  %spare = zext i1 %is.end to i64  ; the last block is not a whole one, even if it is as long
  %blocks.size = sub i64 %size, %spare
  %blocks = udiv i64 %blocks.size, {BLOCK}
  call void @blocks(ptr %data, i64 0, i64 %blocks, i64 {_STRIPES}, i64 0, i1 true, ptr %digest{target})
  br i1 %is.end, label %end, label %return

end:
  %rest = mul i64 %blocks, {BLOCK}
  %rest.size = sub i64 %blocks.size, %rest
  %stripes = udiv i64 %rest.size, {_STRIPE}
  call void @blocks(ptr %data, i64 %rest, i64 1, i64 %stripes, i64 0, i1 false, ptr %digest{target})
  %last = sub i64 %size, {_STRIPE}
  call void @blocks(ptr %data, i64 %last, i64 1, i64 1, i64 {_LAST_KEY_AT}, i1 false, ptr %digest{target})
  %low.size = mul i64 %whole, {_PRIME64_1}
  %high.size = mul i64 %whole, {_PRIME64_2}
  %high.complement = xor i64 %high.size, -1
  %low = call i64 @merged(ptr %digest, i64 %low.size, i64 {_LOW_KEY_AT})
  %high = call i64 @merged(ptr %digest, i64 %high.complement, i64 {_HIGH_KEY_AT})
  %exponents.at = getelementptr i8, ptr %digest, i64 {Digest.exponents.offset}
  %exponents = load <8 x i64>, ptr %exponents.at, align 8
  %any.exponent = call i64 @llvm.vector.reduce.or.v8i64(<8 x i64> %exponents)
  %overflown = and i64 %any.exponent, {_OVERFLOWN}
  %low.at = getelementptr i8, ptr %digest, i64 {Digest.low.offset}
  %high.at = getelementptr i8, ptr %digest, i64 {Digest.high.offset}
  %overflown.at = getelementptr i8, ptr %digest, i64 {Digest.overflown.offset}
  store i64 %low, ptr %low.at, align 8
  store i64 %high, ptr %high.at, align 8
  store i64 %overflown, ptr %overflown.at, align 8
  br label %return

return:
  ret void
}}

; Takes in stripes at an offset. Within a block its sums may be taken in any order: what a lane adds to its neighbour's
; accumulator is summed apart, and exchanged once at the end.
define internal void @blocks(ptr %data, i64 %offset.0, i64 %blocks, i64 %stripes, i64 %secret.offset, i1 %scrambles,
                             ptr %digest{to}) {{
start:
  %digest.exponents = getelementptr i8, ptr %digest, i64 {Digest.exponents.offset}
  %accumulators.0 = load <8 x i64>, ptr %digest, align 8
  %exponents.0 = load <8 x i64>, ptr %digest.exponents, align 8
  %key = getelementptr i8, ptr @secret, i64 %secret.offset
  %scramble.at = getelementptr i8, ptr @secret, i64 {len(_SECRET) - _STRIPE}
  %count = mul i64 %blocks, %stripes
  %is.nothing = icmp eq i64 %count, 0
  br i1 %is.nothing, label %nothing, label %block

block:
  %b = phi i64 [0, %start], [%b.next, %end]
  %b.offset = phi i64 [%offset.0, %start], [%next, %end]
  %b.accumulators = phi <8 x i64> [%accumulators.0, %start], [%b.accumulators.next, %end]
  %b.exponents = phi <8 x i64> [%exponents.0, %start], [%exponents.next, %end]
  br label %stripe

stripe:
  %s = phi i64 [0, %block], [%s.next, %stripe]
  %offset = phi i64 [%b.offset, %block], [%next, %stripe]
  %accumulators = phi <8 x i64> [%b.accumulators, %block], [%accumulators.next, %stripe]
  %neighbours = phi <8 x i64> [zeroinitializer, %block], [%neighbours.next, %stripe]
  %exponents = phi <8 x i64> [%b.exponents, %block], [%exponents.next, %stripe]
  %at = getelementptr i8, ptr %data, i64 %offset
  %ahead = getelementptr i8, ptr %at, i64 {_AHEAD}
  call void @llvm.prefetch.p0(ptr %ahead, i32 0, i32 0, i32 1)
  %lanes = load <8 x i64>, ptr %at, align 1{store}
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
  %next = add i64 %offset, {_STRIPE}
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
  store <8 x i64> %b.accumulators.next, ptr %digest, align 8
  store <8 x i64> %exponents.next, ptr %digest.exponents, align 8
  ret void

nothing:
  ret void
}}

; Half of the digest.
define internal i64 @merged(ptr %digest, i64 %value, i64 %secret.offset) {{
  %accumulators = load <8 x i64>, ptr %digest, align 8
  %key.at = getelementptr i8, ptr @secret, i64 %secret.offset
  %key = load <8 x i64>, ptr %key.at, align 1
  %keyed = xor <8 x i64> %accumulators, %key
  %even = shufflevector <8 x i64> %keyed, <8 x i64> poison, <4 x i32> <i32 0, i32 2, i32 4, i32 6>
  %odd = shufflevector <8 x i64> %keyed, <8 x i64> poison, <4 x i32> <i32 1, i32 3, i32 5, i32 7>
  %even.wide = zext <4 x i64> %even to <4 x i128>
  %odd.wide = zext <4 x i64> %odd to <4 x i128>
  %product = mul <4 x i128> %even.wide, %odd.wide
  %product.low = trunc <4 x i128> %product to <4 x i64>
  %shifted = lshr <4 x i128> %product, <i128 64, i128 64, i128 64, i128 64>
  %product.high = trunc <4 x i128> %shifted to <4 x i64>
  %folded = xor <4 x i64> %product.low, %product.high
  %sum = call i64 @llvm.vector.reduce.add.v4i64(<4 x i64> %folded)
  %total = add i64 %value, %sum
  %total.high = lshr i64 %total, 37
  %mixed = xor i64 %total, %total.high
  %multiplied = mul i64 %mixed, {_PRIME_MX1}
  %multiplied.high = lshr i64 %multiplied, 32
  %half = xor i64 %multiplied, %multiplied.high
  ret i64 %half
}}
"""
