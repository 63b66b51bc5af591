"""run.toml: written, read back, and refused when it cannot be used."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest

from common.errors import ConfigError
from deploy.network import PRESETS, DirectionConditions, NetworkConditions, Trace, parse_network
from deploy.run_file import RunFile, versions

RUN = RunFile(
    id="run1",
    mode="remote_only",
    task="dot_reacher",
    algorithm="sac",
    seed=1,
    steps=10,
    pacing="realtime",
    network="wifi_bad",
    backend="relay",
    placement={"robot_bridge": "local"},
    conditions=PRESETS["wifi_bad"].to_table(),
    versions={"numpy": "2"},
)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    RUN.write(tmp_path)
    assert RunFile.read(tmp_path) == RUN
    assert parse_network(RunFile.read(tmp_path).conditions) == PRESETS["wifi_bad"]


def test_an_unlimited_rate_survives(tmp_path: Path) -> None:
    RunFile(**{**vars(RUN), "conditions": PRESETS["ideal"].to_table()}).write(tmp_path)
    assert parse_network(RunFile.read(tmp_path).conditions) == PRESETS["ideal"]


def test_the_rows_of_a_trace_are_kept_beside_it(tmp_path: Path) -> None:
    trace = Trace("office.csv", (0, 0.1, 1 / 3), delay_ms=(4.2, 3.9, 2 / 7), end="stop")
    conditions = NetworkConditions(DirectionConditions(trace=trace), PRESETS["wifi_bad"].downlink)
    RunFile(**{**vars(RUN), "conditions": conditions.to_table()}).write(tmp_path)
    assert "0.1" not in (tmp_path / "run.toml").read_text(encoding="utf-8")
    assert parse_network(RunFile.read(tmp_path).conditions, directory=tmp_path) == conditions


def test_a_file_that_is_written_again_keeps_when_the_run_started(tmp_path: Path) -> None:
    started = datetime(2026, 5, 4, 3, 2, 1, tzinfo=UTC)
    RunFile(**{**vars(RUN), "started": started}).write(tmp_path)
    read = RunFile.read(tmp_path)
    replace(read, ended_early="interrupted").write(tmp_path)
    assert RunFile.read(tmp_path) == replace(read, ended_early="interrupted")
    assert read.started == started


@pytest.mark.parametrize("text", ["[run", "", "[run]\nid = 'x'", "[run]\nunknown = 1"])
def test_a_file_that_cannot_be_used_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"run\.toml: cannot be used"):
        RunFile.read(tmp_path)


def test_no_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"run\.toml is missing"):
        RunFile.read(tmp_path)


def test_versions_name_what_a_run_depends_on() -> None:
    found = versions()
    for name in ("relod", "python", "torch", "numpy", "eclipse-zenoh", "mujoco"):
        assert found[name]
