"""The programs on the page ``docs/wire-format.md`` read and command four real services, importing nothing of ours."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from common.topics import SERVICES
from deploy.wire_tables import DOCUMENT
from tests.docs.pages import programs, table_rows
from tests.integration.ring_processes import ROOT, SMALL_AND_FAST, RingProcesses, options, start_all

ENDS_WITHIN_S = 150.0
LISTENER = Path(__file__).with_name("wire_listener.py")
RUN = """
import runpy, sys
sys.path[:0] = sys.argv[1:3]
del sys.argv[:3]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
"""Runs a program that finds two folders and the standard library, and no other module."""


class Elsewhere:
    """A folder outside the repository with the document, its programs, and the four packages they need."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._packages = folder / "elsewhere", folder / "packages"
        self._folder.mkdir()
        self._packages.mkdir()
        assert not self._folder.is_relative_to(ROOT)
        document = DOCUMENT.read_text(encoding="utf-8")
        files = {DOCUMENT.name: document, LISTENER.name: LISTENER.read_text(encoding="utf-8"), **programs(document)}
        for name, text in files.items():
            (self._folder / name).write_text(text, encoding="utf-8")
        for package in ("zenoh", "msgpack", "numpy", "xxhash"):
            (installed,) = importlib.util.find_spec(package).submodule_search_locations
            for found in (Path(installed), Path(f"{installed}.libs")):
                if found.exists():
                    (self._packages / found.name).symlink_to(found)

    def start(self, name: str, *arguments: str) -> Program:
        """Start one of the folder's programs; -I -S: no environment variable, no site-packages, no working folder."""
        command = [sys.executable, "-I", "-S", "-c", RUN, str(self._packages), str(self._folder), *arguments]
        return Program(command, self._folder / name)


class Program:
    """A program that runs in a folder, where it leaves what it prints."""

    def __init__(self, command: list[str], output: Path) -> None:
        self._output = output
        with output.open("wb") as file:
            self._process = subprocess.Popen(command, cwd=output.parent, stdout=file, stderr=subprocess.STDOUT)

    def ended(self) -> str:
        """What it printed, once it has ended well."""
        code = self._process.wait(timeout=ENDS_WITHIN_S)
        printed = self._output.read_text(encoding="utf-8")
        assert code == 0, printed[-4000:]
        return printed

    def kill(self) -> None:
        """End it if it has not ended."""
        self._process.kill()
        self._process.wait()


def addresses(configs: Path) -> tuple[str, str, dict[str, list[str]]]:
    """Run, robot, and service -> its two endpoints, from where the document says they are."""
    tables = {name: tomllib.loads((configs / f"{name}.toml").read_text(encoding="utf-8")) for name in SERVICES}
    run = tables["robot_bridge"]["run"]
    endpoints = {
        name: [table["transport"]["listen_real_time"], table["transport"]["listen_bulk"]]
        for name, table in tables.items()
    }
    return run["id"], run.get("robot", "robot0"), endpoints


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the three programs printed during one run, and its summary."""
    folder = tmp_path_factory.mktemp("wire")
    elsewhere = Elsewhere(folder)
    settings = options(
        *SMALL_AND_FAST,
        "task.frames_per_cycle=1.2",  # sometimes one new frame, sometimes two, so the newest one names its TimeStep
        "task.goal_probability=0.05",
        "replay.access=arrays",
        "learner.access=arrays",
        "algorithm.replay_ratio=0.25",
    )
    with RingProcesses(folder, "noise_frames", "--steps", "1000000", *settings) as ring:
        run, robot, endpoints = addresses(folder / "config")
        real_time = [endpoints[service][0] for service in SERVICES]
        everything = [endpoint for pair in endpoints.values() for endpoint in pair]
        spec, watch, listener = started = (
            elsewhere.start("spec", "client.py", "spec", run, robot, endpoints["robot_bridge"][0]),
            elsewhere.start("watch", "client.py", "watch", run, robot, *real_time),
            elsewhere.start("listener", LISTENER.name, DOCUMENT.name, run, robot, *everything),
        )
        try:
            start_all(ring)  # only now: start order is free for onlookers too
            printed = {"spec": spec.ended(), "found": json.loads(listener.ended()), "watch": watch.ended()}
            codes = ring.wait()
        finally:
            for program in started:
                program.kill()
        assert codes == dict.fromkeys(SERVICES, 0), {service: ring.output(service)[-2000:] for service in SERVICES}
        return {**printed, "summary": ring.summary()}


def test_a_listener_made_from_the_document_finds_everything_as_it_says(live: dict[str, Any]) -> None:
    found = live["found"]
    for what, count in found["compared"].items():
        assert count >= 20, f"{what}: {found['compared']}"
    assert found["frames"] > found["heard"]["timestep"], "with one or two new frames each"


def test_nothing_of_ours_was_imported(live: dict[str, Any]) -> None:
    modules = live["found"]["modules"]
    assert any("zenoh" in file for file in modules)
    ours = {str(ROOT / name) for name in ("common", "services", "deploy", "experiments", "benchmarks", "tests")}
    assert [file for file in modules if any(file.startswith(f"{folder}/") for folder in ours)] == []


def test_every_topic_of_the_document_was_heard_but_repairs_rows_and_queries(live: dict[str, Any]) -> None:
    topics = {row["topic"].strip("`") for row in table_rows("<!-- table: topics -->") if row["sent as"] != "query"}
    rare = {"timestep/resent", "experience/resent", "minibatch/rows"}
    assert topics - rare <= set(live["found"]["heard"]) <= topics


def test_a_stop_command_of_the_listener_ended_the_run_and_nothing_was_lost(live: dict[str, Any]) -> None:
    found, experience = live["found"], live["summary"]["experience"]
    assert found["reason"] == "stopped"
    assert found["produced"] == experience["produced"] == experience["persisted"]
    assert (experience["lost"], experience["duplicated"]) == (0, 0)


def test_services_know_the_documented_commands_and_no_others(live: dict[str, Any]) -> None:
    documented = {
        row["service"].strip("`"): re.findall(r"`(\w+)`", row["commands"]) for row in table_rows("The commands are")
    }
    for service, refusal in live["found"]["refusals"].items():
        assert refusal == f"expected one of {sorted(documented[service])}, got 'dance'"


def test_services_report_the_documented_counters(live: dict[str, Any]) -> None:
    documented = {
        row["service"].strip("`"): set(re.findall(r"`(\w+)`", row["counters"])) for row in table_rows("What they are:")
    }
    for service, reported in live["found"]["counters"].items():
        assert documented[service] <= set(reported), service
        if service != "learner":  # it reports its algorithm's metrics too
            assert set(reported) == documented[service]


def test_the_client_prints_the_specification(live: dict[str, Any]) -> None:
    lines = dict(line.split(" ", 1) for line in live["spec"].splitlines() if " " in line)
    assert lines["task"] == "noise_frames"
    assert lines["frame_shape"] == "[44 60  3]"
    assert lines["action_cycle_time_s"] == "0.02"


def test_the_client_prints_time_steps_and_statuses_until_the_bridge_has_ended(live: dict[str, Any]) -> None:
    lines = live["watch"].splitlines()
    steps = [
        line for line in lines if re.match(r"timestep \d+ frames \[\d+(, \d+)?\] \([12], 44, 60, 3\) action", line)
    ]
    assert len(steps) > 100
    assert {line.split()[1] for line in lines if line.startswith("status")} == set(SERVICES)
    assert len(steps) + sum(line.startswith("status ") for line in lines) == len(lines)
    assert lines[-1].startswith("status robot_bridge stopped")
