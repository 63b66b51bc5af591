"""What the bridge's command line builds: the task it names, and a run that goes on where the last bridge was."""

import json

import pytest

from common import topics
from common.config import build_config
from common.errors import CameraError, ConfigError
from common.transport import InMemoryNetwork
from services.robot_bridge.config import RobotBridgeConfig
from services.robot_bridge.serve import serve
from tests.services.builders import EventClock, SoloService
from tests.services.robot_bridge.cameras.pictures import SIZE, write_video


def config_of(directory, **sections):
    tables = {
        "run": {"id": "test", "directory": str(directory)},
        "transport": {"listen_real_time": "tcp/127.0.0.1:1", "listen_bulk": "tcp/127.0.0.1:2"},
        "task": {"name": "dot_reacher"},
        **sections,
    }
    return build_config(RobotBridgeConfig, tables, "test.toml")


def write_part(directory, incarnation, counters):
    part = {"service": "robot_bridge", "incarnation": incarnation, "counters": counters}
    (directory / "parts").mkdir(exist_ok=True)
    (directory / "parts" / f"robot_bridge-{incarnation}.json").write_text(json.dumps(part))


def serve_in(directory, **sections):
    """Run a bridge that has nothing left to do; return its service."""
    service = SoloService(topics.ROBOT_BRIDGE, InMemoryNetwork(), directory, EventClock())
    serve(service, config_of(directory, **sections))
    service.closing.close()
    return service


def test_a_restarted_bridge_goes_on_from_what_the_last_one_wrote(tmp_path):
    for incarnation, steps in ((10, 7), (11, 40)):
        counters = {"steps": steps, "acted_steps": steps - 5, "episodes": 2, "attempts": 4, "produced": 9}
        write_part(tmp_path, incarnation, counters)
    service = serve_in(tmp_path, robot_bridge={"steps": 40})
    counters = service.counters()
    assert [counters[name] for name in ("steps", "acted_steps", "episodes", "attempts")] == [40, 35, 2, 4]
    assert counters["produced"] == 0


def test_a_bridge_that_never_came_to_count_does_not_set_the_run_back(tmp_path):
    write_part(tmp_path, 10, {"steps": 40, "acted_steps": 40, "episodes": 1, "attempts": 3})
    write_part(tmp_path, 11, {})  # died before it had a task; or this bridge's own, written by its heartbeat
    assert serve_in(tmp_path, robot_bridge={"steps": 40}).counters()["steps"] == 40


def test_a_bridge_after_one_whose_part_is_empty_goes_on_from_the_one_before_and_says_so(tmp_path, caplog):
    write_part(tmp_path, 10, {"steps": 40, "acted_steps": 40, "episodes": 1, "attempts": 3})
    empty = tmp_path / "parts" / "robot_bridge-11.json"
    empty.touch()
    assert serve_in(tmp_path, robot_bridge={"steps": 40}).counters()["steps"] == 40
    assert f"{empty} is empty or damaged: what that robot_bridge of this run has counted is unknown" in caplog.text


def test_the_task_is_built_as_configured(tmp_path):
    write_part(tmp_path, 10, {"steps": 1})
    service = serve_in(
        tmp_path,
        task={"name": "dot_reacher", "preset": "thesis", "time_limit": 33},
        robot_bridge={"steps": 1, "pacing": "lockstep"},
    )
    assert service.details()["preset"] == "thesis"
    assert service.details()["pacing"] == "lockstep"


@pytest.mark.parametrize(
    ("sections", "match"),
    [
        ({"task": {"name": "dot_reachr"}}, r"dot_reachr.*expected one of.*dot_reacher"),
        ({"task": {"name": "dot_reacher", "preset": "hard"}}, r"preset = 'hard'.*demo, thesis"),
        ({"task": {"name": "dot_reacher", "time_limt": 3}}, r"time_limt.*did you mean 'time_limit'"),
        ({"task": {"name": "dot_reacher", "time_limit": 0}}, r"time_limit = 0.*at least 1"),
        ({"tasks": {"mine": "nowhere:Task"}, "task": {"name": "mine"}}, r"nowhere:Task.*module:Class"),
        ({"tasks": {"mine": "json:JSONDecoder"}, "task": {"name": "mine"}}, r"expected a subclass of Task"),
    ],
)
def test_a_task_that_cannot_be_built_is_a_config_error(tmp_path, sections, match):
    with pytest.raises(ConfigError, match=match):
        serve_in(tmp_path, **sections)


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"pacing": "fast"}, r"pacing = 'fast'.*realtime, lockstep"),
        ({"on_missing_action": "guess"}, r"on_missing_action = 'guess'.*hold, zero, wait"),
        ({"stop_after": 0}, r"stop_after = 0.*from 0.01 to 60"),
        ({"steps": 2.5}, r"steps = 2.5.*a whole number"),
        ({"step": 3}, r"unknown key 'step'.*did you mean 'steps'"),
    ],
)
def test_a_wrong_setting_is_named_with_what_was_expected(tmp_path, settings, match):
    with pytest.raises(ConfigError, match=match):
        config_of(tmp_path, robot_bridge=settings)


@pytest.mark.parametrize("name", [{}, {"name": ""}])
def test_settings_of_a_camera_that_is_not_named_are_refused(tmp_path, name):
    with pytest.raises(ConfigError, match=r"\[camera\]: file, rate: expected camera.name as well"):
        config_of(tmp_path, camera={"rate": 30, "file": "lab.mp4", **name})


def test_a_task_sees_through_the_camera_that_is_configured(tmp_path):
    write_part(tmp_path, 10, {"steps": 1})
    video = write_video(tmp_path / "video.avi", 5)
    service = serve_in(
        tmp_path,
        task={"name": "noise_frames", "height": SIZE.height, "width": SIZE.width},
        camera={"name": "recorded", "file": str(video)},
        robot_bridge={"steps": 1},
    )
    assert service.details()["task"] == "noise_frames"


@pytest.mark.parametrize(
    ("sections", "match"),
    [
        ({"camera": {"name": "webcam"}}, r"\[camera\] name = 'webcam': expected one of opencv, recorded"),
        ({"camera": {"name": "recorded"}}, "file is missing"),
        ({"camera": {"name": "recorded", "file": "nowhere.avi"}}, "there is no such file"),
        ({"camera": {"name": "opencv", "device": 255}}, "camera 255 does not exist"),
        ({"cameras": {"mine": "json:JSONDecoder"}, "camera": {"name": "mine"}}, "expected a subclass of Camera"),
        ({"camera": {"name": "opencv"}, "robot_bridge": {"pacing": "lockstep"}}, "pacing = realtime, got lockstep"),
        ({"camera": {"name": "opencv"}, "task": {"name": "dot_reacher"}}, "dot_reacher has no camera"),
        ({"camera": {"name": "opencv"}, "task": {"name": "visual_dot_reacher"}}, "draws its frames itself"),
    ],
)
def test_a_camera_that_cannot_be_used_is_named(tmp_path, sections, match):
    with pytest.raises((ConfigError, CameraError), match=match):
        serve_in(tmp_path, **{"task": {"name": "noise_frames"}, **sections})
