"""The tables of studies hold what they are for."""

from collections import Counter

import pytest

from experiments.minimum_time.__main__ import main
from experiments.minimum_time.jobs import HITS, TRAINING
from experiments.minimum_time.plan import Plan
from experiments.minimum_time.sizes import SIZES, SMALL, THESIS, Figure, Panel, Size, expected_s


def runs(size, task, head="zero"):
    """Time limit -> number of seeds."""
    jobs = [job for job in size.jobs() if (job.kind, job.task, job.head) == (TRAINING, task, head)]
    return dict(Counter(job.limit for job in jobs))


def test_the_small_study_has_at_least_five_seeds_of_what_it_must_show():
    dot, visual = runs(SMALL, "dot_reacher"), runs(SMALL, "visual_dot_reacher")
    assert {10, 50, 500} <= dot.keys()
    assert len(visual) >= 2
    assert min(*dot.values(), *visual.values(), *runs(SMALL, "dot_reacher", "default").values()) >= 5


def test_the_small_study_takes_two_cores_less_than_an_hour():
    plan = Plan(SMALL)
    assert sum(map(plan.expected_s, plan.jobs.values())) / 2 < 3600


def test_the_thesis_study_has_its_limits_seeds_and_steps():
    assert {job.steps for job in THESIS.jobs() if job.kind == TRAINING} == {200_000}
    assert runs(THESIS, "dot_reacher") == runs(THESIS, "reacher_hard_visual") == {50: 30, 100: 30, 500: 30}
    for task in ("ball_in_cup", "ball_in_cup_visual", "reacher_easy", "reacher_hard"):
        assert {50, 100, 500, 1000} <= runs(THESIS, task).keys(), task
    assert THESIS.hit_seeds == 30


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
def test_what_two_figures_show_is_run_once_and_has_a_folder_of_its_own(size):
    jobs = size.jobs()
    assert len(set(jobs)) == len(jobs) == len({job.folder for job in jobs})
    for panel in size.panels:
        for limit, head in panel.curves:
            assert set(size.hits_jobs(panel, limit, head) + size.training_jobs(panel, limit, head)) <= set(jobs)


def test_a_job_takes_as_long_as_the_robot_acts():
    jobs = {job.limit: job for job in SMALL.jobs() if (job.kind, job.task) == (TRAINING, "dot_reacher")}
    # Limit 10 and resets of 10: half of the steps; limit 500: nearly all.
    short, long = (expected_s(jobs[limit], 10) - expected_s(jobs[limit], 10**9) for limit in (10, 500))
    assert long / short == pytest.approx((500 / 510) / (10 / 20), rel=1e-6)


def test_the_plan_names_every_job_and_runs_none(tmp_path, capsys):
    assert main(["--plan", "--workers", "2", "--out", str(tmp_path / "out")]) == 0
    shown = capsys.readouterr().out
    assert "dot_reacher" in shown
    assert f"{len(SMALL.jobs())} jobs" in shown
    assert "with 2 workers" in shown
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("panel", "message"),
    [
        (Panel("dot_racher", "", (10,), 100, 1), "dot_reacher"),
        (Panel("dot_reacher", "none_such", (10,), 100, 1), "none_such"),
        (Panel("noise_frames", "", (10,), 100, 1), "task noise_frames has no goal"),
    ],
)
def test_a_study_of_what_cannot_be_studied_is_refused(panel, message, tmp_path, capsys):
    size = Size("bad", (Figure("curves", "Curves", (panel,)),), hit_seeds=1, window=10)
    assert main(["--out", str(tmp_path / "out")], {"bad": size}) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_no_workers_are_refused(capsys):
    assert main(["--workers", "0"]) == 1
    assert "--workers 0: expected at least 1" in capsys.readouterr().err


def test_hits_jobs_of_the_zero_head_need_no_run():
    kinds = Counter((job.kind, job.head) for job in SMALL.jobs())
    assert kinds[HITS, "zero"] == 30 * 10
    assert kinds[HITS, "default"] == 8
