"""Where the times of actions and updates come from in virtual time."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import pytest

from common.topics import ACTOR, LEARNER, SERVICES
from deploy.hosts import Host
from deploy.network import NoLink
from deploy.placement import load_placement
from deploy.plan import PORTS, PortMap, RunRequest, plan_run
from experiments import virtual_costs
from experiments.virtual_costs import ComputingTimes, measure, with_computing_times

BOARD = Host("board", device="cpu", threads=1, inference_s=0.012, updates_per_step=0.1, replay_capacity=5000)


def configurations(*overrides: str, task="dot_reacher", host=None):
    request = RunRequest(
        placement=load_placement("local_only"),
        task=task,
        algorithm="sac",
        run_id=f"{datetime(2020, 1, 1):%Y}",
        run_dir=Path("unused"),
        learner_host=host,
        overrides=("algorithm.hidden_size=16", "algorithm.batch_size=4", *overrides),
    )
    planned = plan_run(request, PortMap(range(1, PORTS + 1)), NoLink(), None)
    assert set(planned) == set(SERVICES)
    return planned


def times(planned) -> tuple[float, float]:
    return planned[ACTOR].actor.min_inference_s, planned[LEARNER].learner.min_update_s


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "relod" / "computing_times.json"


@pytest.fixture
def measured(monkeypatch):
    """What was measured, instead of measuring."""
    calls = []

    def pretend(spec, learner):
        calls.append((spec.task, learner.algorithm.overrides["hidden_size"]))
        return ComputingTimes(inference_s=0.002 * len(calls), update_s=0.02 * len(calls))

    monkeypatch.setattr(virtual_costs, "measure", pretend)
    return calls


def test_this_computer_is_measured_once_for_each_task_and_network(measured, cache):
    assert times(with_computing_times(configurations(), None)) == (0.002, 0.02)
    assert times(with_computing_times(configurations(), None)) == (0.002, 0.02)
    assert times(with_computing_times(configurations("algorithm.hidden_size=8"), None)) == (0.004, 0.04)
    assert measured == [("dot_reacher", 16), ("dot_reacher", 8)]
    assert cache.exists()


def test_what_is_set_is_not_measured(measured):
    planned = configurations("actor.min_inference_s=0.003", "learner.min_update_s=0.03")
    assert times(with_computing_times(planned, None)) == (0.003, 0.03)
    assert measured == []


@pytest.mark.parametrize("damage", ['{"half a', b"\xff", "[1]", "7", ""])
def test_a_cache_that_cannot_be_read_is_replaced(measured, cache, damage):
    cache.parent.mkdir()
    cache.write_bytes(damage if isinstance(damage, bytes) else damage.encode())
    assert times(with_computing_times(configurations(), None)) == (0.002, 0.02)
    assert '"update_s": 0.02' in cache.read_text()


@pytest.mark.parametrize(
    "entry",
    [None, 7, {}, {"inference_s": 0.1}, *({"inference_s": 0.1, "update_s": bad} for bad in (None, "1", -1.0, 0.0))],
)
def test_an_entry_that_is_no_measurement_is_measured_again_and_the_others_stay(measured, cache, entry):
    with_computing_times(configurations(), None)
    with_computing_times(configurations("algorithm.hidden_size=8"), None)
    known = json.loads(cache.read_text())
    damaged = next(key for key in known if known[key]["inference_s"] == 0.002)
    cache.write_text(json.dumps({**known, damaged: entry}))
    assert times(with_computing_times(configurations(), None)) == (0.006, 0.06)
    assert times(with_computing_times(configurations("algorithm.hidden_size=8"), None)) == (0.004, 0.04)
    assert len(measured) == 3


def test_processes_that_begin_together_use_one_measurement(cache):
    with contextlib.ExitStack() as stack:

        def begin(value: str) -> subprocess.Popen[str]:
            return stack.enter_context(
                subprocess.Popen(
                    [sys.executable, "-m", "tests.experiments.measuring_process", value],
                    cwd=Path(__file__).parents[2],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    text=True,
                )
            )

        one = begin("0.25")
        while one.stdout.readline().strip() != "measures":
            assert one.poll() is None
        # It goes on measuring until the other has found nothing in the cache.
        other = begin("0.5")
        assert other.stdout.readline().strip() in ("asks for the lock", "measures")
        one.stdin.close()
        other.stdin.close()
        results = [process.stdout.read().splitlines()[-1] for process in (one, other)]
    assert results == ["(0.25, 0.25)", "(0.25, 0.25)"]
    assert cache.read_text().count("update_s") == 1


def test_another_computer_updates_as_often_as_its_file_says_and_is_not_measured(measured):
    # A tenth of an update in an action cycle of 40 ms.
    assert times(with_computing_times(configurations(host=BOARD), BOARD)) == (0.012, pytest.approx(0.4))
    assert measured == []


@pytest.mark.parametrize("task", ["dot_reacher", "visual_dot_reacher"])
def test_measured_times_are_those_of_the_task_s_networks(task):
    planned = configurations(task=task)
    found = measure(virtual_costs._task_spec(planned), planned[LEARNER])
    assert 1e-6 < found.inference_s < found.update_s < 5
