"""``python -m deploy.latency``: numbers computed by hand, what is left out, what it says when there is nothing."""

from __future__ import annotations

import cv2
import pytest

from common.errors import ConfigError
from deploy import latency
from deploy.action_age import ActionAges
from tests.deploy.hand_made_record import write_actions, write_ages
from tests.deploy.test_summary import RUN

ROW = (1, 2, 3, 4, 5, 6, 7, 0.5)


def test_quantiles_of_each_part_and_of_their_sum(tmp_path):
    # Uplinks of 0 to 100 ms, all else constant: the age is 25 ms more.
    write_ages(tmp_path, [(1, 2, uplink, 4, 5, 6, 7, 0.5) for uplink in range(101)])
    quantiles = ActionAges.read(tmp_path).quantiles_ms()
    assert list(quantiles) == ["camera", "encode", "uplink", "queue", "inference", "downlink", "apply", "age"]
    assert quantiles["uplink"] == {"p50": 50, "p90": 90, "p99": 99, "max": 100}
    assert quantiles["apply"] == {"p50": 7, "p90": 7, "p99": 7, "max": 7}
    assert quantiles["age"] == {"p50": 75, "p90": 115, "p99": 124, "max": 125}


def test_a_task_without_camera_has_no_camera_part(tmp_path):
    write_ages(tmp_path, [(None, *ROW[1:])] * 3)
    ages = ActionAges.read(tmp_path)
    assert "camera" not in ages.parts
    assert ages.age.tolist() == [27, 27, 27]


def test_what_cannot_be_split_is_left_out_and_counted(tmp_path, capsys):
    write_ages(
        tmp_path,
        [
            ROW,
            (1, 2, 3, 4, 5, 6, None, 0.5),  # not applied
            (1, 2, None, 4, 5, None, 7, None),  # before the offset was known
            (1, 2, -2000, 4, 5, 2009, 7, 0.5),  # the clock had jumped by two seconds
            (1, 2, 9, 4, 5, -0.5, 7, 0.5),  # shorter than nothing, by no more than the offset's error
        ],
    )
    with (tmp_path / "actions.csv").open("a", encoding="utf-8") as file:
        file.write("100,1,2000\n")
    ages = ActionAges.read(tmp_path)
    assert ages.parts["uplink"].tolist() == [3, 9]
    assert (ages.answered, ages.not_applied, ages.unknown, ages.contradicted, ages.unreadable) == (5, 1, 1, 1, 1)
    assert latency.main([str(tmp_path)]) == 0
    assert (
        "2 applied actions; left out: 1 answered but not applied, 1 before the clocks' offset was known, "
        "1 across a clock's jump, 1 unreadable"
    ) in capsys.readouterr().out


def test_runs_stand_side_by_side_with_their_names_and_the_clocks_error(tmp_path, capsys):
    near, far = tmp_path / "near", tmp_path / "far"
    for folder, way in ((near, 5), (far, 25)):
        folder.mkdir()
        write_ages(folder, [(1, 2, way, 4, 5, way, 7, way / 10)] * 5)
    RUN.write(far)
    picture = tmp_path / "both.png"
    assert latency.main([str(near), str(far), "--picture", str(picture)]) == 0
    said = capsys.readouterr().out
    assert f"{far}: remote_only, network outage, dot_reacher" in said
    assert "uplink          25.000    25.000    25.000    25.000" in said
    assert "age             69.000" in said
    assert "uplink and downlink may be off by 2.500 ms (p50; at most 2.500 ms)" in said
    assert said.splitlines()[-1] == str(picture)
    height, width, _ = cv2.imread(str(picture)).shape
    assert min(height, width) > 400


def test_the_picture_is_in_the_first_run_s_folder_unless_told(tmp_path):
    write_ages(tmp_path, [ROW])
    assert latency.main([str(tmp_path)]) == 0
    assert (tmp_path / "latency.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("row", [(0,) * 8, (None, 0, -0.2, 0, 0, 0.1, 0, 0.5)], ids=["no time at all", "below zero"])
def test_a_picture_of_nothing_much_can_be_drawn(tmp_path, row):
    write_ages(tmp_path, [row] * 3)
    assert latency.main([str(tmp_path)]) == 0
    assert (tmp_path / "latency.png").exists()


def test_a_run_in_which_nothing_was_applied_is_an_error_that_says_what_there_is(tmp_path, capsys):
    write_ages(tmp_path, [(1, 2, 3, 4, 5, 6, None, 0.5), (1, 2, None, 4, 5, None, 7, None)])
    assert latency.main([str(tmp_path)]) == 1
    assert "got 2 answers, 1 of them applied, 0 of these with an offset" in capsys.readouterr().err


def test_a_record_of_an_earlier_release_is_an_error_that_says_so(tmp_path):
    write_actions(tmp_path, [(1.0, 1.5)])
    with pytest.raises(ConfigError, match=r"expected the columns camera_us, .*written by an earlier release"):
        ActionAges.read(tmp_path)


@pytest.mark.parametrize("make", [lambda folder: None, lambda folder: folder.mkdir()], ids=["no folder", "empty"])
def test_no_run_is_an_error(tmp_path, capsys, make):
    make(tmp_path / "run")
    assert latency.main([str(tmp_path / "run")]) == 1
    assert "deploy.latency: error: " in capsys.readouterr().err


def test_the_strong_computer_s_side_shows_what_was_fetched_from_the_robot_s(tmp_path, capsys):
    RUN.write(tmp_path)
    copy = tmp_path / "hosts" / "local"
    copy.mkdir(parents=True)
    write_ages(copy, [ROW] * 3)
    assert latency.main([str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert f"{tmp_path}: remote_only, network outage, dot_reacher" in said
    assert f"3 applied actions; as far as they were copied to {copy}\n" in said
    assert (tmp_path / "latency.png").exists()


def test_answers_that_are_on_the_other_computer_only_are_said_to_be_there(tmp_path, capsys):
    RUN.write(tmp_path)
    (tmp_path / "config").mkdir()
    (tmp_path / "config" / "learner.toml").touch()
    assert latency.main([str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert f"{tmp_path / 'actions.csv'} is missing: the robot_bridge ran on the computer 'local'; copy" in said
    (tmp_path / "config" / "robot_bridge.toml").touch()
    assert latency.main([str(tmp_path)]) == 1
    assert "actions.csv is missing: expected the run directory of a run in which actions" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["x.foo", "x", "x.svg"])
def test_a_picture_s_name_tells_its_format(tmp_path, capsys, name):
    write_ages(tmp_path, [ROW])
    assert latency.main([str(tmp_path), "--picture", str(tmp_path / name)]) == 1
    assert f"--picture {tmp_path / name}: expected a name that ends in .png" in capsys.readouterr().err
    assert not (tmp_path / name).exists()


def test_a_picture_that_cannot_be_written_is_an_error(tmp_path, capsys):
    write_ages(tmp_path, [ROW])
    assert latency.main([str(tmp_path), "--picture", str(tmp_path / "nowhere" / "x.png")]) == 1
    assert "cannot be written: No such file or directory" in capsys.readouterr().err
