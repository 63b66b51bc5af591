"""``episodes.csv``: the completed episodes of a run, and what follows from them."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

GOAL_WINDOW_STEPS = 1000
"""Steps per goal are taken over this many of the run's last steps."""


@dataclass(frozen=True)
class Episode:
    """A row of ``episodes.csv``; of a task with a goal, every episode ended at it."""

    number: int
    episode_return: float
    length: int
    """Steps, resets included."""
    attempts: int
    steps: int
    """Steps of the run when the episode ended, resets included."""


class EpisodeTable:
    """Reads ``episodes.csv`` while it grows."""

    def __init__(self, run_dir: Path) -> None:
        self._path = run_dir / "episodes.csv"
        self._offset = 0
        self._columns: list[str] = []
        self.episodes: list[Episode] = []
        self.unreadable = 0
        """Rows that were no rows."""

    def update(self) -> list[Episode]:
        """Read what has been added; return all episodes."""
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                added = file.read()
        except FileNotFoundError:
            return self.episodes
        # The last line may still be on its way to the disk.
        complete = added[: added.rfind(b"\n") + 1]
        self._offset += len(complete)
        for row in csv.reader(complete.decode("utf-8", "replace").splitlines()):
            if not self._columns:
                self._columns = row
            else:
                self._add(dict(zip(self._columns, row, strict=False)))
        return self.episodes

    def _add(self, row: dict[str, str]) -> None:
        try:
            episode = Episode(
                number=int(row["episode"]),
                episode_return=float(row["return"]),
                length=int(row["length"]),
                attempts=int(row["attempts"]),
                steps=int(row["steps"]),
            )
        except (KeyError, ValueError):
            self.unreadable += 1
        else:
            self.episodes.append(episode)


def steps_per_goal(episodes: Sequence[Episode], steps: int, window: int = GOAL_WINDOW_STEPS) -> float | None:
    """Mean number of steps from goal to goal over the run's last ``window`` steps, resets included.

    None if no goal was reached in them.
    """
    width = min(window, steps)
    goals = sum(steps - width < episode.steps <= steps for episode in episodes)
    return width / goals if goals else None
