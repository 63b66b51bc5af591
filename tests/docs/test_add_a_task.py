"""docs/add-a-task.md, followed literally."""

import json
import os
import shlex
import subprocess
import sys
import tomllib

import numpy as np
import pytest

from services.robot_bridge.bookkeeping import Ledger
from services.robot_bridge.tasks import TASKS, load_task
from tests.docs.task_pages import ROOT, Page, conformance_checks

PAGE = Page("add-a-task.md")
CHECKS = conformance_checks("demo", "narrow")


@pytest.fixture
def my_tasks(tmp_path, monkeypatch):
    """The folder with the page's file, where Python finds it."""
    (tmp_path / "toy.py").write_text(PAGE.block("python"), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop("toy", None)


@pytest.mark.parametrize(("check", "arguments"), CHECKS)
def test_the_task_passes_the_checks_of_every_task(my_tasks, monkeypatch, check, arguments):
    monkeypatch.setitem(TASKS, "toy", tomllib.loads(PAGE.block("toml"))["tasks"]["toy"])
    check(name="toy", **arguments)


def test_there_are_such_checks():
    assert len(CHECKS) >= 20


@pytest.mark.parametrize("preset", ["demo", "narrow"])
def test_with_the_pages_row_an_episode_runs_in_lockstep_to_its_goal(my_tasks, preset):
    rows = tomllib.loads(PAGE.block("toml"))["tasks"]
    task = load_task("toy", preset, {"time_limit": 7}, rows, rng=np.random.default_rng(2))
    ledger, now_ns, episode, ends = Ledger(task.spec), 0, None, []
    task.advance_to(now_ns)
    task.begin_episode()
    mark = task.read().proprioception[1]
    ledger.begin_attempt()
    while episode is None:
        cart, _ = task.read().proprioception
        task.command(np.clip([(mark - cart) / 0.05], -1, 1).astype(np.float32))
        now_ns += 40_000_000
        task.advance_to(now_ns)
        outcome = task.outcome()
        truncated, episode = ledger.end_cycle(outcome.reward, outcome.terminated)
        ends.append("truncated" if truncated else "terminated" if outcome.terminated else "")
        if truncated:
            for _ in range(task.spec.reset_steps):
                ledger.end_reset_cycle()
            task.begin_attempt()
            ledger.begin_attempt()
        assert task.read().proprioception[1] == mark
    assert ends[-1] == "terminated"
    assert episode.length == -episode.undiscounted_return == len(ends) + 5 * ends.count("truncated")


def test_the_pages_command_lets_the_four_services_learn_it(my_tasks, tmp_path):
    command = shlex.split(PAGE.block("bash", "deploy.launch"))
    assert command[:2] == ["PYTHONPATH=my_tasks", "python"]
    run_dir = tmp_path / "run"
    result = subprocess.run(
        [sys.executable, *command[2:], "--run-dir", str(run_dir)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(my_tasks)},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    summary = json.loads((run_dir / "summary.json").read_text())
    assert summary["task"] == "toy"
    assert summary["experience"]["lost"] == 0
    assert len((run_dir / "episodes.csv").read_text().splitlines()) > 2


def test_the_pages_check_is_the_conformance_test():
    command = shlex.split(PAGE.block("bash", "pytest"))
    assert command[:4] == ["python", "-m", "pytest", "tests/conformance/test_tasks.py"]
    assert ROOT.joinpath(command[3]).is_file()


def test_files_the_page_links_to_exist():
    assert not PAGE.missing_files()
