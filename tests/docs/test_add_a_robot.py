"""docs/add-a-robot.md, followed literally: a robot from a folder outside the package."""

import json
import os
import shlex
import subprocess
import sys
import tomllib

import cv2
import numpy as np
import pytest

from common.errors import ConfigError
from common.stop_signals import StopSignals
from experiments import hits
from services.robot_bridge import preview, rendering
from services.robot_bridge.tasks import TASKS, load_task
from services.robot_bridge.tasks.robot_task import RobotTask
from tests.docs.task_pages import ROOT, Page, conformance_checks
from tests.services.robot_bridge.opengl import skip_without_opengl

PAGE = Page("add-a-robot.md")
CHECKS = conformance_checks("demo", "disturbed")
CYCLE_NS = 40_000_000


@pytest.fixture
def my_robots(tmp_path, monkeypatch):
    """The folder with the page's file, where Python finds it."""
    skip_without_opengl()
    folder = tmp_path / "my_robots"
    folder.mkdir()
    (folder / "toy.py").write_text(PAGE.block("python"), encoding="utf-8")
    monkeypatch.syspath_prepend(folder)
    yield folder
    sys.modules.pop("toy", None)


def rows():
    return tomllib.loads(PAGE.block("toml"))["tasks"]


def command(containing):
    """What the page's command with this text passes to the program."""
    words = shlex.split(PAGE.block("bash", containing))
    assert words[:4] == ["PYTHONPATH=my_robots", "python", "-m", containing]
    return words[4:]


def begun(seed=2, **settings):
    task = load_task("toy", overrides=settings, rows=rows(), rng=np.random.default_rng(seed))
    task.advance_to(0)
    task.begin_episode()
    return task


@pytest.mark.parametrize(("check", "arguments"), CHECKS)
def test_the_robot_passes_the_checks_of_every_task(my_robots, monkeypatch, check, arguments):
    monkeypatch.setitem(TASKS, "toy", rows()["toy"])
    check(name="toy", **arguments)


def test_there_are_such_checks():
    assert len(CHECKS) >= 20


def test_without_its_folder_the_row_is_named_with_what_to_do():
    with pytest.raises(ConfigError, match=r"\[tasks\] toy = 'toy:Toy'.*has to be on PYTHONPATH"):
        begun()


def test_sensors_and_camera_keep_the_rates_that_the_page_gives_them(my_robots):
    task = begun()
    before = task.counters()
    for cycle in range(1, 26):
        task.advance_to(cycle * CYCLE_NS)
    after = task.counters()
    assert {name: after[name] - before[name] for name in after} == {"sensor_packets": 100, "camera_frames": 30}
    task.close()


@pytest.mark.parametrize("seed", range(3))
def test_what_the_camera_shows_leads_the_cart_to_its_goal(my_robots, seed):
    task = begun(seed)
    speed = 0.3
    for cycle in range(1, 251):
        reading = task.read()
        red, green, _ = reading.frames[-1:].astype(int).transpose(3, 0, 1, 2)
        columns = np.nonzero(green - red > 40)[2]
        if columns.size:
            speed = 0.3 * np.sign(columns.mean() - 31.5)
        elif abs(reading.proprioception[0]) == 0.5:
            speed = -0.3 * np.sign(reading.proprioception[0])  # nothing to see up to this end
        task.command(np.array([speed], np.float32))
        task.advance_to(cycle * CYCLE_NS)
        if task.outcome().terminated:
            break
    assert task.outcome().terminated
    paper, cart = task.robot.data.mocap_pos[0, 0], task.robot.data.qpos[0]
    # The paper is 0.35 m before the lens: half the image is 0.35 tan(30 deg) 64 / 48 = 0.27 m wide, 20 % of it 0.054 m.
    assert abs(paper - cart) <= 0.054 + 0.3 / 30 + 0.005  # seen at most a frame ago, in pixels of 8 mm
    task.close()


@pytest.mark.parametrize(
    ("right", "wrong", "match"),
    [
        (
            "return np.array([self.data.qpos[0], 0.0 if",
            "return np.array([self.data.qpos[0], 0.0, 0.0 if",
            r"^\[task\] toy: Cart.sense\(\) gives shape \(3,\): expected \(2,\), the shape of Toy\.",
        ),
        ('View("webcam"', 'View("webcm"', r"^\[task\] toy: camera 'webcm': expected one of the scene's: room, webcam"),
        ("camera_hz=30", "camera_hz=0", r"^\[tasks\] toy = 'toy:Toy': .*: Rates: camera_hz = 0: expected at least 1"),
        ('<body name="cart"', "<bdy", r"^\[task\] toy: the scene of Toy: XML parse error"),
        ('<body name="cart"', '<body nme="cart"', r"^\[task\] toy: the scene of Toy: XML Error: .*'nme'"),
        ('size=".05 .04 .02"', 'size=".05"', r"^\[task\] toy: the scene of Toy: Error: "),
    ],
)
def test_what_is_wrong_in_the_file_is_named(my_robots, right, wrong, match):
    file = my_robots / "toy.py"
    text = file.read_text(encoding="utf-8")
    assert text.count(right) == 1
    file.write_text(text.replace(right, wrong), encoding="utf-8")
    with pytest.raises(ConfigError, match=match):
        load_task("toy", rows=rows(), rng=np.random.default_rng(0))


def test_at_the_rails_end_the_cart_rests_whatever_is_commanded(my_robots):
    task = begun(max_speed=5.0)
    task.command(task.spec.action_high)
    task.advance_to(CYCLE_NS * 25)
    np.testing.assert_array_equal(task.read().proprioception, np.array([0.5, 0.0], np.float32))
    task.command(task.spec.action_low)
    task.advance_to(CYCLE_NS * 25 + 20_000_000)
    np.testing.assert_allclose(task.read().proprioception, [0.4, -5.0], atol=1e-6)
    task.close()


def test_the_pages_preview_shows_the_cart(my_robots, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(preview, "ROOM_WIDTH", 192)
    monkeypatch.setattr(preview, "ROOM_HEIGHT", 108)
    monkeypatch.setattr(rendering, "SHADOW_MAP", 128)
    monkeypatch.chdir(tmp_path)
    assert preview.main(command("services.robot_bridge"), StopSignals()) == 0
    sheet, video = capsys.readouterr().out.split()
    picture = cv2.imread(sheet)
    assert picture is not None
    blue, green, red = picture.astype(int).transpose(2, 0, 1)
    assert (green - np.maximum(red, blue) > 40).sum() > 500  # the paper
    assert cv2.VideoCapture(video).get(cv2.CAP_PROP_FRAME_COUNT) == 250


def test_the_pages_count_finds_hits(my_robots, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(my_robots))
    monkeypatch.chdir(tmp_path)
    assert hits.main(command("experiments.hits")) == 0
    (line,) = (tmp_path / "runs" / "hits" / "hits.csv").read_text().splitlines()[1:]
    task, limit, seed, found = line.split(",")
    assert (task, limit, seed) == ("toy", "150", "0")
    assert int(found) >= 2


def test_the_pages_command_lets_the_four_services_learn_it_in_real_time(my_robots, tmp_path):
    run_dir = tmp_path / "run"
    result = subprocess.run(
        [sys.executable, "-m", "deploy.launch", *command("deploy.launch"), "--run-dir", str(run_dir)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(my_robots)},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    summary = json.loads((run_dir / "summary.json").read_text())
    assert (summary["task"], summary["steps"]) == ("toy", 150)
    assert summary["experience"]["lost"] == 0


def test_the_task_is_a_simulated_robots(my_robots):
    task = begun()
    assert isinstance(task, RobotTask)
    task.close()


def test_the_pages_check_is_the_conformance_test():
    words = shlex.split(PAGE.block("bash", "pytest"))
    assert words[:4] == ["python", "-m", "pytest", "tests/conformance/test_tasks.py"]
    assert ROOT.joinpath(words[3]).is_file()


def test_files_the_page_links_to_exist():
    assert not PAGE.missing_files()
