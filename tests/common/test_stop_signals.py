"""Signals that ask to stop, counted: a second one is another wish, unless it is the first's echo."""

import os
import signal

import pytest

from common.stop_signals import StopSignals


@pytest.mark.parametrize(("second_s", "asked_again"), [(10.49, False), (10.5, True), (60.0, True)])
def test_a_second_signal_counts_half_a_second_after_the_first(second_s, asked_again):
    times_s = iter([10.0, second_s])
    with StopSignals(lambda: next(times_s)) as stop:
        assert not stop.asked
        os.kill(os.getpid(), signal.SIGINT)
        assert (stop.asked, stop.asked_s, stop.asked_again) == (True, 10.0, False)
        os.kill(os.getpid(), signal.SIGTERM)
        assert (stop.asked_s, stop.asked_again) == (10.0, asked_again)
