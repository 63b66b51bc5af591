"""Each action's age in ``actions.csv``, part by part: what the waterfall is made of. Times in milliseconds."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from common.errors import ConfigError
from services.robot_bridge.action_age import PARTS

AGE = "age"
"""The sum of the parts."""
QUANTILES = {"p50": 50.0, "p90": 90.0, "p99": 99.0, "max": 100.0}
"""Name -> percentile."""
WAYS = ("uplink", "downlink")
"""Parts that need the offset between two clocks."""
TOLERANCE_MS = 0.1
"""A way may seem shorter than nothing by its stated error and this: each time is rounded, and read a bit late."""

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ActionAges:
    """The applied actions of a run."""

    parts: Mapping[str, Floats]
    """Part -> (n,) its share of each action's age; only parts that the run has, in their order."""
    offset_bound: Floats
    """(n,) largest error of uplink and downlink: what one has too much, the other has too little."""
    answered: int
    """TimeSteps that were answered."""
    not_applied: int
    """Answers that came too late, or while the robot was to stand still."""
    unknown: int
    """Applied actions left out because the actor did not know its clock's offset yet."""
    contradicted: int
    """Applied actions left out because a way would have taken less than no time: a clock had just jumped."""
    unreadable: int
    """Rows that were no rows."""

    @property
    def age(self) -> Floats:
        """(n,) from the newest frame's capture, or without camera from the sensors' reading, to the robot's move."""
        return np.sum(list(self.parts.values()), axis=0)

    @classmethod
    def read(cls, run_dir: Path) -> ActionAges:
        """Return the ages of a run's actions.

        Raises:
            ConfigError: the run has no such record, or nothing in it that can be split.
        """
        path = run_dir / "actions.csv"
        rows, unreadable = _read(path)
        applied = rows[np.isfinite(rows[:, PARTS.index("apply")])]
        is_known = np.isfinite(applied[:, -1])
        known = applied[is_known]
        ways = known[:, [PARTS.index(way) for way in WAYS]]
        possible = (ways >= -(known[:, -1:] + TOLERANCE_MS)).all(axis=1)
        used = known[possible]
        if not len(used):
            raise ConfigError(
                f"{path}: expected applied actions with known clock offsets, got {len(rows)} answers, "
                f"{len(applied)} of them applied, {len(known)} of these with an offset"
            )
        present = [name for at, name in enumerate(PARTS) if np.isfinite(used[:, at]).any()]
        # The first observation of a camera may come before its first frame.
        used = used[np.isfinite(used[:, [PARTS.index(name) for name in present]]).all(axis=1)]
        return cls(
            parts={name: used[:, PARTS.index(name)] for name in present},
            offset_bound=used[:, -1],
            answered=len(rows),
            not_applied=len(rows) - len(applied),
            unknown=int((~is_known).sum()),
            contradicted=int((~possible).sum()),
            unreadable=unreadable,
        )

    def quantiles_ms(self) -> dict[str, dict[str, float]]:
        """Part, and age -> quantile -> milliseconds."""
        return {
            name: {quantile: round(float(np.percentile(values, at)), 3) for quantile, at in QUANTILES.items()}
            for name, values in {**self.parts, AGE: self.age}.items()
        }


def _read(path: Path) -> tuple[Floats, int]:
    """(rows, parts and offset bound) in ms, NaN where the record has none; and the number of unreadable rows."""
    columns = [f"{name}_us" for name in (*PARTS, "offset_bound")]
    rows, unreadable = [], 0
    try:
        with path.open(encoding="utf-8", errors="replace", newline="") as file:
            reader = csv.DictReader(file)
            if missing := [column for column in columns if column not in (reader.fieldnames or ())]:
                raise ConfigError(
                    f"{path}: expected the columns {', '.join(columns)}, got none of {', '.join(missing)}; "
                    "was it written by an earlier release?"
                )
            for row in reader:
                try:
                    rows.append([float(row[column]) / 1000 if row[column] != "" else np.nan for column in columns])
                except (TypeError, ValueError):
                    unreadable += 1
    except FileNotFoundError:
        raise ConfigError(f"{path} is missing: expected the run directory of a run in which actions arrived") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    return np.array(rows, np.float64).reshape(-1, len(columns)), unreadable
