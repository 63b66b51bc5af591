"""The GPU's benchmark runs, and says so where there is nothing to measure."""

import re

import pytest
import torch

from benchmarks import cuda

TINY = ["--batch-size", "4", "--rows", "20", "--calls", "2", "--hidden-size", "8"]


@pytest.mark.skipif(torch.cuda.is_available(), reason="this computer has a GPU")
def test_without_a_gpu_it_says_so_and_gives_no_number(capsys):
    assert cuda.main([]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("nothing was measured: learner.device = 'cuda': expected a GPU that torch can use")


def test_everything_is_measured_on_the_device_asked_for(capsys):
    assert cuda.main(["--device", "cpu", *TINY]) == 0
    head, *lines = capsys.readouterr().out.splitlines()
    assert head.startswith("cpu: the CPU; torch ")
    measured = {line[:36].strip(): float(re.fullmatch(r" *([\d.]+) (ms|updates/s)", line[36:])[1]) for line in lines}
    frames = ("frames on the host", "frames on the device")
    assert list(measured) == [
        *(f"minibatch, {where}" for where in frames),
        *(f"float32, {what}" for what in ("update alone", *frames)),
        *(f"bfloat16, {what}" for what in ("update alone", *frames)),
    ]
    assert min(measured.values()) > 0
