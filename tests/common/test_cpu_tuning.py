"""Tuning is done by the call, in the process that calls, and reported."""

from __future__ import annotations

import subprocess
import sys

SCRIPT = """
import os, sys
import common.cpu_tuning as tuning
assert "torch" not in sys.modules
record = tuning.tune_process({threads})
import torch
assert torch.get_num_threads() == record.threads
assert record.cores == len(os.sched_getaffinity(0))
print(record.threads, record.cores)
"""


def tuned(threads):
    script = SCRIPT.format(threads=threads)
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return [int(word) for word in result.stdout.split()]


def test_threads_are_set_as_asked():
    assert tuned(3)[0] == 3


def test_by_default_one_core_is_left_to_the_other_services():
    threads, cores = tuned(None)
    assert threads == max(1, min(cores - 1, 8))
