"""Counts of a process that is killed, and of one that lives."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from common.record import read_parts, settle_parts
from common.surviving_counts import SurvivingCounts, with_surviving_counts

COUNT_AND_WAIT = """
import sys, time
from pathlib import Path
from common.surviving_counts import SurvivingCounts
counts = SurvivingCounts("robot_bridge", 7, ("steps", "produced"), Path(sys.argv[1]))
for produced in range(1, 1001):
    counts.set((10, produced))
print("counted", flush=True)
time.sleep(60)
"""


@pytest.fixture
def memory(tmp_path: Path) -> Path:
    folder = tmp_path / "memory"
    folder.mkdir()
    return folder


def write_part(run_dir: Path, counts: dict[str, Any] | None, state: str = "running") -> Path:
    path = run_dir / "parts" / "robot_bridge-7.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    part = {"service": "robot_bridge", "incarnation": 7, "state": state, "counters": {"produced": 900, "stops": 2}}
    path.write_text(json.dumps({**part, "surviving_counts": counts}))
    return path


def test_the_last_count_of_a_killed_process_is_in_its_part(tmp_path: Path, memory: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", COUNT_AND_WAIT, str(memory)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "counted\n"
        (counts,) = memory.iterdir()
        path = write_part(tmp_path, {"path": str(counts), "names": ["steps", "produced"]})
        settle_parts(tmp_path)
        assert "surviving_counts" in json.loads(path.read_text()), "it still counts"
        process.send_signal(signal.SIGKILL)
    counters = {"produced": 1000, "stops": 2, "steps": 10}
    assert read_parts(tmp_path)[0]["counters"] == counters
    settle_parts(tmp_path)
    assert list(memory.iterdir()) == []
    assert json.loads(path.read_text())["counters"] == counters
    assert read_parts(tmp_path)[0]["counters"] == counters


def test_a_running_process_s_part_is_read_with_its_newest_counts(tmp_path: Path, memory: Path) -> None:
    counts = SurvivingCounts("robot_bridge", 7, ("produced",), memory)
    write_part(tmp_path, counts.description())
    counts.set([901])
    assert read_parts(tmp_path)[0]["counters"] == {"produced": 901, "stops": 2}
    counts.close()
    assert list(memory.iterdir()) == []
    assert read_parts(tmp_path)[0]["counters"] == {"produced": 900, "stops": 2}


def test_a_part_that_was_written_last_is_not_touched(tmp_path: Path, memory: Path) -> None:
    counts = SurvivingCounts("robot_bridge", 7, ("produced",), memory)
    write_part(tmp_path, counts.description(), state="stopped")
    counts.set([3])
    assert read_parts(tmp_path)[0]["counters"]["produced"] == 900
    counts.close()


def test_without_a_memory_file_system_counting_goes_on(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    counts = SurvivingCounts("robot_bridge", 7, ("produced",), tmp_path / "missing")
    counts.set([1])
    assert counts.description() is None
    assert "its last second is not counted" in caplog.text
    counts.close()


@pytest.mark.parametrize("content", [b"", b"short"])
def test_a_damaged_file_changes_nothing(content: bytes, memory: Path) -> None:
    (memory / "relod").write_bytes(content)
    part = {"counters": {"produced": 4}, "surviving_counts": {"path": str(memory / "relod"), "names": ["produced"]}}
    assert with_surviving_counts(part) == part
