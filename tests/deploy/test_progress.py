"""The progress line, from the parts of a run."""

from pathlib import Path

from deploy.progress import Progress, ProgressReader, progress_line
from tests.deploy.hand_made_record import write_episodes, write_part

RUNNING = dict.fromkeys(("robot_bridge", "actor", "replay", "learner"), "running")


def test_before_the_first_step_the_line_says_who_is_there(tmp_path: Path) -> None:
    write_part(tmp_path, "robot_bridge", 1, state="running", counters={"steps": 0})
    write_part(tmp_path, "learner", 1, state="starting")
    line = progress_line(ProgressReader(tmp_path, 100).read())
    assert line == "starting: robot_bridge running, actor -, replay -, learner starting"


def test_before_the_first_step_the_line_says_what_the_robot_waits_for() -> None:
    line = progress_line(Progress(RUNNING, waits_for="camera"))
    assert (
        line
        == "starting: robot_bridge running, actor running, replay running, learner running; the robot waits for camera"
    )


def test_progress_adds_up_incarnations_and_estimates_the_rest(tmp_path: Path) -> None:
    now_s = 10.0
    reader = ProgressReader(tmp_path, 4000, now_s=lambda: now_s)
    bridge = {"late_actions": 2, "overruns": 1, "last_return": -12.0, "unacknowledged": 2}
    write_part(tmp_path, "robot_bridge", 1, state="running", has_goal=True, counters={"steps": 500, **bridge})
    assert reader.read().left_s is None
    write_part(tmp_path, "robot_bridge", 2, state="running", has_goal=True, counters={"steps": 2000, **bridge})
    write_part(tmp_path, "actor", 1, state="running", counters={"unacknowledged": 3, "lost": 1})
    write_part(tmp_path, "replay", 1, state="running", counters={"lost": 4})
    write_part(tmp_path, "learner", 1, state="running", counters={"updates_per_s": 24.96, "policy_version": 43})
    write_episodes(tmp_path, [1000, 1200, 1600, 2000])
    now_s = 70.0  # 1500 steps took 60 s, so 2000 take 80 s
    progress = reader.read()
    assert progress.left_s == 80.0
    assert progress_line(progress) == (
        "2000/4000 50 % ETA 1:20 | steps/goal 333.3 (last 10: 500.0) | return -12 | 25.0 updates/s | policy 43 | "
        "late 4 | overruns 2 | unacknowledged 5 | lost 5"
    )


def test_a_service_that_does_not_run_is_named() -> None:
    progress = Progress({**RUNNING, "actor": "stopped"}, steps=10, steps_total=20)
    assert progress_line(progress).endswith("lost 0 | actor stopped")


def test_a_robot_that_waits_says_for_whom(tmp_path: Path) -> None:
    write_part(tmp_path, "robot_bridge", 1, state="running", counters={"steps": 30}, waits_for="actor")
    assert progress_line(ProgressReader(tmp_path, 100).read()).startswith("30/100 30 % the robot waits for actor | ")


def test_a_finished_run_has_no_time_left() -> None:
    assert "ETA" not in progress_line(Progress(RUNNING, steps=20, steps_total=20, left_s=0.0))
