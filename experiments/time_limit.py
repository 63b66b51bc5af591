"""``python -m experiments.time_limit --task T``: will -1 a step be learnt here, and under which time limit?

The guideline of the thesis (7.3) as a tool. It counts the initial policy's target hits under each limit, searches for
the minimum steps to the goal, and says which limit to start with and why. It stops as soon as the answer is clear.
The rule and its reasons are in :mod:`experiments.target_hits.guideline`, the tests that allow to stop early in
:mod:`experiments.target_hits.certainty`, the search in :mod:`experiments.target_hits.search`.

Counts are those of ``python -m experiments.hits`` for the same seeds, and either tool takes over what the other has
left in ``DIR``. ``DIR/time_limit_T.txt`` holds the answer.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence

import numpy as np

from common.console import Console
from common.errors import ConfigError, RelodError
from common.record import write_atomically
from common.stop_signals import INTERRUPTED, StopSignals
from experiments.command_line import exit_code
from experiments.grid import GridRecord, failure_text, key_text, run_grid
from experiments.loading import uninterrupted
from experiments.target_hits.advice import TaskFacts, advice
from experiments.target_hits.certainty import FEWEST_BLOCKS
from experiments.target_hits.choice import (
    MOST_WORKERS,
    TaskChoice,
    add_options,
    check_count,
    check_limits,
    choose_task,
    record_settings,
)
from experiments.target_hits.counting import STEPS
from experiments.target_hits.guideline import Evidence, Thoroughness, judge, next_look
from experiments.target_hits.jobs import all_keys, hits_key, relative_cost, start_key, work
from experiments.target_hits.search import EFFORT
from experiments.wording import counted
from experiments.workers import Key, WorkerPool

SEEDS_AT_ONCE = 5
STARTS_AT_ONCE = 10
"""Looked at between two judgements: the same for any number of workers, so that the answer is."""
_SEEDS_APART = 1000


class Inquiry:
    """Looks at a task until the guideline has an answer."""

    def __init__(self, task: str, limits: Sequence[int], seed: int, thoroughness: Thoroughness) -> None:
        """Args:
        task: its id.
        limits: to choose from.
        seed: of all that is random.
        thoroughness: when to stop.
        """
        self._task, self._limits, self._thoroughness = task, limits, thoroughness
        self._first_number = seed * _SEEDS_APART
        self._seeds = dict.fromkeys(limits, 0)
        self._starts = 0

    def next_jobs(self, evidence: Evidence) -> list[Key]:
        """What to look at next, given what was seen; nothing: the answer is there."""
        if not any(self._seeds.values()):
            self._seeds = dict.fromkeys(self._limits, FEWEST_BLOCKS)
            return self._hits_keys()
        look = next_look(evidence, self._thoroughness)
        if look.limit is not None:
            most = self._thoroughness.most_seeds
            self._seeds[look.limit] = min(self._seeds[look.limit] + SEEDS_AT_ONCE, most)
        if look.starts:
            self._starts += STARTS_AT_ONCE
        return [*self._hits_keys(), *self._start_keys()] if look.needed else []

    def evidence(self, record: GridRecord) -> Evidence:
        """What was seen of what was looked at.

        Raises:
            RelodError: a job has no result.
        """
        missing = [key for key in [*self._hits_keys(), *self._start_keys()] if key not in record.rows]
        if missing:
            raise RelodError(
                f"{counted(len(missing), 'job')} failed ({key_text(missing[0])} first), so there is no answer; "
                f"see {record.directory / 'failures.log'}. The same command tries them again"
            )
        return Evidence(
            hits={
                limit: tuple(
                    record.rows[hits_key(self._task, limit, self._first_number + seed)]["hits"] for seed in range(seeds)
                )
                for limit, seeds in self._seeds.items()
            },
            starts=tuple(record.rows[key]["steps"] for key in self._start_keys()),
        )

    def _hits_keys(self) -> list[Key]:
        return [
            key
            for limit, seeds in self._seeds.items()
            for key in all_keys([self._task], [limit], range(self._first_number, self._first_number + seeds))
        ]

    def _start_keys(self) -> list[Key]:
        return [start_key(self._task, self._first_number + number) for number in range(self._starts)]


def inquire(
    inquiry: Inquiry,
    record: GridRecord,
    pool: WorkerPool,
    console: Console,
    asked_to_stop: Callable[[], bool],
    cost: Callable[[Key], float],
) -> Evidence | None:
    """Look until there is an answer; return what was seen, or None if asked to stop."""
    evidence = Evidence({})
    while jobs := inquiry.next_jobs(evidence):
        run_grid(
            record,
            jobs,
            pool,
            progress=lambda progress: console.status(f"{progress} until the next judgement"),
            failed=lambda failure: console.error(failure_text(failure)),
            asked_to_stop=asked_to_stop,
            cost=cost,
        )
        if asked_to_stop():
            return None
        evidence = inquiry.evidence(record)
    return evidence


def main(arguments: Sequence[str] | None = None) -> int:
    """Answer from the command line; return the exit code."""
    options = _parser().parse_args(arguments)
    console = Console()
    return exit_code("experiments.time_limit", "--out", options.out, console, lambda: _answer(options, console))


def _answer(options: argparse.Namespace, console: Console) -> int:
    limits = check_limits(options.limits)
    workers = check_count("--workers", options.workers, MOST_WORKERS)
    if options.seed < 0:
        raise ConfigError(f"--seed {options.seed}: expected at least 0")
    choice = uninterrupted(lambda: choose_task(options.task, options.preset, options.set))
    thoroughness = Thoroughness()
    effort = check_count("--effort", options.effort)
    if effort < max(limits):
        raise ConfigError(
            f"--effort {effort}: expected at least the longest of the limits, {counted(max(limits), 'step')}: "
            "a shorter search cannot tell whether the goal can be reached within it"
        )
    with StopSignals() as stop:
        settings = record_settings([choice], steps=STEPS, effort=effort)
        with (
            GridRecord(options.out, settings) as record,
            WorkerPool(work, settings, workers) as pool,
        ):
            console.line(f"{choice.name} ({choice.preset}): counting hits, then searching for ways to the goal")
            evidence = inquire(
                Inquiry(choice.name, limits, options.seed, thoroughness),
                record,
                pool,
                console,
                lambda: stop.asked,
                relative_cost(settings),
            )
    if evidence is None:
        console.line("interrupted: the same command goes on from here")
        return INTERRUPTED
    text = advice(_facts(choice, effort), evidence, judge(evidence, thoroughness), thoroughness)
    path = options.out / f"time_limit_{choice.name}.txt"
    write_atomically(path, text + "\n")
    console.line(f"\n{text}\n\n{path}")
    return 0


def _facts(choice: TaskChoice, effort: int) -> TaskFacts:
    spec = choice.build(np.random.default_rng(0)).spec
    return TaskFacts(choice.name, choice.preset, spec.action_cycle_time_s, spec.reset_steps, effort)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m experiments.time_limit",
        description="Say which time limit to start with on a minimum-time task, if any, and why.",
        epilog="example: python -m experiments.time_limit --task reacher_easy",
    )
    parser.add_argument("--task", required=True, metavar="T", help="task id, or id=module:Class for a task of your own")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of all that is random (default: %(default)s)")
    parser.add_argument(
        "--effort",
        type=int,
        default=EFFORT,
        metavar="N",
        help="most steps to simulate in the search from one start (default: %(default)s)",
    )
    add_options(parser, "runs/time_limit")
    return parser


if __name__ == "__main__":
    sys.exit(main())
