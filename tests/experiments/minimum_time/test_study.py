"""A study as a whole: the same numbers however it is run, and nothing is lost where something goes wrong."""

import json
from pathlib import Path

import pytest

from common.stop_signals import INTERRUPTED
from experiments.minimum_time.__main__ import main
from experiments.minimum_time.jobs import HITS, TRAINING, Job, StudyError, work
from tests.experiments.minimum_time.rows_by_hand import (
    HAND_MADE,
    SMALL_NETWORKS,
    TINY,
    crash_twice,
    hand_made,
    interrupt,
)

TABLES = ("results.csv", "hits.csv", "curves.csv", "README.md")


def run(out, size=TINY, do=work, workers=1):
    return main(["--out", str(out), "--workers", str(workers)], {size.name: size}, do)


def tables(out):
    return {name: (out / name).read_text(encoding="utf-8") for name in TABLES}


def rows(out):
    """In the order in which they were finished."""
    return [json.loads(line) for line in (out / "runs" / "results.jsonl").read_text(encoding="utf-8").splitlines()]


def finished(out):
    return [tuple(row["key"]) for row in rows(out)]


def test_interrupted_and_resumed_with_other_workers_it_gives_the_same_tables(tmp_path, capsys):
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    assert run(whole) == 0
    assert len(finished(whole)) == len(TINY.jobs())
    assert all(row["goal_steps"] for row in rows(whole) if "goal_steps" in row)  # there is something to compare

    assert run(resumed, do=interrupt) == INTERRUPTED
    first = TINY.jobs()[0]
    assert finished(resumed) == [first.key]
    summary = resumed / "runs" / first.folder / "summary.json"
    written_ns = summary.stat().st_mtime_ns
    half = next(job for job in TINY.jobs() if job.limit == 50)
    assert (resumed / "runs" / half.folder).exists()
    assert "1 of 8 jobs are kept; the same command goes on" in capsys.readouterr().out
    assert not (resumed / "README.md").exists(), "there may be a whole study's"

    assert run(resumed, workers=2) == 0
    assert f"{half.folder} was interrupted: removed, it begins again" in capsys.readouterr().out
    assert tables(resumed) == tables(whole)
    # The finished run was not repeated.
    assert summary.stat().st_mtime_ns == written_ns
    assert len(finished(resumed)) == len(set(finished(resumed))) == len(TINY.jobs())


def test_a_crashed_run_is_kept_and_reported_while_the_rest_goes_on(tmp_path, capsys):
    out = tmp_path / "out"
    assert run(out, HAND_MADE, crash_twice, workers=2) == 1
    shown = capsys.readouterr()
    raised, killed = (
        Job(TRAINING, "dot_reacher", "demo", limit, "zero", 2000, seed) for limit, seed in ((10, 1), (50, 2))
    )
    assert f"{raised.folder} crashed: ValueError: the robot fell over; the rest goes on" in shown.err
    assert f"{killed.folder} crashed: its process died: killed by SIGKILL; the rest goes on" in shown.err
    assert "2 of 27 jobs crashed" in shown.err
    assert len(finished(out)) == 25
    for job in (raised, killed):
        assert (out / "runs" / f"{job.folder}.crashed" / "episodes.csv").exists()
        assert not (out / "runs" / job.folder).exists()
    assert "the robot fell over" in (out / "runs" / "failures.log").read_text(encoding="utf-8")
    assert tables(out)["results.csv"].count("crashed: ") == 2
    assert "10 of 12 runs finished" in tables(out)["README.md"]

    # The same command tries them again, and nothing else.
    assert run(out, HAND_MADE, hand_made) == 0
    assert set(finished(out)[25:]) == {raised.key, killed.key}
    assert run(tmp_path / "never_crashed", HAND_MADE, hand_made) == 0
    assert tables(out) == tables(tmp_path / "never_crashed")
    assert (out / "runs" / f"{raised.folder}.crashed").exists()


def test_runs_of_other_settings_are_not_mixed_in(tmp_path, capsys):
    assert run(tmp_path, HAND_MADE, hand_made) == 0
    settings = tmp_path / "runs" / "settings.json"
    values = json.loads(settings.read_text(encoding="utf-8"))
    assert values["dot_reacher demo: sac.batch_size"] == 64
    settings.write_text(json.dumps({**values, "dot_reacher demo: sac.batch_size": 32}), encoding="utf-8")
    assert run(tmp_path, HAND_MADE, hand_made) == 1
    assert "sac.batch_size: 32 there, now 64" in capsys.readouterr().err


@pytest.fixture
def settings(tmp_path):
    return {"runs": str(tmp_path), "overrides": SMALL_NETWORKS}


def test_a_run_is_told_its_limit_and_its_head_and_keeps_its_record(settings, tmp_path):
    job = Job(TRAINING, "dot_reacher", "demo", 20, "default", 120, 1)
    row = work(settings, job.key)
    run_dir = tmp_path / job.folder
    assert row["goal_steps"] == sorted(row["goal_steps"])
    bridge, learner = (
        (run_dir / "config" / f"{name}.toml").read_text(encoding="utf-8") for name in ("robot_bridge", "learner")
    )
    assert "time_limit = 20" in bridge
    assert 'preset = "demo"' in bridge
    assert "zero_initialised_head = false" in learner
    assert "threads = 1" in learner
    assert (run_dir / "summary.json").exists()
    # Its experience, gigabytes where there are images, is not kept.
    assert not (run_dir / "ring").exists()


def test_hits_are_counted_under_the_settings_of_the_runs(settings):
    key = Job(HITS, "dot_reacher", "demo", 20, "zero", 2000, 0).key
    small, large = (
        work({**settings, "overrides": (f"task.target_half_width={width}", *SMALL_NETWORKS[:1])}, key)["hits"]
        for width in (0.1, 0.6)
    )
    assert small < large / 2


def test_hits_of_the_default_head_are_counted_by_a_run_that_never_learns(settings, tmp_path):
    job = Job(HITS, "dot_reacher", "demo", 20, "default", 300, 1)
    row = work(settings, job.key)
    summary = json.loads((tmp_path / job.folder / "summary.json").read_text(encoding="utf-8"))
    assert summary["updates"] == 0
    assert row == {"hits": summary["episodes"]}


def test_a_run_that_ended_early_is_no_result(settings, monkeypatch):
    def end_early(training):
        Path(training.run_dir).mkdir()
        return {"steps": 70, "episodes": 0}

    monkeypatch.setattr("experiments.minimum_time.jobs.train", end_early)
    with pytest.raises(StudyError, match="expected 120 steps"):
        work(settings, Job(TRAINING, "dot_reacher", "demo", 20, "zero", 120, 0).key)


def test_a_reward_other_than_minus_one_a_step_is_no_result(settings, monkeypatch, tmp_path):
    def dense(training):
        Path(training.run_dir).mkdir()
        lines = ["episode,return,length,attempts,steps", "0,-10.0,10,1,10", "1,-3.5,10,1,20"]
        (Path(training.run_dir) / "episodes.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
        return {"steps": 120, "episodes": 2}

    monkeypatch.setattr("experiments.minimum_time.jobs.train", dense)
    with pytest.raises(StudyError, match=r"episode 1 has return -3\.5, length 10"):
        work(settings, Job(TRAINING, "dot_reacher", "demo", 20, "zero", 120, 0).key)
