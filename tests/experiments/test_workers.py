"""Processes that do jobs, and what happens when one does not."""

import multiprocessing
import os
from concurrent.futures import ThreadPoolExecutor

import pytest

from experiments.workers import FinishedJob, JobFailure, WorkerPool, do_jobs
from tests.experiments import fake_jobs
from tests.helpers import TIMEOUT_S

JOBS = [("squares", number) for number in range(6)]


def outcomes(work, workers, settings=None, jobs=JOBS):
    with WorkerPool(work, settings or {"offset": 0}, workers) as pool:
        return [outcome for outcome in pool.run(jobs) if outcome is not None]


def test_each_job_is_done_once_by_a_process_that_is_not_this_one(tmp_path):
    settings = {"offset": 1, "begun": str(tmp_path)}
    found = outcomes(fake_jobs.square, 2, settings)
    assert sorted(found, key=lambda outcome: outcome.key) == [
        FinishedJob(key, {"value": 1 + key[1] ** 2}) for key in JOBS
    ]
    assert len({path.read_text() for path in tmp_path.iterdir()}) == 2
    assert not multiprocessing.active_children()


def test_each_pinned_process_stays_on_a_core_of_its_own_also_one_that_replaces_another():
    cores = sorted(os.sched_getaffinity(0))[:2]
    with WorkerPool(fake_jobs.cores_or_death, {}, len(cores), pinned=True) as pool:
        found = [outcome for outcome in pool.run(JOBS) if isinstance(outcome, FinishedJob)]
        assert {tuple(outcome.row["cores"]) for outcome in found} <= {(core,) for core in cores}
        # Those that are there now, one of them in the place of the one that died.
        now = [outcome for outcome in pool.run([("squares", 10 + core) for core in cores]) if outcome is not None]
    assert sorted(outcome.row["cores"] for outcome in now) == [[core] for core in cores]


@pytest.mark.parametrize("pinned", [False, True])
def test_processes_without_a_core_of_their_own_run_where_there_is_room(pinned):
    every_core = sorted(os.sched_getaffinity(0))
    workers = len(every_core) + 1 if pinned else 1
    with WorkerPool(fake_jobs.cores, {}, workers, pinned=pinned) as pool:
        found = [outcome for outcome in pool.run(JOBS) if outcome is not None]
    assert [outcome.row["cores"] for outcome in found] == [every_core] * len(JOBS)


def test_a_process_that_dies_costs_its_job_only():
    found = outcomes(fake_jobs.die_at_three, 2)
    failures = [outcome for outcome in found if isinstance(outcome, JobFailure)]
    assert failures == [JobFailure(("squares", 3), "its process died: killed by SIGKILL")]
    assert sorted(outcome.key[1] for outcome in found if isinstance(outcome, FinishedJob)) == [0, 1, 2, 4, 5]


def test_a_row_that_cannot_be_kept_is_its_job_s_failure():
    found = outcomes(fake_jobs.unkeepable, 1)
    (failure,) = [outcome for outcome in found if isinstance(outcome, JobFailure)]
    assert failure.key == ("squares", 3)
    assert failure.reason.startswith("ValueError")


def test_ctrl_c_and_other_ends_of_a_group_are_left_to_the_caller():
    assert [outcome.row["value"] for outcome in outcomes(fake_jobs.signal_immunity, 1, jobs=JOBS[:2])] == [0, 1]


def test_the_same_processes_do_the_next_jobs(tmp_path):
    settings = {"offset": 0, "begun": str(tmp_path)}
    with WorkerPool(fake_jobs.square, settings, 1) as pool:
        for number in range(2):
            assert list(filter(None, pool.run([("squares", number)])))
    assert (tmp_path / "0").read_text() == (tmp_path / "1").read_text()


def test_whoever_is_asked_to_stop_leaves_no_process_behind():
    with WorkerPool(fake_jobs.square, {"offset": 0}, 2) as pool:
        assert list(pool.run(JOBS, asked_to_stop=lambda: True)) == []
        running = pool.run(JOBS)
        next(running)
        assert multiprocessing.active_children()
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("answer_is_there", [False, True])
def test_a_caller_that_goes_without_its_answer_ends_a_worker_quietly(answer_is_there):
    near_end, far_end = multiprocessing.Pipe()
    near_end.send(JOBS[2])
    with ThreadPoolExecutor(1) as threads:
        if not answer_is_there:
            near_end.close()
        working = threads.submit(do_jobs, far_end, fake_jobs.square, {"offset": 0})
        if answer_is_there:
            assert near_end.poll(TIMEOUT_S)
            near_end.close()
        assert working.result(TIMEOUT_S) is None
