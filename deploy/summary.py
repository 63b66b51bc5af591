"""``python -m deploy.summary RUN_DIR [RUN_DIR ...]``: ``summary.json`` and ``learning_curve.png`` from a run's parts.

A run on two computers leaves a folder on each; what is found in them is put together. What the record does not tell is
null in the summary, with a warning: a run that was cut short has one too.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from common.errors import RelodError
from common.record import write_atomically
from common.topics import ACTOR, LEARNER, REPLAY, ROBOT_BRIDGE
from deploy import parts as run_parts
from deploy.actions import last_published_ns, outage_ends
from deploy.curve import draw_learning_curve
from deploy.episodes import Episode, steps_per_goal
from deploy.parts import RunParts
from deploy.run_file import IN_PROCESS
from deploy.run_record import Record, read_record
from deploy.summary_text import summary_text
from deploy.traffic import bytes_per_key, network_link


@dataclass(frozen=True)
class Summary:
    """The content of ``summary.json`` and what it was drawn from."""

    values: dict[str, Any]
    warnings: list[str]
    episodes: list[Episode]
    has_goal: bool
    """Whether steps per goal mean something in this run."""


def summarise(record: Record) -> Summary:
    """Return the summary of a record."""
    notes: list[str] = []
    warnings = list(record.warnings)
    parts = record.parts
    bridge = parts.newest(ROBOT_BRIDGE)
    if bridge is None:
        warnings.append("the robot_bridge left no part: its counts are missing")
    run = record.run
    steps = _count(parts.latest(ROBOT_BRIDGE, "steps"))
    has_goal = run_parts.newest_detail(parts, ROBOT_BRIDGE, "has_goal")
    if run and run.ended_early and (steps or 0) < run.steps:
        notes.append(f"the run was cut short, at {steps or 0} of {run.steps} steps: {run.ended_early}")
    produced, persisted = run_parts.produced(parts), _persisted(record)
    if persisted is None:
        warnings.append("what replay has persisted is not known: it left no last word, and there is no ring here")
    learner = parts.newest(LEARNER)
    if learner is not None and "updates" not in learner.get("counters", {}):
        notes.append("updates is null: the learner was still starting")
    episodes = _count(parts.latest(ROBOT_BRIDGE, "episodes"))
    missing_episodes = max(0, (episodes or 0) - len(record.episodes))
    if missing_episodes:
        notes.append(f"episodes.csv holds {len(record.episodes)} of the {episodes} completed episodes")
    for service, jumps in run_parts.clock_jumps(parts).items():
        notes.append(f"{service}: its clock and the bridge's jumped against each other ({jumps} x)")
    if stalls := _count(parts.total(ROBOT_BRIDGE, "camera_stalls")):
        notes.append(f"the camera stalled ({stalls} x); attempts that it befell were truncated")
    lost = None if produced is None or persisted is None else produced - persisted
    if lost and lost > 0 and run and run.ended_early:
        notes.append(f"the run was ended ({run.ended_early}): what was still on its way by then counts as lost")
    unanswered = sum(part.get("unanswered_first_observations") or 0 for part in parts.of(ROBOT_BRIDGE))
    if lost and lost > 0 and unanswered:
        notes.append(
            f"{unanswered} first observations were not answered in time: no attempt came of them, but those that never "
            "arrived count as lost"
        )
    notes += run_parts.service_notes(parts)
    values = {
        "task": run.task if run else run_parts.newest_detail(parts, ROBOT_BRIDGE, "task"),
        "algorithm": run.algorithm if run else None,
        "mode": run.mode if run else None,
        "network": run.network if run else None,
        "seed": run.seed if run else run_parts.newest_detail(parts, ROBOT_BRIDGE, "seed"),
        "steps": steps,
        "acted_steps": _count(parts.latest(ROBOT_BRIDGE, "acted_steps")),
        "episodes": episodes,
        "steps_per_goal_last_1000": _steps_per_goal(record.episodes, steps, has_goal, missing_episodes, notes),
        **{
            name: _count(parts.total(ROBOT_BRIDGE, name))
            for name in ("cycles", "overruns", "overruns_after_1000", "late_actions")
        },
        "experience": {
            "produced": produced,
            "persisted": persisted,
            "lost": lost,
            # Without a ring, nothing can be in it twice.
            "duplicated": record.ring.duplicated if record.ring else 0 if persisted == 0 else None,
            "resent": _sum(parts.total(ROBOT_BRIDGE, "resent"), parts.total(ACTOR, "resent")),
        },
        "updates": _count(parts.greatest(LEARNER, "updates")),
        "policy_pushes": _count(parts.total(LEARNER, "policy_pushes")),
        "policy_version": _count(parts.greatest(LEARNER, "policy_version")),
        "rollouts": _rollouts(parts),
        "observation_to_action_ms": _observation_to_action_ms(record),
        "action_age_ms": _action_age_ms(record),
        "outages": _outages(record, notes),
        "bytes_per_key": bytes_per_key(parts.bytes_sent()),
        "wall_s": run_parts.elapsed_s(parts),
        "network_link": _network_link(record),
        "service_failures": run_parts.service_failures(parts),
        "notes": notes,
    }
    return Summary(values, warnings, record.episodes, bool(has_goal))


def write_summary(run_dir: Path, summary: Summary) -> Path:
    """Write ``summary.json``; return its path."""
    path = run_dir / "summary.json"
    write_atomically(path, json.dumps(summary.values, indent=1) + "\n")
    return path


def write_curve(run_dir: Path, summary: Summary) -> Path:
    """Draw ``learning_curve.png``; return its path."""
    path, values = run_dir / "learning_curve.png", summary.values
    facts = [values["task"] or run_dir.name, values["mode"]]
    facts += [f"{name} {values[name]}" for name in ("network", "seed") if values[name] is not None]
    title = ", ".join(str(fact) for fact in facts if fact is not None)
    draw_learning_curve(path, summary.episodes, values["steps"] or 0, summary.has_goal, title)
    return path


def _steps_per_goal(
    episodes: Sequence[Episode], steps: int | None, has_goal: bool | None, missing_episodes: int, notes: list[str]
) -> float | None:
    if not has_goal or not steps:
        return None
    value = steps_per_goal(episodes, steps)
    if value is None and missing_episodes:
        return None  # a note says so already
    if value is None:
        notes.append("steps_per_goal_last_1000 is null: no goal was reached in the last 1000 steps")
        return None
    return round(value, 3)


def _persisted(record: Record) -> int | None:
    """Distinct TimeSteps that replay has stored: by its own last word, or of one that died before it, by its ring."""
    parts = record.parts
    replay, counted = parts.newest(REPLAY), run_parts.persisted(parts)
    is_last = replay is None or (replay.get("state") == "stopped" and parts.knows_newest(REPLAY))
    if is_last and (record.ring is not None or not record.is_outdated):
        return counted
    if record.ring is not None:
        return max(counted or 0, record.ring.rows - record.ring.duplicated)
    # It may have stored more after its last word here, which is up to a second old, or as old as this copy of it.
    return counted if counted == run_parts.produced(parts) else None


def _rollouts(parts: RunParts) -> dict[str, int | None] | None:
    """What an on-policy algorithm learnt from, and what it could not learn from; None for the others."""
    complete = _count(parts.total(REPLAY, "rollouts"))
    if complete is None:
        return None
    return {"complete": complete, "dropped_transitions": _count(parts.total(REPLAY, "dropped_transitions"))}


def _observation_to_action_ms(record: Record) -> dict[str, float] | None:
    if record.actions is None or (record.run is not None and record.run.mode == IN_PROCESS):
        return None  # in simulated time, an answer takes as long as it is told to
    return record.actions.observation_to_action_ms()


def _action_age_ms(record: Record) -> dict[str, float] | None:
    if record.ages is None or (record.run is not None and record.run.mode == IN_PROCESS):
        return None
    medians = {name: values["p50"] for name, values in record.ages.quantiles_ms().items()}
    return {**medians, "offset_bound": round(float(np.median(record.ages.offset_bound)), 3)}


def _outages(record: Record, notes: list[str]) -> list[dict[str, float | None]] | None:
    if record.network is None or record.actions is None:
        # Without a network there are none; with one whose actions are unknown, nobody can say.
        return [] if record.run is not None and record.run.backend == "none" else None
    last_ns = last_published_ns(record.actions, record.ring.last_published_ns if record.ring else 0)
    ends = outage_ends(record.actions, record.network, last_ns)
    if any(end.first_action_s is None for end in ends):
        notes.append("first_action_s is null where the run ended before an action came")
    return [end.to_table() for end in ends]


def _network_link(record: Record) -> dict[str, Any] | None:
    if record.network is None or record.run is None:
        return None
    parts, run = record.parts, record.run
    return network_link(run.backend, record.network, parts.bytes_sent(), parts.bytes_received(), run.placement)


def _count(value: float | None) -> int | None:
    return None if value is None else round(value)


def _sum(*values: float | None) -> int | None:
    known = [value for value in values if value is not None]
    return round(sum(known)) if known else None


def main(arguments: Sequence[str] | None = None) -> int:
    """Summarise a run from the command line."""
    parser = argparse.ArgumentParser(prog="python -m deploy.summary", description="Summarise a run's record.")
    parser.add_argument(
        "run_dirs",
        type=Path,
        nargs="+",
        metavar="RUN_DIR",
        help="folder of the run's record; of a run on two computers, both folders. The summary goes into the first",
    )
    run_dirs = parser.parse_args(arguments).run_dirs
    try:
        summary = summarise(read_record(*run_dirs))
        paths = [write_summary(run_dirs[0], summary), write_curve(run_dirs[0], summary)]
    except RelodError as error:
        print(f"deploy.summary: error: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"deploy.summary: error: {run_dirs[0]}: cannot be written: {error.strerror}", file=sys.stderr)
        return 1
    for warning in summary.warnings:
        print(f"deploy.summary: warning: {warning}", file=sys.stderr)
    print(summary_text(summary.values))
    for path in paths:
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
