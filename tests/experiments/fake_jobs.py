"""Jobs for the grid's tests; the workers are processes of their own, so they import them from here."""

import os
import signal
from pathlib import Path


def square(settings, key):
    """The row is settings["offset"] plus the square of the key's number; a file says who has worked."""
    if "begun" in settings:
        (Path(settings["begun"]) / f"{key[1]}").write_text(str(os.getpid()), encoding="utf-8")
    return {"value": settings["offset"] + key[1] ** 2}


def fail_at_three(settings, key):
    """Raises on the key with 3."""
    if key[1] == 3:
        raise ValueError("three is\ntoo many")
    return {"value": key[1]}


def die_at_three(settings, key):
    """The process is killed on the key with 3, as one that has taken too much memory is."""
    if key[1] == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return {"value": key[1]}


def unkeepable(settings, key):
    """A row that no file can hold."""
    return {"value": float("nan")} if key[1] == 3 else {"value": 0.5}


def signal_immunity(settings, key):
    """Survives what a terminal, or whoever ends a job, sends to a whole process group."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(os.getpid(), number)
    return {"value": key[1]}


def cores(settings, key):
    """Which cores its process may run on."""
    return {"cores": sorted(os.sched_getaffinity(0)), "process": os.getpid()}


def cores_or_death(settings, key):
    """The same, but on the key with 3 the process is killed."""
    return die_at_three(settings, key) | cores(settings, key)
