"""Loops of our own in LLVM's language, compiled for the processor at hand while the program runs.

For loops that NumPy does not have, and that numba, which takes a second and twice the memory, would compile to worse
code. LLVM is imported with the first of them, not with this module.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def compile_function(text: str, name: str, prototype: Callable[[int], Any]) -> Any:
    """Return the function ``name`` of the LLVM module ``text``; call this before anybody waits, it takes .1 to .2 s.

    Args:
        text: the module; parsed and verified, so that mistakes are exceptions.
        name: of the function in it.
        prototype: what ``ctypes`` makes callable of its address: a ``CFUNCTYPE``, which lets other threads go on
            meanwhile, or a ``PYFUNCTYPE``, which does not.
    """
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=3
    )
    module = llvm.parse_assembly(text)
    module.verify()
    passes = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=3))
    passes.getModulePassManager().run(module, passes)
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    function = prototype(engine.get_function_address(name))
    function.engine = engine  # owns the code
    return function
