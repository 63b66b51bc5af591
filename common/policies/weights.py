"""A policy's parameters by name, and as the one flat buffer that a learner pushes.

Names and shapes (A actions, P proprioception, H hidden size, K = 3 * 3 convolution kernels)::

    encoder.0.weight  (32, S * C, 3, 3)    only with a camera
    encoder.0.bias    (32,)
    encoder.1 ... encoder.3                 the last without bias, which a spatial softmax cannot see
    actor.0.weight    (H, [64] + P + A)     observation: encoder features, proprioception, previous action; P with the
                                            pending actions, if there are
    actor.0.bias      (H,)
    actor.1.weight    (H, H)
    actor.1.bias      (H,)
    actor.2.weight    (2 A, H)              mean, then unbounded log standard deviation
    actor.2.bias      (2 A,)
    log_std_bounds    (2,)                  what the log standard deviation is mapped to
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import xxhash

from common.bulk_payload import as_aligned
from common.codec import decode, encode_gathered
from common.errors import MessageError
from common.messages import Float32Array, PolicyWeights, TaskSpec
from common.networks.sizes import CHANNELS, FEATURES, KERNEL

_FIRST_WEIGHT = "actor.0.weight"
_HEAD_WEIGHT, _HEAD_BIAS = "actor.2.weight", "actor.2.bias"
_WIRE_DTYPES: dict[str, np.dtype[Any]] = {"float32": np.dtype("<f4"), "float16": np.dtype("<f2")}


def parameter_shapes(spec: TaskSpec, hidden_size: int, encoder_strides: Sequence[int]) -> Mapping[str, list[int]]:
    """Return the names and shapes of a policy's parameters, in the order of the buffer."""
    sizes = spec.dimensions
    return _shapes(sizes.A, sizes.P, sizes.S * sizes.C, hidden_size, len(encoder_strides))


@lru_cache(maxsize=16)  # all policies of a task have the same
def _shapes(actions: int, proprioception: int, channels: int, hidden_size: int, layers: int) -> Mapping[str, list[int]]:
    shapes: dict[str, list[int]] = {}
    inputs = proprioception + actions
    if channels:
        for layer in range(layers):
            shapes[f"encoder.{layer}.weight"] = [CHANNELS, channels, KERNEL, KERNEL]
            if layer < layers - 1:
                shapes[f"encoder.{layer}.bias"] = [CHANNELS]
            channels = CHANNELS
        inputs += FEATURES
    for layer, (rows, columns) in enumerate(
        [(hidden_size, inputs), (hidden_size, hidden_size), (2 * actions, hidden_size)]
    ):
        shapes[f"actor.{layer}.weight"] = [rows, columns]
        shapes[f"actor.{layer}.bias"] = [rows]
    shapes["log_std_bounds"] = [2]
    return shapes


def pending_actions_of(weights: PolicyWeights, spec: TaskSpec) -> int:
    """Return how many pending actions a policy of the task wants to see (:mod:`common.pending_actions`)."""
    got = dict(zip(weights.names, weights.shapes, strict=False)).get(_FIRST_WEIGHT, [])
    _, without = parameter_shapes(spec, weights.hidden_size, weights.encoder_strides.tolist())[_FIRST_WEIGHT]
    return max(0, got[-1] - without) // spec.dimensions.A if got else 0


def initial_parameters(
    spec: TaskSpec,
    hidden_size: int,
    encoder_strides: Sequence[int],
    rng: np.random.Generator,
    *,
    zero_initialised_head: bool = True,
) -> dict[str, Float32Array]:
    """Return random layers under a zero one: N(0, 1) before the tanh, whatever the observation (thesis 4.2).

    Without ``zero_initialised_head``, the last layer is random as well, weight and bias uniform in
    +-1 / sqrt(hidden_size), which is what ``torch.nn.Linear`` starts with; the layers below stay the same.
    """
    parameters: dict[str, Float32Array] = {}
    for name, shape in parameter_shapes(spec, hidden_size, encoder_strides).items():
        parameters[name] = np.zeros(shape, np.float32)
        if name.endswith("weight") and name != _HEAD_WEIGHT:
            bound = 1.0 / math.sqrt(math.prod(shape[1:]))
            parameters[name] = rng.uniform(-bound, bound, shape).astype(np.float32)
    if not zero_initialised_head:
        bound = 1.0 / math.sqrt(hidden_size)
        for name in (_HEAD_WEIGHT, _HEAD_BIAS):
            parameters[name] = rng.uniform(-bound, bound, parameters[name].shape).astype(np.float32)
    parameters["log_std_bounds"] = np.array([-10.0, 10.0], np.float32)
    return parameters


def encode_weights(
    parameters: Mapping[str, npt.NDArray[Any]],
    *,
    version: int,
    updates: int,
    algorithm: str,
    hidden_size: int,
    encoder_strides: Sequence[int],
    dtype: str,
) -> bytes:
    """Return the payload of the PolicyWeights that carry ``parameters``, which are copied into it and nowhere else.

    Args:
        parameters: name -> array; the order is kept.
        version, updates, algorithm, hidden_size, encoder_strides: see :class:`PolicyWeights`.
        dtype: ``float32`` or ``float16``.

    Raises:
        MessageError: a parameter is not finite in ``dtype``. Only numbers that are converted are looked at: whoever
            learns looks at its losses, and whoever acts at every number.
    """
    wire = _wire_dtype(dtype)
    pieces, digest = [], xxhash.xxh3_128()
    for name, values in parameters.items():
        piece = np.ascontiguousarray(values)
        if values.dtype != wire:
            with np.errstate(over="ignore"):
                piece = piece.astype(wire)
            if not np.isfinite(piece).all():
                raise MessageError(f"policy weights after {updates} updates: {name} has no finite numbers in {dtype}")
        pieces.append(piece)
        digest.update(piece.data)
    fields = {
        "version": version,
        "updates": updates,
        "algorithm": algorithm,
        "hidden_size": hidden_size,
        "encoder_strides": np.array(encoder_strides, np.int64),
        "names": list(parameters),
        "shapes": [list(values.shape) for values in parameters.values()],
        "dtype": dtype,
        "digest": digest.hexdigest(),
    }
    return encode_gathered(PolicyWeights, fields, pieces)


def pack_weights(
    parameters: Mapping[str, npt.NDArray[Any]],
    *,
    version: int,
    updates: int,
    algorithm: str,
    hidden_size: int,
    encoder_strides: Sequence[int],
    dtype: str,
) -> PolicyWeights:
    """Return the message that carries ``parameters``, as its receiver decodes it; see :func:`encode_weights`."""
    payload = encode_weights(
        parameters,
        version=version,
        updates=updates,
        algorithm=algorithm,
        hidden_size=hidden_size,
        encoder_strides=encoder_strides,
        dtype=dtype,
    )
    return decode(payload, PolicyWeights)


def unpack_weights(weights: PolicyWeights, expected: Mapping[str, list[int]]) -> dict[str, Float32Array]:
    """Return name -> array, for names and shapes that the task's policy has.

    Raises:
        MessageError: the buffer was changed on its way, does not fit the names and shapes, is not finite, or
            belongs to another network than ``expected``.
    """
    wire = _wire_dtype(weights.dtype)
    digest, is_finite = _looked_at(weights, wire)
    if weights.digest != digest:
        raise MessageError(f"policy weights {weights.version}: expected digest {weights.digest}, got {digest}")
    got = dict(zip(weights.names, weights.shapes, strict=False))
    if len(weights.names) != len(weights.shapes) or got != expected:
        differing = sorted(n for n in got.keys() | expected.keys() if got.get(n) != expected.get(n))
        raise MessageError(
            f"policy weights {weights.version} are for another network: {differing[0] if differing else 'names'}: "
            f"expected shape {expected.get(differing[0]) if differing else None}, "
            f"got {got.get(differing[0]) if differing else None}"
        )
    size = sum(math.prod(shape) for shape in weights.shapes)
    if weights.buffer.nbytes != size * wire.itemsize:
        raise MessageError(
            f"policy weights {weights.version}: expected {size * wire.itemsize} bytes, got {weights.buffer.nbytes}"
        )
    flat = as_aligned(weights.buffer.view(wire)).astype(np.float32, copy=False)
    if not (_all_finite(flat) if is_finite is None else is_finite):
        raise MessageError(f"policy weights {weights.version}: expected finite numbers, got NaN or infinity")
    parameters: dict[str, Float32Array] = {}
    start = 0
    for name, shape in zip(weights.names, weights.shapes, strict=True):
        end = start + math.prod(shape)
        parameters[name] = flat[start:end].reshape(shape)
        start = end
    return parameters


def _wire_dtype(dtype: str) -> np.dtype[Any]:
    if dtype not in _WIRE_DTYPES:
        raise MessageError(f"policy weights: expected dtype in {list(_WIRE_DTYPES)}, got {dtype!r}")
    return _WIRE_DTYPES[dtype]


def _looked_at(weights: PolicyWeights, wire: np.dtype[Any]) -> tuple[str, bool | None]:
    """Return the digest of the buffer and whether its numbers are finite; None: they are still to be looked at."""
    if weights.encoder_strides.size and wire == np.float32:
        from common.policies.fused_check import digest_and_finite  # LLVM: only policies with camera pay for it

        return digest_and_finite(weights.buffer)
    return _digest(weights.buffer), None


def _all_finite(values: npt.NDArray[Any]) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):
        # What is not finite makes the sum of squares so, and that takes half the time of looking at each.
        if values.dtype == np.float32 and np.isfinite(np.dot(values, values)):
            return True
    return bool(np.isfinite(values).all())


def _digest(buffer: npt.NDArray[np.uint8]) -> str:
    # Against accidents, not against forgers: twenty times as fast as a cryptographic hash.
    return xxhash.xxh3_128_hexdigest(buffer.data)
