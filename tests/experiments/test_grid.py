"""A grid's folder: what is finished stays, whatever happens, and rows of different settings never mix."""

import json

import pytest

from common.errors import ConfigError
from experiments.grid import GridError, GridProgress, GridRecord, duration_text, run_grid
from experiments.workers import WorkerPool
from tests.experiments import fake_jobs

JOBS = [("squares", number) for number in range(6)]
SETTINGS = {"offset": 10}


def run(directory, jobs=JOBS, settings=SETTINGS, work=fake_jobs.square, workers=1, **options):
    with GridRecord(directory, settings) as record, WorkerPool(work, settings, workers) as pool:
        failures = run_grid(record, jobs, pool, **options)
        return dict(record.rows), failures


def test_every_job_gives_its_row_and_the_folder_holds_them(tmp_path):
    rows, failures = run(tmp_path)
    assert rows == {("squares", number): {"value": 10 + number**2} for number in range(6)}
    assert not failures
    with GridRecord(tmp_path, SETTINGS) as record:
        assert record.rows == rows


def test_finished_jobs_are_not_done_again(tmp_path):
    rows, _ = run(tmp_path / "grid")
    settings = {**SETTINGS, "begun": str(tmp_path)}
    with GridRecord(tmp_path / "grid", SETTINGS) as record, WorkerPool(fake_jobs.square, settings, 1) as pool:
        run_grid(record, [*JOBS, ("squares", 6)], pool)
        assert record.rows == {**rows, ("squares", 6): {"value": 46}}
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["6"]


def test_an_interrupted_grid_goes_on_and_gives_the_same_rows(tmp_path):
    whole, _ = run(tmp_path / "whole")
    finished = []
    part, _ = run(
        tmp_path / "part", progress=finished.append, asked_to_stop=lambda: bool(finished and finished[-1].finished)
    )
    assert 1 <= len(part) < len(JOBS)
    assert run(tmp_path / "part")[0] == whole


@pytest.mark.parametrize("torn", [b'{"key": ["squares", 4], "val', b"{", b'{"key": ["squares", 4], "value": 26}'])
def test_a_line_that_was_not_written_to_its_end_counts_as_not_done(tmp_path, torn):
    whole, _ = run(tmp_path)
    path = tmp_path / "results.jsonl"
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:3]) + torn)
    with GridRecord(tmp_path, SETTINGS) as record:
        assert sorted(record.rows) == JOBS[:3]
    assert run(tmp_path)[0] == whole
    assert len([json.loads(line) for line in path.read_text().splitlines()]) == len(JOBS)


def test_a_line_that_makes_no_sense_is_named(tmp_path):
    run(tmp_path, JOBS[:2])
    with (tmp_path / "results.jsonl").open("a") as file:
        file.write("nonsense\n")
    with pytest.raises(GridError, match=r"results\.jsonl, line 3 cannot be understood.*delete the line"):
        GridRecord(tmp_path, SETTINGS)


def test_rows_of_other_settings_are_not_mixed_in(tmp_path):
    run(tmp_path, JOBS[:2])
    with pytest.raises(ConfigError, match=r"other settings \(offset: 10 there, now 11\): ask for the same, or choose"):
        GridRecord(tmp_path, {"offset": 11})
    with GridRecord(tmp_path, SETTINGS) as record:
        assert len(record.rows) == 2


def test_a_grid_may_grow_by_settings_that_it_did_not_have(tmp_path):
    with GridRecord(tmp_path, {"task a": {"limit": (1, 2)}}):
        pass
    with GridRecord(tmp_path, {"task b": 1}):
        pass
    with GridRecord(tmp_path, {"task a": {"limit": (1, 2)}, "task b": 1}):
        pass
    with pytest.raises(ConfigError, match="task a"):
        GridRecord(tmp_path, {"task a": {"limit": (1, 3)}})


def test_a_folder_is_for_one_program_at_a_time(tmp_path):
    with (
        GridRecord(tmp_path, SETTINGS),
        pytest.raises(GridError, match="another program is working there"),
    ):
        GridRecord(tmp_path, SETTINGS)
    with GridRecord(tmp_path, SETTINGS):
        pass


@pytest.mark.parametrize("workers", [1, 2])
def test_a_job_that_fails_is_reported_and_the_rest_goes_on(tmp_path, workers):
    told = []
    rows, failures = run(tmp_path, work=fake_jobs.fail_at_three, workers=workers, failed=told.append)
    assert sorted(rows) == [key for key in JOBS if key[1] != 3]
    assert told == failures
    (failure,) = failures
    assert (failure.key, failure.reason) == (("squares", 3), "ValueError: three is too many")
    log = (tmp_path / "failures.log").read_text()
    assert log.startswith("squares 3: ValueError")
    assert "Traceback" in log
    rows, failures = run(tmp_path)  # tried again, by work that can
    assert rows["squares", 3] == {"value": 19}
    assert not failures


def test_progress_counts_jobs_of_this_call_and_judges_the_time_by_cost(tmp_path):
    seen = []
    run(tmp_path, JOBS[:2], progress=seen.append)
    assert str(GridProgress(2, 6, None)) == "2/6 jobs"
    seen.clear()
    run(tmp_path, JOBS, progress=seen.append, cost=lambda key: float(key[1]))
    assert {progress.jobs for progress in seen} == {6}
    assert (seen[0].finished >= 2, seen[-1].finished, seen[-1].left_s) == (True, 6, 0.0)


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (89.0, "89 s"), (90.0, "2 min"), (5399.0, "90 min"), (9000.0, "2.5 h")]
)
def test_durations_are_read_at_a_glance(seconds, text):
    assert duration_text(seconds) == text


def test_a_folder_with_other_files_is_left_alone(tmp_path):
    (tmp_path / "hits.csv").write_text("mine")
    with pytest.raises(GridError, match=r"holds other files \(hits.csv\)"), GridRecord(tmp_path, SETTINGS):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["hits.csv"]


def test_of_large_settings_only_what_differs_is_told(tmp_path):
    settings = {"offset": 10, "task": {"preset": "demo", "limits": [1, 2]}}
    run(tmp_path, settings=settings)
    with pytest.raises(ConfigError, match=r"settings \(task, preset: 'demo' there, now 'thesis'\): ask"):
        run(tmp_path, settings={**settings, "task": {**settings["task"], "preset": "thesis"}})


def test_results_without_their_settings_are_refused(tmp_path):
    run(tmp_path)
    (tmp_path / "settings.json").unlink()
    with pytest.raises(GridError, match=r"settings\.json is missing, so nobody knows"):
        run(tmp_path)
