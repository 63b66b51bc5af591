"""Ctrl-C while libraries are loaded."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from common.stop_signals import StopSignals
from experiments.loading import load_libraries, uninterrupted

ROOT = Path(__file__).parents[2]


class EndsInterrupted:
    """Its end is a place from which Python lets no exception out."""

    def __init__(self, number):
        self._number = number

    def __del__(self):
        os.kill(os.getpid(), self._number)
        time.monotonic()  # Here, at the latest, Python handles the signal.


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_stop_in_the_middle_ends_it_at_once(number, monkeypatch):
    def load(name):
        os.kill(os.getpid(), number)
        raise AssertionError("it went on")

    monkeypatch.setattr("experiments.loading._load", load)
    with StopSignals() as stop:
        handler = signal.getsignal(number)
        with pytest.raises(KeyboardInterrupt):
            load_libraries("sac", stop)
        assert signal.getsignal(number) == handler


def test_a_stop_that_python_swallows_is_not_forgotten(monkeypatch):
    monkeypatch.setattr(sys, "unraisablehook", lambda unraisable: None)
    monkeypatch.setattr("experiments.loading._load", lambda name: EndsInterrupted(signal.SIGINT) and None)
    with StopSignals() as stop, pytest.raises(KeyboardInterrupt):
        load_libraries("sac", stop)


def test_a_stop_that_came_before_loads_nothing(monkeypatch):
    monkeypatch.setattr("experiments.loading._load", lambda name: 1 // 0)
    with StopSignals() as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            load_libraries("sac", stop)


def test_nothing_of_torch_is_left_for_the_services_to_load():
    program = """
import sys
from common.stop_signals import StopSignals
from experiments.loading import load_libraries, uninterrupted
load_libraries("sac", StopSignals())
before = set(sys.modules)
import torch
from common.algorithms.adam import Adam
parameter = torch.nn.Parameter(torch.zeros(3))
Adam({"one": parameter}, 1e-3, (0.9, 0.999)).minimise(parameter.sum())
print(sorted(name for name in set(sys.modules) - before if name.partition(".")[0] == "torch"))
"""
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True, capture_output=True, text=True)
    assert result.stdout.strip() == "[]"


def test_a_stop_is_held_back_until_something_is_made():
    made = []

    def make():
        os.kill(os.getpid(), signal.SIGINT)
        time.monotonic()
        made.append("whole")

    with pytest.raises(KeyboardInterrupt):
        uninterrupted(make)
    assert made == ["whole"]
