"""What every camera in the table has to be."""

import numpy as np
import pytest

from common.clock import FakeClock, SystemClock
from common.errors import CameraError, ConfigError
from services.robot_bridge.cameras import CAMERAS, Camera, PictureSize, open_camera
from tests.helpers import eventually
from tests.services.robot_bridge.cameras.pictures import SIZE, MjpegServer, is_red_below, number_of, write_video


class NetworkCamera:
    """The OpenCV camera before a server that sends by itself."""

    def __init__(self, _) -> None:
        self.clock = SystemClock()
        self._servers = []

    def settings(self, size=SIZE):
        self._servers.append(MjpegServer(size=size))
        return {"url": self._servers[-1].url}

    def let_time_pass(self) -> None:
        pass

    def close(self) -> None:
        for server in self._servers:
            server.close()


class Recording:
    """The camera that shows a video, by a clock that goes on when the test looks."""

    def __init__(self, directory) -> None:
        self.clock = FakeClock()
        self._directory = directory

    def settings(self, size=SIZE):
        return {"file": str(write_video(self._directory / "video.avi", 200, size=size))}

    def let_time_pass(self) -> None:
        self.clock.advance(1 / 30)

    def close(self) -> None:
        pass


SCENES = {"opencv": NetworkCamera, "recorded": Recording}


@pytest.fixture(params=sorted(CAMERAS))
def scene(request, tmp_path):
    """Each camera of the table in front of numbered pictures."""
    scene = SCENES[request.param](tmp_path)
    scene.name, cameras = request.param, []

    def opened(settings=None, **more) -> Camera:
        values = {**(settings or scene.settings()), **more}
        cameras.append(open_camera(scene.name, values, size=SIZE, clock=scene.clock))
        return cameras[-1]

    scene.open = opened
    yield scene
    for camera in cameras:
        camera.close()
    scene.close()


def collect(scene, camera, count):
    """Take frames until there are ``count``."""
    frames = []

    def enough():
        scene.let_time_pass()
        frames.extend(camera.take())
        return len(frames) >= count

    eventually(enough, f"frame {count}")
    return frames


def test_the_first_frame_is_there_when_the_camera_is_open(scene):
    begun_ns = scene.clock.now_ns()
    camera = scene.open()
    assert camera.newest_capture_ns >= begun_ns
    assert camera.take()[0].frame_id == 0
    assert camera.lost is None
    assert camera.losses == camera.dropped == 0


def test_frames_have_the_tasks_size_and_their_colours(scene):
    for frame in collect(scene, scene.open(), 5):
        assert (frame.frame.dtype, frame.frame.shape) == (np.uint8, (SIZE.height, SIZE.width, 3))
        assert is_red_below(frame.frame)


def test_frames_come_in_order_numbered_from_zero_and_none_is_missing(scene):
    frames = collect(scene, scene.open(capacity=1000), 40)
    assert [frame.frame_id for frame in frames] == list(range(len(frames)))
    first = number_of(frames[0].frame)
    assert [number_of(frame.frame) for frame in frames] == list(range(first, first + len(frames)))


def test_capture_times_go_by_the_clock_and_never_back(scene):
    begun_ns = scene.clock.now_ns()
    frames = collect(scene, scene.open(), 20)
    times = [begun_ns, *(frame.capture_ns for frame in frames), scene.clock.now_ns()]
    assert times == sorted(times)


def test_who_does_not_look_finds_the_newest_frames_and_the_others_are_counted(scene):
    camera = scene.open(capacity=4)

    def dropped_some():
        scene.let_time_pass()
        return camera.dropped >= 3

    eventually(dropped_some, "a dropped frame")
    before = camera.dropped
    frames = camera.take()
    assert len(frames) == 4
    assert before <= frames[0].frame_id <= camera.dropped
    assert np.diff([frame.frame_id for frame in frames]).tolist() == [1, 1, 1]


def test_the_newest_frames_age_is_known_without_taking_it(scene):
    camera = scene.open()
    first_ns = camera.newest_capture_ns
    eventually(lambda: scene.let_time_pass() or camera.newest_capture_ns > first_ns, "a newer frame")
    assert camera.newest_capture_ns <= scene.clock.now_ns()


def test_nobody_can_change_a_frame_that_others_see(scene):
    (frame, *_) = collect(scene, scene.open(), 1)
    with pytest.raises(ValueError, match="read-only"):
        frame.frame[:] = 0


def test_a_closed_camera_gives_nothing_more_and_may_be_closed_again(scene):
    camera = scene.open()
    camera.close()
    camera.take()
    newest_ns = camera.newest_capture_ns
    for _ in range(3):
        scene.let_time_pass()
    camera.close()
    assert camera.take() == []
    assert camera.newest_capture_ns == newest_ns


def test_pictures_of_another_size_are_refused_unless_they_are_to_be_scaled(scene):
    settings = scene.settings(PictureSize(height=48, width=256))
    with pytest.raises(CameraError, match=r"256x48 pixels: expected 128x24, the task's; .*camera.resize = true"):
        scene.open(settings)
    (frame, *_) = collect(scene, scene.open(settings, resize=True), 1)
    assert frame.frame.shape == (SIZE.height, SIZE.width, 3)
    assert is_red_below(frame.frame)


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"capacity": 0}, "capacity = 0: expected a value from 1 to 1000"),
        ({"rate": float("nan")}, "rate = nan: expected a finite number"),
        ({"resiz": True}, "unknown key 'resiz'; did you mean 'resize'"),
    ],
)
def test_a_wrong_setting_is_named_with_its_value_and_what_was_expected(scene, wrong, match):
    with pytest.raises(ConfigError, match=match):
        scene.open(**wrong)


def test_every_camera_of_the_table_has_a_scene():
    assert sorted(SCENES) == sorted(CAMERAS)


def test_an_unknown_kind_is_named_with_the_known_ones():
    with pytest.raises(ConfigError, match=r"\[camera\] name = 'webcam': expected one of opencv, recorded"):
        open_camera("webcam", size=SIZE, clock=FakeClock())


def test_a_row_in_the_configuration_adds_a_kind(tmp_path):
    rows = {"mine": CAMERAS["recorded"]}
    file = str(write_video(tmp_path / "video.avi", 3))
    assert open_camera("mine", {"file": file}, rows, size=SIZE, clock=FakeClock()).take()


@pytest.mark.parametrize("target", ["nowhere:Camera", "services.robot_bridge.cameras:Nobody", "os:path", 3])
def test_a_row_that_leads_to_no_camera_is_named(target):
    with pytest.raises(ConfigError, match=r"\[cameras\] mine = .*: expected"):
        open_camera("mine", rows={"mine": target}, size=SIZE, clock=FakeClock())
