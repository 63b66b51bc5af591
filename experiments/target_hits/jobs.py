"""The two kinds of jobs of the minimum-time tools: count hits in one seed's steps, search ways from one start."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.grid import Row
from experiments.target_hits.choice import choice_from
from experiments.target_hits.counting import acted_share, count_hits
from experiments.target_hits.initial_policy import initial_actions
from experiments.target_hits.search import shortest_way
from experiments.target_hits.world import World
from experiments.workers import Key

_START = "start"


@dataclass(frozen=True)
class HitCount:
    """A row of ``hits.csv``."""

    task: str
    limit: int
    """Time limit, steps."""
    seed: int
    hits: int


def hits_key(task: str, limit: int, seed: int) -> Key:
    """Job: count the hits under a time limit."""
    return (task, limit, seed)


def start_key(task: str, number: int) -> Key:
    """Job: search for the shortest way to the goal from a random start."""
    return (task, _START, number)


def hit_counts(rows: Mapping[Key, Row]) -> list[HitCount]:
    """The counts among a grid's rows, in the order of tasks, limits and seeds."""
    counts = [
        HitCount(str(key[0]), int(key[1]), int(key[2]), int(row["hits"]))
        for key, row in rows.items()
        if key[1] != _START
    ]
    return sorted(counts, key=lambda count: (count.task, count.limit, count.seed))


def work(settings: Mapping[str, Any], key: Key) -> Row:
    """Do one job; all randomness follows from its key."""
    task, what = str(key[0]), key[1]
    of_world, of_start, of_policy = (np.random.default_rng(seeds) for seeds in stream(*key).spawn(3))
    built = choice_from(settings, task).build(of_world)
    try:
        world = World(built)
        if what != _START:
            return {"hits": count_hits(world, initial_actions(world.spec, of_policy), int(what), settings["steps"])}
        start = of_start.bit_generator.state

        def restart() -> None:
            of_world.bit_generator.state = start
            world.begin_episode()

        way = shortest_way(world, restart, of_policy, settings["effort"])
        return {"steps": way.steps, "effort": way.effort}
    finally:
        built.close()


def stream(*names: str | int) -> np.random.SeedSequence:
    """The random numbers of a job: the same on any computer, in any order of jobs, for any number of workers."""
    return np.random.SeedSequence(
        [int.from_bytes(name.encode(), "big") if isinstance(name, str) else name for name in names]
    )


def relative_cost(settings: Mapping[str, Any]) -> Callable[[Key], float]:
    """How long a job takes compared to another: by the steps in which the robot acts."""

    def of(key: Key) -> float:
        return 1.0 if key[1] == _START else acted_share(int(key[1]), settings[f"task {key[0]}"]["reset_steps"])

    return of


def all_keys(tasks: Iterable[str], limits: Iterable[int], seeds: Iterable[int]) -> list[Key]:
    """Keys of a whole table, seed by seed, so that an unfinished table has something of everything."""
    tasks, limits = list(tasks), list(limits)
    return [hits_key(task, limit, seed) for seed in seeds for task in tasks for limit in limits]
