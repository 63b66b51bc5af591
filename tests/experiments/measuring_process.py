"""``measuring_process.py VALUE``: needs computing times; says how it gets them, and what they are.

A measurement gives VALUE once the input ends; asking for the cache's lock is told before.
"""

import fcntl
import sys

from experiments import virtual_costs
from experiments.virtual_costs import ComputingTimes
from tests.experiments.test_virtual_costs import configurations, times

flock, value = fcntl.flock, float(sys.argv[1])


def say(text: str) -> None:
    print(text, flush=True)


def measure(*_: object) -> ComputingTimes:
    say("measures")
    sys.stdin.read()
    return ComputingTimes(value, value)


def told_flock(file: int, operation: int) -> None:
    say("asks for the lock")
    flock(file, operation)


virtual_costs.measure, fcntl.flock = measure, told_flock
say(str(times(virtual_costs.with_computing_times(configurations(), None))))
