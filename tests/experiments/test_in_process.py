"""The end of a run in one process: it comes, whatever the network does, and the record says what it has cost."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from common.console import Console
from common.errors import ServiceError
from common.stop_signals import StopSignals
from deploy.summary import read_record, summarise
from experiments import in_process
from experiments.train import Training, train
from services.robot_bridge.cameras import PictureSize
from tests.experiments.small_algorithm import SMALL_ALGORITHM
from tests.services.robot_bridge.cameras.pictures import write_video

SMALL = (
    *SMALL_ALGORITHM,
    "actor.min_inference_s=0.001",
    "learner.min_update_s=0.005",
)
DEAD_S = 2.0
"""From when on the links here carry nothing."""


def small(run_dir: Path, network: Path | None, **changes) -> Training:
    options: dict[str, Any] = {"task": "dot_reacher", "run_dir": run_dir, "steps": 10_000, "mode": "remote_only"}
    options["network"] = None if network is None else str(network)
    return Training(**{**options, "overrides": SMALL, **changes})


def link(folder: Path, *rows: str, end: str = "loop") -> Path:
    """A link by its rows, time and loss."""
    trace = folder / "link.csv"
    trace.write_text("\n".join(["time_s,loss", *rows]) + "\n", encoding="utf-8")
    network = folder / "network.toml"
    network.write_text(f'[network]\ntrace = "{trace}"\ntrace_end = "{end}"\n', encoding="utf-8")
    return network


@pytest.fixture
def dead(tmp_path):
    """A link that goes down and stays so for a day."""
    return link(tmp_path, "0,0", f"{DEAD_S},1", "86400,1")


class StopAfter(StopSignals):
    """Asks to stop after some looks, one a simulated second, and once more after some further ones."""

    def __init__(self, looks: int, further_looks: float = float("inf")) -> None:
        super().__init__()
        self._looks, self._further_looks, self._count = looks, further_looks, -1  # one before the run

    @property
    def asked(self) -> bool:
        self._count += 1
        return self._count >= self._looks

    @property
    def asked_again(self) -> bool:
        return self._count >= self._looks + self._further_looks

    @asked_again.setter
    def asked_again(self, value: bool) -> None:
        pass


def link_lasted_s(run_dir: Path) -> float:
    part = json.loads((run_dir / "network.json").read_text(encoding="utf-8"))
    return (part["written_monotonic_ns"] - part["start_monotonic_ns"]) / 1e9


def part_of(run_dir: Path, service: str) -> dict[str, Any]:
    return json.loads(next(run_dir.glob(f"parts/{service}-*.json")).read_text(encoding="utf-8"))


def told(service: str) -> str:
    return f"{service} had not heard 40 s later that the run is over, and was told to stop"


REMOTE = ("actor", "replay", "learner")


def check_end(run_dir: Path, values: dict[str, Any], end_s: float) -> None:
    """The services have ended, told after 40 s, and the summary says what the dead link has kept from replay.

    Args:
        run_dir: of the record.
        values: of the summary.
        end_s: when the bridge ended or was asked to.
    """
    assert values == summarise(read_record(run_dir)).values, "whoever makes the summary again is told the same"
    assert [note for note in values["notes"] if "told to stop" in note] == [told(service) for service in REMOTE]
    assert values["service_failures"] == []
    assert {part_of(run_dir, service)["state"] for service in (*REMOTE, "robot_bridge")} == {"stopped"}
    # 40 s, looked at once a second, and the 2 s that whoever is told to stop may wait for the others.
    assert end_s + 40 <= link_lasted_s(run_dir) <= end_s + 45
    experience = values["experience"]
    assert experience["lost"] == experience["produced"] - experience["persisted"]
    assert (run_dir / "policy.msgpack").exists()


def test_a_run_that_is_stopped_while_its_link_is_down_ends(dead, tmp_path, capsys):
    values = train(small(tmp_path / "run", dead), Console(), StopAfter(4))
    check_end(tmp_path / "run", values, end_s=4)
    # Steps of two seconds with 25 cycles each, less the services' start, were answered; the rest is on nobody's disk.
    assert 25 <= values["experience"]["persisted"] <= 52
    assert values["experience"]["lost"] > 0
    assert "the run has ended early: interrupted" in capsys.readouterr().err


def test_a_run_whose_trace_ends_dead_ends(tmp_path):
    network = link(tmp_path, "0,0", f"{DEAD_S},1", end="stop")
    values = train(small(tmp_path / "run", network))
    # The last row holds as long as the one before it.
    check_end(tmp_path / "run", values, end_s=2 * DEAD_S)
    assert values["experience"]["lost"] > 0


def test_a_run_whose_steps_are_through_while_its_link_is_down_ends(dead, tmp_path):
    values = train(small(tmp_path / "run", dead, steps=75))
    assert values["steps"] == 75
    # 75 cycles are 3 s, after the start; then the bridge waits 30 s for what is on its way.
    end_s = 3 + 30
    check_end(tmp_path / "run", values, end_s=end_s)
    assert values["experience"]["lost"] > 0


def test_a_service_that_hears_of_the_end_late_is_left_to_its_own_end(tmp_path):
    network = link(tmp_path, "0,0", "2,1", "20,0", "86400,0")
    values = train(small(tmp_path / "run", network, steps=75))
    # Down for 18 s, and soon afterwards all has come, as it did before anybody was told.
    assert (values["steps"], values["experience"]["lost"], values["notes"][1:]) == (75, 0, [])
    assert link_lasted_s(tmp_path / "run") > 20


def test_who_asks_to_stop_a_second_time_does_not_wait(dead, tmp_path, capsys):
    values = train(small(tmp_path / "run", dead), Console(), StopAfter(4, further_looks=5))
    assert link_lasted_s(tmp_path / "run") == pytest.approx(9, abs=1.1)
    said = capsys.readouterr().err
    assert "the services were cut off: asked once more to stop" in said
    assert "no time to draw the learning curve" in said
    assert not (tmp_path / "run" / "learning_curve.png").exists()
    failures = {failure["service"]: failure["failure"] for failure in values["service_failures"]}
    # The bridge had ended, 2 s after it was asked.
    assert failures == dict.fromkeys(REMOTE, "cut off in state 'running': asked once more to stop")
    assert values == json.loads((tmp_path / "run" / "summary.json").read_text(encoding="utf-8"))
    assert values["experience"]["lost"] == values["experience"]["produced"] - values["experience"]["persisted"] > 0


def test_a_lockstep_run_is_cut_off_too(tmp_path):
    values = train(small(tmp_path / "run", None, mode=None), stop=StopAfter(2, further_looks=0))
    assert {failure["service"] for failure in values["service_failures"]} == {*REMOTE, "robot_bridge"}
    assert values["steps"] == part_of(tmp_path / "run", "robot_bridge")["counters"]["steps"] < 10_000


def test_a_service_that_does_not_end_though_it_is_told_to_is_cut_off(tmp_path, monkeypatch):
    def never_ends(learner):
        nobody_notifies = learner._service.clock.condition()
        with nobody_notifies:
            learner._service.clock.wait(nobody_notifies)

    monkeypatch.setattr("services.learner.learner.Learner.run", never_ends)
    values = train(small(tmp_path / "run", None, mode="local_only", steps=20))
    assert [failure["service"] for failure in values["service_failures"]] == ["learner"]
    assert "the end of the run has taken more than 80 s" in values["service_failures"][0]["failure"]


def test_a_robot_that_can_make_no_step_ends_the_run_as_a_failure(tmp_path, monkeypatch):
    monkeypatch.setattr(in_process, "STANDSTILL_S", 60.0)
    never = link(tmp_path, "0,1", "86400,1")
    reason = "no step for 60 s of simulated time, at 0 steps: the robot waits for actor and replay"
    with pytest.raises(ServiceError, match=reason):
        train(small(tmp_path / "run", never))
    values = summarise(read_record(tmp_path / "run")).values
    assert (values["steps"], values["experience"]["produced"]) == (0, 0)
    assert values["notes"][0].startswith(f"the run was cut short, at 0 of 10000 steps: {reason}")
    assert values["notes"][0].endswith("actor and replay; look whether the network carries anything")
    assert reason in (tmp_path / "run" / "logs" / "train.log").read_text(encoding="utf-8")


def test_a_robot_that_waits_for_its_camera_does_not_blame_the_network(tmp_path, monkeypatch):
    monkeypatch.setattr(in_process, "STANDSTILL_S", 10.0)
    video = write_video(tmp_path / "video.avi", 30, size=PictureSize(60, 60))  # 1 s
    camera = ("camera.name=recorded", f"camera.file={video}", "camera.loop=false")
    task = ("task.height=60", "task.width=60")
    training = small(tmp_path / "run", None, task="noise_frames", mode="local_only", overrides=(*SMALL, *camera, *task))
    with pytest.raises(ServiceError, match="the robot waits for camera; see ") as caught:
        train(training)
    assert "network" not in str(caught.value)
