"""Which number format ``auto`` means."""

from __future__ import annotations

import pytest
import torch

from common.cpu_tuning import has_bfloat16
from common.networks.precision import wide_dtype

CPU = torch.device("cpu")


def test_auto_takes_bfloat16_only_where_the_processor_has_it():
    expected = torch.bfloat16 if has_bfloat16() else torch.float32
    assert wide_dtype("auto", CPU, torch.float32) == expected


def test_auto_and_float32_keep_float64_for_comparisons():
    assert wide_dtype("auto", CPU, torch.float64) == torch.float64
    assert wide_dtype("float32", CPU, torch.float64) == torch.float64


def test_bfloat16_can_be_asked_for_anywhere():
    assert wide_dtype("bfloat16", CPU, torch.float32) == torch.bfloat16


@pytest.mark.parametrize(
    ("capability", "expected"),
    [((7, 5), torch.float32), ((8, 0), torch.bfloat16), ((8, 9), torch.bfloat16), ((9, 0), torch.bfloat16)],
    ids=["Turing", "Ampere", "Ada", "Hopper"],
)
def test_auto_takes_bfloat16_on_a_gpu_only_where_it_is_not_emulated(monkeypatch, capability, expected):
    gpu, asked = torch.device("cuda:1"), []
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: asked.append(device) or capability)
    assert wide_dtype("auto", gpu, torch.float32) == expected
    assert wide_dtype("float32", gpu, torch.float32) == torch.float32
    assert wide_dtype("auto", gpu, torch.float64) == torch.float64
    assert asked == [gpu]
