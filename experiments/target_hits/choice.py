"""Which tasks are looked at, with which settings, from the command line."""

from __future__ import annotations

import argparse
import hashlib
import inspect
import itertools
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from common.config import parse_override
from common.errors import ConfigError
from common.options import output_folder
from experiments.target_hits.initial_policy import initial_actions
from experiments.target_hits.world import NotMinimumTimeError, World
from services.robot_bridge.tasks import Task, load_task

LIMITS = (1, 2, 5, 10, 25, 50, 100, 500, 1000, 5000)
"""Time limits of figures 7.2 and 8.4, steps."""
PREFERRED_PRESET = "thesis"
"""Taken where a task has it and nobody asks for another: its numbers can be compared with the thesis's."""

MOST = 1_000_000_000
"""Of whatever is counted."""
MOST_SEEDS = 10_000
"""Every job is listed before the first one begins."""
MOST_WORKERS = 256
_FIRST_LOOK_STEPS = 100
_SECTION = "task"
_ROBOTS_SIDE = "services.robot_bridge."
_DECIDES_WORLDS = ("numpy", "mujoco", "dm-control")
"""Packages whose next version may draw or simulate differently."""


@dataclass(frozen=True)
class TaskChoice:
    """A task, ready to be built in any process."""

    name: str
    preset: str
    overrides: Mapping[str, Any]
    rows: Mapping[str, str] = field(default_factory=dict)
    """More rows for the table of tasks."""

    def build(self, rng: np.random.Generator) -> Task:
        """Build the task in lockstep; ``rng`` is all of its randomness."""
        return load_task(self.name, self.preset, self.overrides, self.rows, pacing="lockstep", rng=rng)


def choose_task(name: str, preset: str | None = None, overrides: Sequence[str] = ()) -> TaskChoice:
    """Check a choice by building the task, and by a first look at its rewards.

    Args:
        name: task id, or ``id=module:Class`` for a task that is not in the table.
        preset: of the task; None takes :data:`PREFERRED_PRESET`, or the task's default.
        overrides: ``task.key=value``.

    Raises:
        ConfigError: unknown task, preset or setting, a task without goal, or not with -1 a step.
    """
    task_id, equals, target = name.partition("=")
    rows = {task_id: target} if equals else {}
    values: dict[str, Any] = {}
    for override in overrides:
        section, key, value = parse_override(override)
        if section != _SECTION:
            raise ConfigError(f"--set {override}: only settings of the task count here: expected task.key=value")
        if key == "time_limit":
            raise ConfigError(f"--set {override}: the time limits to try are given by --limits")
        values[key] = value
    rng = np.random.default_rng(0)
    if preset is None:
        presets = load_task(task_id, rows=rows, rng=rng).PRESETS
        preset = PREFERRED_PRESET if PREFERRED_PRESET in presets else ""
    task = load_task(task_id, preset, values, rows, rng=rng)
    task.close()
    if not task.spec.has_goal:
        raise ConfigError(
            f"--task {task_id}: it has no goal to hit, its attempts end at the time limit only; "
            "target hits and the guideline are for minimum-time tasks, whose attempts end where the goal is reached"
        )
    choice = TaskChoice(task_id, task.spec.preset, values, rows)
    _look_at_rewards(choice)
    return choice


def _look_at_rewards(choice: TaskChoice) -> None:
    """Refuse a task at once, and once, that the jobs would refuse one after the other."""
    rng = np.random.default_rng(0)
    task = choice.build(rng)
    try:
        world = World(task)
        world.begin_episode()
        for action in itertools.islice(initial_actions(world.spec, rng), _FIRST_LOOK_STEPS):
            if world.reaches_goal(action):
                world.begin_episode()
    except NotMinimumTimeError as error:
        raise ConfigError(f"--task {choice.name}: {error}") from error
    except Exception:  # Whatever else is wrong with it, the jobs say, with a traceback.
        return
    finally:
        task.close()


def record_settings(choices: Sequence[TaskChoice], **counted: int) -> dict[str, Any]:
    """What the numbers of a grid of these tasks depend on, as plain values.

    Args:
        choices: the tasks.
        counted: settings of the jobs: ``steps`` to count hits in, ``effort`` of a search.
    """
    settings: dict[str, Any] = {
        **counted,
        "versions": {name: _version(name) for name in _DECIDES_WORLDS},
    }
    for choice in choices:
        task = choice.build(np.random.default_rng(0))
        spec = task.spec
        settings[f"task {choice.name}"] = {
            "source": _source_digest(type(task)),
            "preset": choice.preset,
            "overrides": dict(choice.overrides),
            "rows": dict(choice.rows),
            "reset_steps": spec.reset_steps,
            "action_low": spec.action_low.tolist(),
            "action_high": spec.action_high.tolist(),
        }
    return settings


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:  # not every task needs each of them
        return "not installed"


def _source_digest(task_class: type[Task]) -> str:
    """Of the files that define a task: counts of an edited task must not be mixed with those before."""
    contents = [Path(file).read_bytes() for file in source_files(task_class)]
    return hashlib.blake2b(b"".join(contents), digest_size=8).hexdigest()


def source_files(task_class: type[Task]) -> list[str]:
    """The files that define a task: its own, and what they take from the robots' side of this project."""
    own = {cls.__module__ for cls in task_class.__mro__ if issubclass(cls, Task)}
    found: set[str] = set()
    pending = list(own)
    while pending:
        name = pending.pop()
        if name in found:
            continue
        found.add(name)
        named = vars(sys.modules[name]).values()
        origins = {value.__name__ if inspect.ismodule(value) else getattr(value, "__module__", None) for value in named}
        pending += [origin for origin in origins if str(origin).startswith(_ROBOTS_SIDE) and origin in sys.modules]
    files = (inspect.getsourcefile(sys.modules[name]) for name in sorted(found))
    return [file for file in files if file]


def choice_from(settings: Mapping[str, Any], task: str) -> TaskChoice:
    """The choice of ``task`` that :func:`record_settings` has written down."""
    values = settings[f"task {task}"]
    return TaskChoice(task, values["preset"], values["overrides"], values["rows"])


def add_options(parser: argparse.ArgumentParser, out: str) -> None:
    """Add the options that both tools have."""
    parser.add_argument(
        "--limits",
        type=int,
        nargs="+",
        default=list(LIMITS),
        metavar="N",
        help="time limits, steps (default: %(default)s)",
    )
    parser.add_argument(
        "--preset", metavar="NAME", help=f"of the task (default: {PREFERRED_PRESET} where there is one)"
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="task.KEY=VALUE", help="change a setting of the task"
    )
    parser.add_argument(
        "--workers", type=int, default=usable_cores(), metavar="N", help="processes (default: one a core, %(default)s)"
    )
    parser.add_argument(
        "--out", type=output_folder, default=out, metavar="DIR", help="folder of the results (default: %(default)s)"
    )


def check_limits(limits: Sequence[int]) -> tuple[int, ...]:
    """The limits, ascending, each once.

    Raises:
        ConfigError: one is no number of steps.
    """
    for limit in limits:
        if limit < 1:
            raise ConfigError(f"--limits {limit}: expected at least 1 step")
        if limit > MOST:
            raise ConfigError(f"--limits {limit}: expected at most {MOST} steps")
    return tuple(sorted(set(limits)))


def check_count(option: str, value: int, most: int = MOST) -> int:
    """``value``, if there can be so many: from one to ``most``.

    Raises:
        ConfigError: there cannot.
    """
    if value < 1:
        raise ConfigError(f"{option} {value}: expected at least 1")
    if value > most:
        raise ConfigError(f"{option} {value}: expected at most {most}")
    return value


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))
