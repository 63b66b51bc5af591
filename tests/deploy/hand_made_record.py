"""Pieces of a run's record, written by hand."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from deploy.network.part import DeviceBytes, DirectionCounts, NetworkPart, Outage
from services.robot_bridge.action_age import PARTS

SECOND_NS = 1_000_000_000


def write_part(run_dir: Path, service: str, incarnation: int, **values: Any) -> Path:
    """Write a service's part; what is not given is as in a run that has ended well."""
    part = {
        "service": service,
        "incarnation": incarnation,
        "pid": 0,
        "state": "stopped",
        "failure": None,
        "run": "test",
        "wall_s": 1.0,
        "counters": {},
        "bytes_sent": {},
        "bytes_received": {},
        **values,
    }
    path = run_dir / "parts" / f"{service}-{incarnation}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(part), encoding="utf-8")
    return path


def write_episodes(run_dir: Path, steps_at_end: list[int]) -> None:
    """Write ``episodes.csv`` with episodes that end at these steps of the run; each return is minus the length."""
    rows = ["episode,return,length,attempts,steps,acted_steps,experience_time_s"]
    begin = 0
    for number, end in enumerate(steps_at_end):
        rows.append(f"{number},{begin - end:.1f},{end - begin},1,{end},{end},{end * 0.04:.3f}")
        begin = end
    (run_dir / "episodes.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


def write_actions(run_dir: Path, times_s: list[tuple[float, float]]) -> None:
    """Write ``actions.csv``: (published, arrived), seconds."""
    rows = ["incarnation,answered_seq,published_ns,arrived_ns,late"]
    for seq, (published_s, arrived_s) in enumerate(times_s):
        rows.append(f"100,{seq},{round(published_s * SECOND_NS)},{round(arrived_s * SECOND_NS)},0")
    (run_dir / "actions.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


def write_ages(run_dir: Path, rows_ms: Sequence[Sequence[float | None]]) -> None:
    """Write ``actions.csv``: the parts of each action's age and the offset's bound, milliseconds; None is empty."""
    columns = [f"{name}_us" for name in (*PARTS, "offset_bound")]
    rows = [f"incarnation,answered_seq,published_ns,arrived_ns,late,{','.join(columns)}"]
    for seq, parts in enumerate(rows_ms):
        cells = ["" if part is None else str(round(part * 1000)) for part in parts]
        rows.append(f"100,{seq},{seq * SECOND_NS},{seq * SECOND_NS + 1000},0,{','.join(cells)}")
    (run_dir / "actions.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


def network_part(
    outages_s: list[tuple[float, float]], start_s: float = 0.0, kernel: dict[str, tuple[int, int]] | None = None
) -> NetworkPart:
    """A link's part with these outages (begin, end), and the kernel's (sent, received) bytes by host."""
    return NetworkPart(
        kind="namespaces" if kernel else "relay",
        start_monotonic_ns=round(start_s * SECOND_NS),
        written_monotonic_ns=round((start_s + 100) * SECOND_NS),
        directions={"uplink": DirectionCounts(), "downlink": DirectionCounts()},
        outages=[Outage(round(begin * SECOND_NS), round(end * SECOND_NS)) for begin, end in outages_s],
        kernel={host: DeviceBytes(*counted) for host, counted in (kernel or {}).items()},  # type: ignore[misc]
    )
