"""The study as a whole: the same numbers however it is run, and nothing is lost where something goes wrong."""

import json
import tomllib

import pytest

from common.stop_signals import INTERRUPTED
from experiments.distribution.__main__ import main
from experiments.distribution.jobs import DistributionError, Job, work
from experiments.study import SO_FAR
from tests.experiments.distribution.studies_by_hand import (
    HAND_MADE,
    REMOTE_LOCAL,
    TINY,
    crash_twice,
    hand_made,
    interrupt,
)

TABLES = ("results.csv", "curves.csv", "README.md")


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
    assert run(whole, workers=2) == 0
    assert len(finished(whole)) == len(TINY.jobs()) == 2
    assert any(row["goal_steps"] for row in rows(whole))  # there is something to compare
    remote_local = next(job for job in TINY.jobs() if job.configuration == REMOTE_LOCAL.name)
    record = whole / "runs" / remote_local.folder
    of_run = tomllib.loads((record / "run.toml").read_text(encoding="utf-8"))["run"]
    assert (of_run["mode"], of_run["network"], of_run["host_budget"]) == ("remote_local", "wifi_bad", "workstation")
    actor = tomllib.loads((record / "config" / "actor.toml").read_text(encoding="utf-8"))
    assert actor["actor"]["min_inference_s"] == 0.003
    assert not (record / "ring").exists()
    assert (whole / "both.png").stat().st_size > 10_000

    assert run(resumed, do=interrupt) == INTERRUPTED
    assert finished(resumed) == [TINY.jobs()[0].key]
    summary = resumed / "runs" / TINY.jobs()[0].folder / "summary.json"
    written_ns = summary.stat().st_mtime_ns
    assert "1 of 2 jobs are kept; the same command goes on" in capsys.readouterr().out
    assert tables(resumed / "runs" / SO_FAR)["results.csv"].count("not run yet") == 1
    assert not (resumed / "results.csv").exists(), "there may be a whole study's"

    assert run(resumed, workers=1) == 0
    assert f"{remote_local.folder} was interrupted: removed, it begins again" in capsys.readouterr().out
    assert tables(resumed) == tables(whole)
    assert not (resumed / "runs" / SO_FAR).exists()
    assert summary.stat().st_mtime_ns == written_ns  # The finished run was not repeated.
    assert len(finished(resumed)) == len(set(finished(resumed))) == 2


def test_files_that_are_no_study_s_are_not_touched(tmp_path, capsys):
    (tmp_path / "README.md").write_text("mine", encoding="utf-8")
    assert run(tmp_path, HAND_MADE, hand_made) == 1
    assert f"{tmp_path} holds other files (README.md): expected an empty folder" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["README.md"]
    assert (tmp_path / "README.md").read_text(encoding="utf-8") == "mine"


def test_a_crashed_run_is_kept_and_reported_while_the_rest_goes_on(tmp_path, capsys):
    out = tmp_path / "out"
    assert run(out, HAND_MADE, crash_twice, workers=2) == 1
    shown = capsys.readouterr()
    raised, killed = (
        Job(name, "dot_reacher", 1000, seed) for name, seed in (("sac_laptop", 1), ("sac_workstation", 2))
    )
    assert f"{raised.folder} crashed: ValueError: the robot fell over; the rest goes on" in shown.err
    assert f"{killed.folder} crashed: its process died: killed by SIGKILL; the rest goes on" in shown.err
    assert "2 of 6 jobs crashed" in shown.err
    assert len(finished(out)) == 4
    for job in (raised, killed):
        assert (out / "runs" / f"{job.folder}.crashed" / "episodes.csv").exists()
        assert not (out / "runs" / job.folder).exists()
    assert "the robot fell over" in (out / "runs" / "failures.log").read_text(encoding="utf-8")
    assert tables(out)["results.csv"].count("crashed: ") == 2
    assert "4 of 6 runs finished" in tables(out)["README.md"]
    assert "sac_laptop, dot_reacher, 1 seed (1): crashed: ValueError: the robot fell over" in tables(out)["README.md"]

    # The same command tries them again, and nothing else.
    assert run(out, HAND_MADE, hand_made) == 0
    assert set(finished(out)[4:]) == {raised.key, killed.key}
    assert run(tmp_path / "never_crashed", HAND_MADE, hand_made) == 0
    assert tables(out) == tables(tmp_path / "never_crashed")


@pytest.mark.parametrize(
    ("name", "key", "value"),
    [
        ("dot_reacher 1000 steps: sac_laptop: sac", "batch_size", 32),
        ("host laptop", "inference_s", 0.5),
        ("dot_reacher 1000 steps: sac_laptop", "mode", "remote_only"),
    ],
)
def test_runs_of_other_settings_are_not_mixed_in(tmp_path, capsys, name, key, value):
    assert run(tmp_path, HAND_MADE, hand_made) == 0
    settings = tmp_path / "runs" / "settings.json"
    values = json.loads(settings.read_text(encoding="utf-8"))
    assert values[name][key] != value
    settings.write_text(json.dumps({**values, name: {**values[name], key: value}}), encoding="utf-8")
    assert run(tmp_path, HAND_MADE, hand_made) == 1
    assert f"{name}, {key}: {value!r} there, now " in capsys.readouterr().err


def test_a_run_that_ended_early_is_no_result(tmp_path, monkeypatch):
    def end_early(training):
        training.run_dir.mkdir()
        return {"steps": 70, "episodes": 0}

    monkeypatch.setattr("experiments.distribution.jobs.train", end_early)
    job = Job(REMOTE_LOCAL.name, "dot_reacher", 150, 0)
    run_settings = {"algorithm": "sac", "mode": "local_only", "network": None, "host": "laptop", "overrides": []}
    with pytest.raises(DistributionError, match="expected 150 steps"):
        work({"runs": str(tmp_path), job.setting: run_settings}, job.key)


def test_a_run_over_a_link_that_goes_down_for_good_ends_and_is_no_result(tmp_path):
    trace, network = tmp_path / "dead.csv", tmp_path / "network.toml"
    trace.write_text("time_s,loss\n0,0\n1,1\n", encoding="utf-8")
    network.write_text(f'[network]\ntrace = "{trace}"\ntrace_end = "stop"\n', encoding="utf-8")
    job = Job(REMOTE_LOCAL.name, "dot_reacher", 150, 0)
    run_settings = {"algorithm": "sac", "mode": "remote_only", "host": "laptop", "overrides": []}
    run_settings["network"] = str(network)
    with pytest.raises(DistributionError, match="expected 150 steps"):
        work({"runs": str(tmp_path), job.setting: run_settings}, job.key)


def test_a_plan_runs_nothing_and_says_how_long_it_takes(tmp_path, capsys):
    assert main(["--plan", "--out", str(tmp_path / "out"), "--workers", "2"], {"hand_made": HAND_MADE}) == 0
    assert "6 jobs, about" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()
