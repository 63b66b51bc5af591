"""XXH3-128 of a policy's bytes, and whether its numbers are finite, in one pass over memory.

A policy with camera is larger than a processor's own caches: fetching it takes longer than computing with it, and the
xxhash library and NumPy would each fetch it.
"""

from __future__ import annotations

import numpy as np
import xxhash

from common.messages import UInt8Array
from common.policies.xxh3 import Digest, address_of, compile_take_in, is_taken_in


def digest_and_finite(buffer: UInt8Array) -> tuple[str, bool]:
    """Return the digest of the little-endian float32 in ``buffer``, in hexadecimal, and whether all are finite."""
    size = buffer.size
    if size % 4 or not is_taken_in(size):
        whole = buffer[: size // 4 * 4].view("<f4")
        return xxhash.xxh3_128_hexdigest(buffer.data), bool(np.isfinite(whole).all())
    digest, buffer = Digest.of_nothing(), np.ascontiguousarray(buffer)
    compile_take_in()(address_of(buffer), size, size, digest)
    return digest.hexadecimal(), digest.all_finite()
