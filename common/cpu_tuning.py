"""Fits a process to the computer it runs on: its processor, and how its memory is handed out."""

from __future__ import annotations

import ctypes
import os
import platform
from dataclasses import dataclass
from functools import cache
from pathlib import Path

_MAX_THREADS = 8
"""Minibatches of a few hundred keep no more cores busy."""

# Parameters of mallopt, from glibc's malloc.h.
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX, _M_ARENA_MAX = -1, -2, -4, -8


@dataclass(frozen=True)
class CpuTuning:
    """What :func:`tune_process` found and set, for the log."""

    cores: int
    """Processors this process may run on."""
    threads: int
    """Threads torch computes with."""
    bfloat16: bool
    """The processor multiplies in bfloat16."""
    malloc_tuned: bool
    """glibc's malloc keeps freed memory."""


def tune_process(threads: int | None = None) -> CpuTuning:
    """Tune memory allocation and threads of this process; call it before anything large is allocated.

    Args:
        threads: threads for torch; None leaves one core to the other services: 1 of 2, 3 of 4, at most 8.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    malloc_tuned = keep_freed_memory(reserve_mib=256, one_arena=True)
    if threads is None:
        # On a contended core two threads that wait for each other are ten times slower than one.
        threads = max(1, min(cores - 1, _MAX_THREADS))
    import torch

    torch.set_num_threads(threads)
    return CpuTuning(cores, threads, has_bfloat16(), malloc_tuned)


@cache
def has_bfloat16() -> bool:
    """Return True if the processor multiplies matrices in bfloat16 (x86 AVX-512 or AMX, or Arm)."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    flags: set[str] = set()
    for line in text.splitlines():
        if line.startswith(("flags", "Features")):
            flags.update(line.partition(":")[2].split())
            break
    return not flags.isdisjoint({"avx512_bf16", "amx_bf16", "bf16"})


def keep_freed_memory(reserve_mib: int = 32, *, one_arena: bool = False) -> bool:
    """Stop glibc from returning freed memory to the kernel, which would page-fault it in again.

    Activations of an update, or the weights of a policy that arrives, are megabytes each time: faulting them in takes
    longer than filling them.

    Args:
        reserve_mib: address space taken from the kernel at a time, MiB.
        one_arena: share one heap among all threads. Other threads' own heaps come in pieces of 64 MiB, too small for
            an update's; but threads that share a heap wait for each other.

    Returns:
        False where the C library is another one.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    settings = {_M_MMAP_MAX: 0, _M_TRIM_THRESHOLD: 2**31 - 1, _M_TOP_PAD: reserve_mib * 2**20}
    if one_arena:
        settings[_M_ARENA_MAX] = 1
    return all(mallopt(parameter, value) == 1 for parameter, value in settings.items())
