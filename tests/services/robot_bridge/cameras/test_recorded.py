"""The recorded camera: what is seen when follows from the clock."""

import pytest

from common.clock import FakeClock
from common.errors import CameraError
from services.robot_bridge.cameras import open_camera
from tests.services.robot_bridge.cameras.pictures import SIZE, number_of, write_video


def opened(tmp_path, clock, count=10, rate=30.0, **settings):
    file = str(write_video(tmp_path / "video.avi", count, rate))
    return open_camera("recorded", {"file": file, **settings}, size=SIZE, clock=clock)


def numbers(camera):
    return [number_of(frame.frame) for frame in camera.take()]


def test_pictures_come_at_the_rate_of_the_file(tmp_path):
    clock = FakeClock()
    camera = opened(tmp_path, clock, rate=25.0)
    assert numbers(camera) == [0]
    clock.advance(0.039)
    assert numbers(camera) == []
    clock.advance(0.001)
    assert numbers(camera) == [1]
    clock.advance(0.12)
    frames = camera.take()
    assert [number_of(frame.frame) for frame in frames] == [2, 3, 4]
    assert [frame.capture_ns - 1_000_000_000 for frame in frames] == [80_000_000, 120_000_000, 160_000_000]


def test_another_rate_can_be_set(tmp_path):
    clock = FakeClock()
    camera = opened(tmp_path, clock, rate=25.0)
    slow = open_camera("recorded", {"file": str(tmp_path / "video.avi"), "rate": 2.0}, size=SIZE, clock=clock)
    clock.advance(1.0)
    assert len(camera.take()) == 8
    assert numbers(slow) == [0, 1, 2]


def test_a_video_that_is_cut_short_says_so(tmp_path, caplog):
    whole = write_video(tmp_path / "video.avi", 40).read_bytes()
    (tmp_path / "cut.avi").write_bytes(whole[: len(whole) // 2])
    for name in ("video.avi", "cut.avi"):
        open_camera("recorded", {"file": str(tmp_path / name)}, size=SIZE, clock=FakeClock())
    (told,) = [record.message for record in caplog.records]
    assert "cut.avi" in told
    assert "of 40 pictures" in told


def test_it_begins_anew_at_its_end(tmp_path):
    clock = FakeClock()
    camera = opened(tmp_path, clock, count=3, rate=10.0)
    clock.advance(0.65)
    frames = camera.take()
    assert [number_of(frame.frame) for frame in frames] == [0, 1, 2, 0, 1, 2, 0]
    assert [frame.frame_id for frame in frames] == list(range(7))
    assert camera.lost is None


def test_or_it_is_lost_there_as_told_and_says_so_once(tmp_path, caplog):
    clock = FakeClock()
    camera = opened(tmp_path, clock, count=3, rate=10.0, loop=False)
    clock.advance(0.29)
    assert camera.lost is None
    clock.advance(0.01)
    assert "has ended; camera.loop = true begins it anew" in camera.lost
    assert camera.losses == 1
    assert numbers(camera) == [0, 1, 2]
    clock.advance(5.0)
    assert camera.take() == []
    assert camera.newest_capture_ns == 1_200_000_000  # it only grows older
    assert [record.message for record in caplog.records] == [camera.lost]


def test_after_a_long_time_without_a_look_the_newest_pictures_are_there(tmp_path):
    clock = FakeClock()
    camera = opened(tmp_path, clock, count=10, rate=10.0, capacity=2)
    clock.advance(3600.05)
    frames = camera.take()
    assert [frame.frame_id for frame in frames] == [35_999, 36_000]
    assert [number_of(frame.frame) for frame in frames] == [9, 0]
    assert camera.dropped == 35_999


@pytest.mark.parametrize(
    ("content", "match"),
    [(None, "there is no such file; expected a video"), (b"no video", "expected a video that OpenCV can read")],
)
def test_what_is_no_video_is_named(tmp_path, content, match):
    file = tmp_path / "video.avi"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(CameraError, match=f"recording {file}: {match}"):
        open_camera("recorded", {"file": str(file)}, size=SIZE, clock=FakeClock())


def test_a_folder_is_no_video(tmp_path):
    with pytest.raises(CameraError, match=f"recording {tmp_path}: is a folder; expected a video"):
        open_camera("recorded", {"file": str(tmp_path)}, size=SIZE, clock=FakeClock())


def test_no_name_of_a_file_is_no_folder():
    with pytest.raises(CameraError, match="there is no such file"):
        open_camera("recorded", {"file": ""}, size=SIZE, clock=FakeClock())


def test_a_recording_that_does_not_fit_the_memory_is_refused(tmp_path):
    # 1 MB holds 108 pictures of 128 x 24 x 3 bytes.
    with pytest.raises(CameraError, match=r"is longer than the 4 s that fit into camera.memory_mb = 1"):
        opened(tmp_path, FakeClock(), count=109, memory_mb=1.0)
    assert opened(tmp_path, FakeClock(), count=108, memory_mb=1.0).take()
