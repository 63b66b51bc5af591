"""A run's live progress, read from the services' parts once a second."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from common.topics import ACTOR, LEARNER, REPLAY, ROBOT_BRIDGE, SERVICES
from deploy.episodes import EpisodeTable, steps_per_goal
from deploy.parts import RunParts, newest_detail

RECENT_EPISODES = 10


@dataclass(frozen=True)
class Progress:
    """Where a run stands. None is unknown yet."""

    states: dict[str, str]
    """Service -> state of its newest incarnation; ``-`` before its first word."""
    steps: int = 0
    steps_total: int = 0
    left_s: float | None = None
    waits_for: str | None = None
    """What the robot stands still for."""
    steps_per_goal: float | None = None
    """Over the last 1000 steps."""
    recent_length: float | None = None
    """Mean length of the last episodes."""
    last_return: float | None = None
    updates_per_s: float | None = None
    policy_version: int = 0
    late_actions: int = 0
    overruns: int = 0
    unacknowledged: int = 0
    lost: int = 0


class ProgressReader:
    """Reads the progress of one run."""

    def __init__(
        self,
        run_dir: Path,
        steps_total: int,
        now_s: Callable[[], float] = time.monotonic,
        other_dirs: Sequence[Path] = (),
    ) -> None:
        """Args:
        run_dir: folder of the run's record, with the bridge's part.
        steps_total: action cycles of the run.
        now_s: monotonic time.
        other_dirs: folders with the parts of services on another computer.
        """
        self._dirs, self._steps_total, self._now_s = (run_dir, *other_dirs), steps_total, now_s
        self._episodes = EpisodeTable(run_dir)
        self._first: tuple[float, int] | None = None

    def read(self) -> Progress:
        """Return where the run stands now."""
        parts = RunParts.read(*self._dirs)
        episodes = self._episodes.update()
        newest = {service: parts.newest(service) for service in SERVICES}
        steps = int(parts.latest(ROBOT_BRIDGE, "steps") or 0)
        recent = episodes[-RECENT_EPISODES:]
        has_goal = bool(newest_detail(parts, ROBOT_BRIDGE, "has_goal"))
        return Progress(
            states={service: str(part.get("state", "-")) if part else "-" for service, part in newest.items()},
            steps=steps,
            steps_total=self._steps_total,
            left_s=self._left_s(steps),
            waits_for=(newest[ROBOT_BRIDGE] or {}).get("waits_for"),
            steps_per_goal=steps_per_goal(episodes, steps) if has_goal else None,
            recent_length=sum(episode.length for episode in recent) / len(recent) if recent else None,
            last_return=parts.latest(ROBOT_BRIDGE, "last_return"),
            updates_per_s=parts.latest(LEARNER, "updates_per_s"),
            policy_version=int(parts.greatest(LEARNER, "policy_version") or 0),
            late_actions=int(parts.total(ROBOT_BRIDGE, "late_actions") or 0),
            overruns=int(parts.total(ROBOT_BRIDGE, "overruns") or 0),
            unacknowledged=sum(int(parts.latest(name, "unacknowledged") or 0) for name in (ROBOT_BRIDGE, ACTOR)),
            lost=sum(int(parts.total(name, "lost") or 0) for name in (ACTOR, REPLAY)),
        )

    def _left_s(self, steps: int) -> float | None:
        """Time left at the mean pace since the first steps were seen."""
        now_s = self._now_s()
        if self._first is None:
            self._first = (now_s, steps) if steps else None
            return None
        first_s, first_steps = self._first
        if steps <= first_steps:
            return None
        return (self._steps_total - steps) * (now_s - first_s) / (steps - first_steps)


def progress_line(progress: Progress) -> str:
    """Return the progress in one line, what matters most first."""
    if not progress.steps:
        there = ", ".join(f"{service} {state}" for service, state in progress.states.items())
        waiting = f"; the robot waits for {progress.waits_for}" if progress.waits_for else ""
        return f"starting: {there}{waiting}"
    share = f"{100 * progress.steps / progress.steps_total:.0f} %" if progress.steps_total else "?"
    head = f"{progress.steps}/{progress.steps_total} {share}"
    if progress.waits_for is not None:
        head += f" the robot waits for {progress.waits_for}"
    elif progress.left_s is not None and progress.steps < progress.steps_total:
        head += f" ETA {_minutes(progress.left_s)}"
    items = [head]
    if progress.steps_per_goal is not None:
        items.append(f"steps/goal {progress.steps_per_goal:.1f} (last {RECENT_EPISODES}: {progress.recent_length:.1f})")
    if progress.last_return is not None:
        items.append(f"return {progress.last_return:g}")
    if progress.updates_per_s is not None:
        items.append(f"{progress.updates_per_s:.1f} updates/s")
    items += [
        f"policy {progress.policy_version}",
        f"late {progress.late_actions}",
        f"overruns {progress.overruns}",
        f"unacknowledged {progress.unacknowledged}",
        f"lost {progress.lost}",
    ]
    items += [f"{service} {state}" for service, state in progress.states.items() if state != "running"]
    return " | ".join(items)


def _minutes(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"
