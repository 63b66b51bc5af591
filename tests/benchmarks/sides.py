"""Sides of a comparison that take no time: what a test wants them to answer."""

from __future__ import annotations

import os
import sys

from benchmarks.side import Prepared, UnavailableError


def constant(resources, *, value, result=()):
    """Measure ``value`` in every round."""
    print("what a library prints is no answer")
    return Prepared(lambda: [value], list(result))


def rising(resources, *, values):
    """Measure one of ``values`` after the other."""
    left = iter(values)
    return Prepared(lambda: [next(left)])


def failing(resources):
    """Cannot be prepared."""
    raise ValueError("no such thing")


def failing_later(resources):
    """Fails in its first round."""

    def measure():
        raise ValueError("worn out")

    return Prepared(measure)


def dying(resources):
    """Ends without a word on its standard output."""
    print("out of memory", file=sys.stderr, flush=True)
    os._exit(3)


def unavailable(resources):
    """Lacks a library."""
    raise UnavailableError("no GL library: install libegl1")


def environment(resources, *, name):
    """Tells whether an environment variable is set, and to what whole number."""
    return Prepared(lambda: [float(os.environ.get(name, "-1"))])
