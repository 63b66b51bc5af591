"""A robot's task to look at: what is drawn, what is written, and clear words where it cannot be."""

import itertools
import os
import signal
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from common.errors import ServiceError
from common.stop_signals import StopSignals
from services.robot_bridge import __main__, preview, rendering
from services.robot_bridge.preview_pictures import (
    COLUMNS,
    GAP,
    LABEL_HEIGHT,
    TILE_WIDTH,
    TILES,
    contact_sheet,
    panels,
    write_video,
)
from services.robot_bridge.tasks import load_task
from tests.helpers import unusable_output
from tests.services.robot_bridge.opengl import skip_without_opengl

FRANKA = "franka_visual_reacher"
SHORT = ["--set", "task.action_cycle_time=0.5", "--set", "task.time_limit=6"]
"""20 cycles, two attempts ended by time."""


@pytest.fixture
def opengl(monkeypatch):
    skip_without_opengl()
    # The picture from outside, small and coarse: it takes most of the time.
    monkeypatch.setattr(preview, "ROOM_WIDTH", 192)
    monkeypatch.setattr(preview, "ROOM_HEIGHT", 108)
    monkeypatch.setattr(rendering, "SHADOW_MAP", 128)


def run(directory, *arguments, task=FRANKA, stop=None):
    return preview.main(["--task", task, "--preview", str(directory), *arguments], stop or StopSignals())


def video_frames(path):
    video = cv2.VideoCapture(str(path))
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1][..., ::-1])
    rate = video.get(cv2.CAP_PROP_FPS)
    video.release()
    return frames, rate


def test_an_episode_becomes_a_video_and_a_contact_sheet(opengl, tmp_path, capsys):
    assert run(tmp_path / "new", *SHORT) == 0
    sheet, video = tmp_path / "new" / f"{FRANKA}.png", tmp_path / "new" / f"{FRANKA}.mp4"
    assert capsys.readouterr().out.split() == [str(sheet), str(video)]
    frames, rate = video_frames(video)
    assert rate == 2
    assert {frame.shape for frame in frames} == {(540, 1440, 3)}
    assert len(frames) == 20
    picture = cv2.imread(str(sheet))
    assert picture.shape[1] == GAP + COLUMNS * (TILE_WIDTH + GAP)
    # The agent's view is of the table's brown, the mask is black and white, the room is neither.
    first = frames[0]
    red, green, blue = np.median(first[:270, :480], axis=(0, 1))
    assert red > green + 15 > blue + 30
    mask = first[270:, :480]
    assert ((mask < 40) | (mask > 215)).mean() > 0.99
    assert first[:, 480:].std() > 10


def test_the_moments_show_frame_mask_and_robot_of_the_same_time(opengl):
    task = load_task(FRANKA, overrides={"action_cycle_time": 0.2, "time_limit": 4}, rng=np.random.default_rng(0))
    shown = list(itertools.islice(preview.moments(task, 0), 8))
    task.close()
    assert [moment.time_s for moment in shown] == pytest.approx(0.2 * np.arange(1, len(shown) + 1))
    for moment in shown:
        red = moment.frame[..., 0].astype(int) - moment.frame[..., 1]
        assert np.array_equal(moment.mask, red > 100)  # nothing else is red
    assert len({moment.room.tobytes() for moment in shown}) == len(shown)  # the arm moves on


def test_after_a_goal_another_episode_begins(opengl, monkeypatch):
    overrides = {"action_cycle_time": 1.0, "threshold": 0.0}  # the goal: as soon as there is any red
    task = load_task(FRANKA, overrides=overrides, rng=np.random.default_rng(0))
    episodes, begin_episode = [], task.begin_episode
    monkeypatch.setattr(task, "begin_episode", lambda: (episodes.append(1), begin_episode()))
    shown = list(preview.moments(task, 0))
    task.close()
    assert len(shown) == 10
    assert [moment.at_goal for moment in shown] == [moment.mask.any() for moment in shown]
    assert sum(moment.at_goal for moment in shown) == len(episodes) - 1 >= 2


def test_the_same_seed_draws_the_same_and_another_seed_another(opengl):
    def frames(seed):
        task = load_task(FRANKA, overrides={"action_cycle_time": 1.0}, rng=np.random.default_rng(seed))
        with_masks = [moment.frame.tobytes() for moment in preview.moments(task, seed)]
        task.close()
        return with_masks

    assert frames(0) == frames(0) != frames(1)


def test_a_picture_has_the_enlarged_view_above_the_mask_and_the_room_beside_them():
    frame = np.zeros((90, 160, 3), np.uint8)
    frame[0, 1] = (200, 10, 20)
    mask = np.zeros((90, 160), bool)
    mask[89, 159] = True
    picture = panels(frame, mask, np.full((540, 960, 3), 77, np.uint8))
    assert picture.shape == (540, 480 + 960, 3)
    assert (picture[:3, 3:6] == (200, 10, 20)).all()
    assert picture[:270, :480].any(axis=-1).sum() == 9
    assert (picture[537:, 477:480] == 255).all()
    assert picture[270:, :480].any(axis=-1).sum() == 9
    assert (picture[:, 480:] == 77).all()
    assert not panels(frame, None, np.zeros((540, 960, 3), np.uint8))[270:].any()


@pytest.mark.parametrize(("count", "tiles"), [(1, 1), (5, 5), (12, 12), (251, 12)])
def test_a_sheet_goes_from_the_first_to_the_last(count, tiles):
    shown = [(str(number), np.full((54, 108, 3), number, np.uint8)) for number in range(count)]
    sheet = contact_sheet(shown)
    rows = -(-tiles // COLUMNS)
    assert sheet.shape[0] == GAP + rows * (270 + LABEL_HEIGHT + GAP)
    assert TILES == 12
    assert (sheet[GAP + LABEL_HEIGHT : GAP + LABEL_HEIGHT + 270, GAP : GAP + TILE_WIDTH] == 0).all()
    row, column = divmod(tiles - 1, COLUMNS)
    top, left = GAP + row * (270 + LABEL_HEIGHT + GAP) + LABEL_HEIGHT, GAP + column * (TILE_WIDTH + GAP)
    assert (sheet[top : top + 270, left : left + TILE_WIDTH] == count - 1).all()


# ---------------------------------------------------------------------- how it ends


@pytest.fixture
def drawn(monkeypatch):
    """A stand-in for a task; its three moments need no OpenGL, and something may happen at each, ``at_moment``."""
    asked = []
    task = SimpleNamespace(
        spec=SimpleNamespace(task="toy", action_cycle_time_s=0.5),
        close=lambda: asked.append("close"),
        asked=asked,
        at_moment={},
    )

    def moments(task, seed):
        picture = np.zeros((9, 16, 3), np.uint8)
        for number in range(3):
            task.at_moment.get(number, lambda: None)()
            yield preview.Moment(0.5 * number, frame=picture, mask=None, room=picture, at_goal=np.bool_(number == 2))

    monkeypatch.setattr(preview, "_task", lambda options: task)
    monkeypatch.setattr(preview, "moments", moments)
    return task


def press_ctrl_c():
    os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize("output", ["full", "closed"])
def test_it_is_drawn_though_nobody_can_read_where(drawn, tmp_path, monkeypatch, output):
    with unusable_output(output) as stdout:
        monkeypatch.setattr("sys.stdout", stdout)
        assert run(tmp_path, task="toy") == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["toy.mp4", "toy.png"]


@pytest.mark.parametrize("number", [0, 2])
def test_ctrl_c_is_a_line_and_leaves_nothing(drawn, tmp_path, capsys, number):
    drawn.at_moment[number] = press_ctrl_c
    with StopSignals() as stop:
        assert run(tmp_path, task="toy", stop=stop) == 130
    assert capsys.readouterr() == ("interrupted before anything was written\n", "")
    assert drawn.asked == ["close"]
    assert not list(tmp_path.iterdir())


def test_ctrl_c_lets_what_is_being_written_be_completed(drawn, tmp_path, capsys, monkeypatch):
    def write(*arguments):
        press_ctrl_c()
        write_video(*arguments)

    monkeypatch.setattr(preview, "write_video", write)
    with StopSignals() as stop:
        assert run(tmp_path, task="toy", stop=stop) == 130
    assert capsys.readouterr().out.split() == [str(tmp_path / "toy.png"), str(tmp_path / "toy.mp4")]
    assert len(video_frames(tmp_path / "toy.mp4")[0]) == 3


def test_ctrl_c_is_heard_from_the_start(tmp_path, capsys):
    with StopSignals() as stop:
        press_ctrl_c()
        assert run(tmp_path, task="nobody", stop=stop) == 130


# ---------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("arguments", "task", "match"),
    [
        ([], "dot_reacher", "--task dot_reacher: it is no simulated robot: expected one such as ur5_visual_reacher"),
        ([], "nobody", "'nobody'"),
        (["--set", "run.id=x"], FRANKA, "--set run.id=x: only settings of the task count here"),
        (["--set", "task.bag_radius=0"], FRANKA, "bag_radius"),
        (["--preset", "thesis"], FRANKA, "preset = 'thesis'"),
        (["--set", "task.preset=thesis"], FRANKA, "preset = 'thesis'"),
        (["--preset", "thesis", "--set", "task.preset=[1]"], FRANKA, "preset = '[1]'"),
    ],
)
def test_what_cannot_be_drawn_is_named(arguments, task, match, tmp_path, capsys):
    assert run(tmp_path, *arguments, task=task) == 1
    error = capsys.readouterr().err
    assert error.startswith("services.robot_bridge: error: ")
    assert match in error
    assert not list(tmp_path.iterdir())


def test_an_empty_text_is_no_folder(capsys):
    with pytest.raises(SystemExit):
        run("", task="nobody")
    assert "--preview: expected a folder, got an empty text" in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_to_is_named(opengl, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert run(tmp_path / "file", *SHORT, "--set", "task.threshold=0") == 1
    assert f"--preview {tmp_path / 'file'}: cannot be written to" in capsys.readouterr().err


def test_without_opengl_the_error_says_what_to_do(tmp_path, capsys, monkeypatch):
    def refuse(*_, **__):
        raise ServiceError("this task has a camera, and no OpenGL backend works here")

    monkeypatch.setattr(preview, "OffscreenCamera", refuse)
    monkeypatch.setattr("services.robot_bridge.cameras.simulated.OffscreenCamera", refuse)
    assert run(tmp_path) == 1
    assert "no OpenGL backend works here" in capsys.readouterr().err


@pytest.mark.parametrize("argument", ["--preview", "--preview=x", "--task", "--task=x"])
def test_the_bridges_command_line_knows_who_wants_a_preview(argument, monkeypatch):
    def main(arguments, stop):
        press_ctrl_c()  # held back by now
        return 7 if stop.asked and arguments == ["first", argument] else 1

    monkeypatch.setattr(preview, "main", main)
    with pytest.raises(SystemExit) as ended:
        __main__.main(["first", argument])
    assert ended.value.code == 7


def test_help_names_both_options_and_gives_an_example(capsys):
    with pytest.raises(SystemExit) as ended:
        preview.main(["--help"], StopSignals())
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert all(part in text for part in ("--task T", "--preview DIR", "example:"))
