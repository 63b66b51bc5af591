"""Which task is looked at, and what is refused before any work."""

import json
from pathlib import Path

import numpy as np
import pytest

from common.errors import ConfigError
from experiments.target_hits.choice import check_limits, choice_from, choose_task, record_settings, source_files
from tests.experiments.target_hits.fake_tasks import MODULE


def test_the_thesis_preset_is_taken_where_there_is_one_and_nobody_says_otherwise():
    assert choose_task("dot_reacher").preset == "thesis"
    assert choose_task("dot_reacher", "demo").preset == "demo"


def test_settings_of_the_task_reach_it_in_any_process():
    choice = choose_task(f"line={MODULE}:Line", overrides=["task.reset_steps=7"])
    settings = json.loads(json.dumps(record_settings([choice], steps=500)))
    task = choice_from(settings, "line").build(np.random.default_rng(0))
    assert (task.spec.task, task.spec.preset, task.spec.reset_steps) == ("line", "thesis", 7)


@pytest.mark.parametrize(
    ("change", "name"), [({"preset": "demo"}, "preset"), ({"overrides": ["task.farthest=8"]}, "farthest")]
)
def test_what_changes_the_numbers_is_in_the_record(change, name):
    settings = [record_settings([choose_task(f"line={MODULE}:Line", **options)], steps=500) for options in ({}, change)]
    assert settings[0] != settings[1]
    assert name in str(settings[1])


@pytest.mark.parametrize(
    ("task", "options", "match"),
    [
        ("noise_frames", {}, "--task noise_frames: it has no goal to hit"),
        ("dot", {}, r"'dot'.*expected one of"),
        ("dot_reacher", {"preset": "extreme"}, r"preset = 'extreme'.*demo, thesis"),
        ("dot_reacher", {"overrides": ["task.target_sped=1"]}, "did you mean 'target_speed'"),
        ("dot_reacher", {"overrides": ["algorithm.batch_size=1"]}, r"expected task\.key=value"),
        ("dot_reacher", {"overrides": ["task.time_limit=5"]}, "given by --limits"),
        ("mine=nowhere:Task", {}, "expected module:Class that imports"),
    ],
)
def test_what_cannot_be_counted_is_refused_in_words(task, options, match):
    with pytest.raises(ConfigError, match=match):
        choose_task(task, **options)


def test_limits_are_taken_once_each_in_order():
    assert check_limits([50, 10, 50]) == (10, 50)
    with pytest.raises(ConfigError, match="--limits 0: expected at least 1 step"):
        check_limits([10, 0])


def test_a_robots_task_is_defined_by_its_scene_its_robot_and_its_camera_too():
    task = choose_task("ur5_visual_reacher_min_time").build(np.random.default_rng(0))
    names = {Path(file).name for file in source_files(type(task))}
    assert {"ur5_visual_reacher.py", "robot_task.py", "ur5.py", "ur5_scene.py", "velocity_arm.py"} <= names
    assert {"sensed_world.py", "simulated.py", "rendering.py", "target_detection.py"} <= names
    assert not {"bridge.py", "dot_reacher.py", "numeric.py"} & names


def test_a_task_from_elsewhere_is_defined_by_its_own_file():
    line = choose_task(f"line={MODULE}:Line").build(np.random.default_rng(0))
    names = [Path(file).name for file in source_files(type(line))]
    assert "fake_tasks.py" in names
    assert not {"ur5.py", "dot_reacher.py"} & set(names)
