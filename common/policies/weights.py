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
from collections.abc import Mapping, Sequence, Sized
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import xxhash

from common.bulk_payload import Seal, as_aligned
from common.codec import decode, encode_gathered
from common.errors import MessageError
from common.messages import Float32Array, PolicyWeights, TaskSpec
from common.networks.sizes import CHANNELS, FEATURES, KERNEL
from common.policies.fused_check import digest_and_finite
from common.policies.fused_copy import copy_and_digest
from common.policies.xxh3 import compile_take_in_and_copy

_FIRST_WEIGHT = "actor.0.weight"
_HEAD_WEIGHT, _HEAD_BIAS = "actor.2.weight", "actor.2.bias"
_NO_DIGEST = "0" * 32
"""As long as a digest."""
_SEAL = Seal("digest", copy_and_digest)
_WIRE_DTYPES: dict[str, np.dtype[Any]] = {"float32": np.dtype("<f4"), "float16": np.dtype("<f2")}


@dataclass(frozen=True)
class ParameterLayout:
    """The names and shapes of a policy's parameters, in the order of the buffer."""

    names: list[str]
    """Names, as in :class:`PolicyWeights`."""
    shapes: list[list[int]]
    """Shapes, in the same order."""

    @cached_property
    def by_name(self) -> Mapping[str, list[int]]:
        """Name -> shape, in the same order."""
        return dict(zip(self.names, self.shapes, strict=True))

    @cached_property
    def size(self) -> int:
        """Count of numbers."""
        return sum(math.prod(shape) for shape in self.shapes)

    @cached_property
    def record(self) -> np.dtype[np.void]:
        """A buffer's type in NumPy: with it, a parameter is found without counting."""
        return np.dtype([(name, np.float32, tuple(shape)) for name, shape in self.by_name.items()])


def parameter_layout(spec: TaskSpec, hidden_size: int, encoder_strides: Sequence[int]) -> ParameterLayout:
    """Return what a policy's parameters are."""
    channels = spec.frame_stack * int(spec.frame_shape[2])
    return _layout(len(spec.action_low), len(spec.proprioception_low), channels, hidden_size, len(encoder_strides))


def parameter_shapes(spec: TaskSpec, hidden_size: int, encoder_strides: Sequence[int]) -> Mapping[str, list[int]]:
    """Return the names and shapes of a policy's parameters, in the order of the buffer."""
    return parameter_layout(spec, hidden_size, encoder_strides).by_name


@lru_cache(maxsize=16)  # all policies of a task have the same
def _layout(actions: int, proprioception: int, channels: int, hidden_size: int, layers: int) -> ParameterLayout:
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
    return ParameterLayout(list(shapes), list(shapes.values()))


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
    pieces = []
    for name, values in parameters.items():
        piece = np.ascontiguousarray(values)
        if values.dtype != wire:
            with np.errstate(over="ignore"):
                piece = piece.astype(wire)
            if not np.isfinite(piece).all():
                raise MessageError(f"policy weights after {updates} updates: {name} has no finite numbers in {dtype}")
        pieces.append(piece)
    seal = _SEAL if _is_large(encoder_strides, wire) else None
    fields = {
        "version": version,
        "updates": updates,
        "algorithm": algorithm,
        "hidden_size": hidden_size,
        "encoder_strides": np.array(encoder_strides, np.int64),
        "names": list(parameters),
        "shapes": [list(values.shape) for values in parameters.values()],
        "dtype": dtype,
        "digest": _digest(pieces) if seal is None else _NO_DIGEST,
    }
    return encode_gathered(PolicyWeights, fields, pieces, seal)


def prepare_encoding(encoder_strides: Sequence[int], dtype: str) -> None:
    """Compile what :func:`encode_weights` needs, not when the first policy is pushed."""
    if _is_large(encoder_strides, _wire_dtype(dtype)):
        compile_take_in_and_copy()


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


def unpack_weights(weights: PolicyWeights, expected: ParameterLayout) -> dict[str, Float32Array]:
    """Return name -> array, for names and shapes that the task's policy has, in whatever order they come.

    Raises:
        MessageError: the buffer was changed on its way, does not fit the names and shapes, is not finite, or
            belongs to another network than ``expected``.
    """
    wire = _wire_dtype(weights.dtype)
    digest, is_finite = _looked_at(weights, wire)
    if weights.digest != digest:
        raise MessageError(f"policy weights {weights.version}: expected digest {weights.digest}, got {digest}")
    layout = expected
    if weights.names != expected.names or weights.shapes != expected.shapes:
        layout = _in_another_order(weights, expected)
    size = layout.size * wire.itemsize
    if weights.buffer.nbytes != size:
        raise MessageError(f"policy weights {weights.version}: expected {size} bytes, got {weights.buffer.nbytes}")
    flat = as_aligned(weights.buffer.view(wire)).astype(np.float32, copy=False)
    if not (_all_finite(flat) if is_finite is None else is_finite):
        raise MessageError(f"policy weights {weights.version}: expected finite numbers, got NaN or infinity")
    record = flat.view(layout.record)[0]
    return {name: record[name] for name in layout.names}


def _in_another_order(weights: PolicyWeights, expected: ParameterLayout) -> ParameterLayout:
    """Return the layout of weights that are not laid out as ``expected``, if that is the only difference."""
    got, wanted = dict(zip(weights.names, weights.shapes, strict=False)), expected.by_name
    if not len(weights.names) == len(weights.shapes) == len(got) or got != wanted:
        differing = sorted(n for n in got.keys() | wanted.keys() if got.get(n) != wanted.get(n))
        raise MessageError(
            f"policy weights {weights.version} are for another network: {differing[0] if differing else 'names'}: "
            f"expected shape {wanted.get(differing[0]) if differing else None}, "
            f"got {got.get(differing[0]) if differing else None}"
        )
    return ParameterLayout(weights.names, weights.shapes)


def _wire_dtype(dtype: str) -> np.dtype[Any]:
    if dtype not in _WIRE_DTYPES:
        raise MessageError(f"policy weights: expected dtype in {list(_WIRE_DTYPES)}, got {dtype!r}")
    return _WIRE_DTYPES[dtype]


def _looked_at(weights: PolicyWeights, wire: np.dtype[Any]) -> tuple[str, bool | None]:
    """Return the digest of the buffer and whether its numbers are finite; None: they are still to be looked at."""
    if _is_large(weights.encoder_strides, wire):
        return digest_and_finite(weights.buffer)
    return _digest([weights.buffer]), None


def _all_finite(values: npt.NDArray[Any]) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):
        # What is not finite makes the sum of squares so, and that takes half the time of looking at each.
        if values.dtype == np.float32 and np.isfinite(np.dot(values, values)):
            return True
    return bool(np.isfinite(values).all())


def _digest(pieces: Sequence[npt.NDArray[Any]]) -> str:
    # Against accidents, not against forgers: twenty times as fast as a cryptographic hash.
    digest = xxhash.xxh3_128()
    for piece in pieces:
        digest.update(piece.data)
    return digest.hexdigest()


def _is_large(encoder_strides: Sized, wire: np.dtype[Any]) -> bool:
    """Return whether policies are so large that LLVM is imported for them: those with camera, unless halved."""
    return len(encoder_strides) > 0 and wire == np.float32
