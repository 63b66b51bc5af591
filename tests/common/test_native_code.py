"""Text becomes a function, or an error that says what is wrong with it."""

from __future__ import annotations

import ctypes
import gc

import pytest

from common.native_code import compile_function

ADD = "define i64 @add(i64 %a, i64 %b) {\n  %sum = add i64 %a, %b\n  ret i64 %sum\n}"


@pytest.mark.parametrize("kind", [ctypes.CFUNCTYPE, ctypes.PYFUNCTYPE])
def test_a_function_computes_what_its_text_says_as_long_as_it_is_held(kind):
    integer = ctypes.c_int64
    add = compile_function(ADD, "add", kind(integer, integer, integer))
    gc.collect()
    assert add(2**40, -3) == 2**40 - 3


@pytest.mark.parametrize("text", ["define nonsense", ADD.replace("ret i64 %sum", "ret i64 %difference")])
def test_text_that_is_not_llvms_is_refused(text):
    with pytest.raises(RuntimeError, match="LLVM IR parsing error"):
        compile_function(text, "add", ctypes.CFUNCTYPE(None))
