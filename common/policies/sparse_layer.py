"""A wide layer that reads only what its inputs call for: the weights of units that are not zero.

After a ReLU about half of the units are zero, and a product with 1024 x 1024 weights takes as long as fetching them
from the third-level cache does. So here they lie transposed, one contiguous row for each input, and rows of zero inputs
are not fetched. NumPy has no such product; LLVM compiles the loop when the first layer is made, in .1 s.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from typing import cast

import numpy as np

from common.messages import Float32Array
from common.native_code import compile_function

_LANES = 16
"""Outputs computed at once, and floats in a line of the cache."""
_AT_ONCE = 4
"""Rows added at once: so often the result is loaded and stored in vain. (m) With eight, or with prefetches of the rows
that come next, it takes as long or longer."""
_NARROWEST = 512
"""(m) On a Zen 5 with 1 MB of second-level cache, half of the inputs zero: 1024 wide 26 µs instead of 50; 768, 13
instead of 28; 512, 5.7 instead of 10.8; 256, 1.9 instead of 2.8, for which it is not worth compiling anything."""


def is_worthwhile(outputs: int) -> bool:
    """Return whether a layer of so many outputs, with as many inputs that were ReLUs, is faster this way."""
    return outputs >= _NARROWEST and outputs % _LANES == 0


class SparseLayer:
    """Bias + weight * inputs, for one vector of inputs of which many are zero."""

    def __init__(self, weight: Float32Array, bias: Float32Array) -> None:
        """Transpose ``weight`` (outputs, inputs), which takes .8 ms for 1024 x 1024; ``bias`` (outputs,).

        All must be finite, as a policy's are: the product of a zero input with an infinity is left out.
        """
        outputs, inputs = weight.shape
        if outputs % _LANES or not weight.size or bias.shape != (outputs,):
            raise ValueError(
                f"expected a multiple of {_LANES} outputs and at least one input, and as many biases as outputs; "
                f"got weights {weight.shape}, biases {bias.shape}"
            )
        self._product = load()
        self._rows = _aligned(inputs, outputs)
        # A line of the cache at a time: all at once, the lines of a column would displace each other, and take 4 ms.
        for first in range(0, outputs, _LANES):
            self._rows[:, first : first + _LANES] = weight[first : first + _LANES].T
        self._bias = np.ascontiguousarray(bias, np.float32)
        self._inputs_shape, self._outputs = (inputs,), outputs
        self._rows_at, self._bias_at = _address(self._rows), _address(self._bias)

    def __call__(self, inputs: Float32Array) -> Float32Array:
        """(inputs,) -> (outputs,). NaN is not zero: it makes everything NaN, as it does in any product."""
        inputs = np.ascontiguousarray(inputs, np.float32)
        if inputs.shape != self._inputs_shape:
            raise ValueError(f"expected inputs of shape {self._inputs_shape}, got {inputs.shape}")
        result = np.empty(self._outputs, np.float32)
        self._product(
            _address(inputs), self._rows_at, self._bias_at, _address(result), self._inputs_shape[0], self._outputs
        )
        return result


@cache
def load() -> Callable[[int, int, int, int, int, int], None]:
    """Compile the product.

    Its arguments: addresses of the inputs, of the rows (inputs, outputs), of the bias and of the result, which is none
    of the others; number of inputs, at least one, and of outputs, a multiple of 16 but not zero. The rows begin at a
    multiple of 64 bytes.
    """
    address, integer = ctypes.c_void_p, ctypes.c_int64
    # It keeps Python's lock: to give that away for 26 µs means to wait for it afterwards, up to 5 ms. (m) Beside a
    # thread busy with Python, 0 to .8 % of the calls take more than 1 ms, and 0 to 14 % if they give it away.
    prototype = ctypes.PYFUNCTYPE(None, address, address, address, address, integer, integer)
    return cast("Callable[[int, int, int, int, int, int], None]", compile_function(_PRODUCT, "product", prototype))


def _address(array: Float32Array) -> int:
    return cast("int", array.__array_interface__["data"][0])


def _aligned(rows: int, columns: int) -> Float32Array:
    """Return an array that begins at a line of the cache."""
    space = np.empty(rows * columns + _LANES, np.float32)
    start = -_address(space) // 4 % _LANES
    return space[start : start + rows * columns].reshape(rows, columns)


_VECTOR = f"<{_LANES} x float>"


def _group() -> str:
    """The rows that are added at once, and the factor of each in all lanes."""
    return "".join(
        f"""
  %k.{r} = add i64 %k, {r}
  %input.at.{r} = getelementptr i64, ptr %active, i64 %k.{r}
  %input.{r} = load i64, ptr %input.at.{r}
  %offset.{r} = mul i64 %input.{r}, %outputs
  %row.{r} = getelementptr float, ptr %rows, i64 %offset.{r}
  %factor.at.{r} = getelementptr float, ptr %factors, i64 %k.{r}
  %factor.{r} = load float, ptr %factor.at.{r}
  %lane.{r} = insertelement {_VECTOR} poison, float %factor.{r}, i64 0
  %lanes.{r} = shufflevector {_VECTOR} %lane.{r}, {_VECTOR} poison, <{_LANES} x i32> zeroinitializer"""
        for r in range(_AT_ONCE)
    )


def _sums() -> str:
    """Of the group, for sixteen outputs."""
    return "".join(
        f"""
  %weights.at.{r} = getelementptr float, ptr %row.{r}, i64 %i
  %weights.{r} = load {_VECTOR}, ptr %weights.at.{r}, align 64
  %sum.{r + 1} = call {_VECTOR} @llvm.fmuladd({_VECTOR} %lanes.{r}, {_VECTOR} %weights.{r}, {_VECTOR} %sum.{r})"""
        for r in range(_AT_ONCE)
    )


# The list of what is not zero ends with rows whose factor is zero, so that groups are whole, and at least one there is.
_PRODUCT = f"""
declare {_VECTOR} @llvm.fmuladd({_VECTOR}, {_VECTOR}, {_VECTOR})

define void @product(ptr %values, ptr %rows, ptr %bias, ptr noalias %result, i64 %inputs, i64 %outputs) {{
start:
  %room = add i64 %inputs, {_AT_ONCE}
  %active = alloca i64, i64 %room
  %factors = alloca float, i64 %room
  br label %scan

scan:
  %j = phi i64 [0, %start], [%j.next, %scan]
  %n = phi i64 [0, %start], [%n.next, %scan]
  %value.at = getelementptr float, ptr %values, i64 %j
  %value = load float, ptr %value.at, align 1
  %free.input = getelementptr i64, ptr %active, i64 %n
  %free.factor = getelementptr float, ptr %factors, i64 %n
  store i64 %j, ptr %free.input
  store float %value, ptr %free.factor
  %is.active = fcmp une float %value, 0.0
  %one = zext i1 %is.active to i64
  %n.next = add i64 %n, %one
  %j.next = add i64 %j, 1
  %j.more = icmp ult i64 %j.next, %inputs
  br i1 %j.more, label %scan, label %fill

fill:
  %end.inputs = getelementptr i64, ptr %active, i64 %n.next
  %end.factors = getelementptr float, ptr %factors, i64 %n.next
  store <{_AT_ONCE} x i64> zeroinitializer, ptr %end.inputs, align 1
  store <{_AT_ONCE} x float> zeroinitializer, ptr %end.factors, align 1
  br label %group

group:
  %k = phi i64 [0, %fill], [%k.next, %end]
  %before = phi ptr [%bias, %fill], [%result, %end]
  {_group()}
  br label %outputs.16

outputs.16:
  %i = phi i64 [0, %group], [%i.next, %outputs.16]
  %before.at = getelementptr float, ptr %before, i64 %i
  %sum.0 = load {_VECTOR}, ptr %before.at, align 1
  {_sums()}
  %result.at = getelementptr float, ptr %result, i64 %i
  store {_VECTOR} %sum.{_AT_ONCE}, ptr %result.at, align 1
  %i.next = add i64 %i, {_LANES}
  %i.more = icmp ult i64 %i.next, %outputs
  br i1 %i.more, label %outputs.16, label %end

end:
  %k.next = add i64 %k, {_AT_ONCE}
  %k.more = icmp ult i64 %k.next, %n.next
  br i1 %k.more, label %group, label %return

return:
  ret void
}}
"""
