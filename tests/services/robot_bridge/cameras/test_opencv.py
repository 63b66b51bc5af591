"""The OpenCV camera when things go wrong: what it says, and that it comes back by itself."""

import re
import socket
import threading

import pytest

from common.clock import SystemClock
from common.errors import CameraError, ConfigError
from services.robot_bridge.cameras import PictureSize, open_camera
from tests.helpers import eventually, free_port
from tests.services.robot_bridge.cameras.pictures import SIZE, MjpegServer, number_of

QUICK = {"read_timeout": 0.3, "reconnect_after": 0.02, "capacity": 1000}
"""A busy computer may lose the camera more often than a test wants: none relies on that it does not."""


@pytest.fixture
def opened():
    """Open cameras that are closed at the end."""
    cameras = []

    def opened(**settings):
        cameras.append(open_camera("opencv", {**QUICK, **settings}, size=SIZE, clock=SystemClock()))
        return cameras[-1]

    yield opened
    for camera in cameras:
        camera.close()


@pytest.fixture
def server():
    """A camera server, closed at the end if it is still there."""
    server = MjpegServer()
    yield server
    server.close()


def comes_back(camera):
    """Wait until new frames come."""
    lost_ns = camera.newest_capture_ns
    eventually(lambda: camera.newest_capture_ns > lost_ns and camera.lost is None, "the camera")


def test_a_stream_that_stalls_is_lost_and_comes_back_with_the_next_numbers(opened, server):
    camera = opened(url=server.url)
    server.pause()
    eventually(lambda: camera.lost, "the loss")
    before = camera.take()
    assert f"camera {server.url}" in camera.lost
    # Frames' age goes on meanwhile: nothing new is made up.
    assert camera.newest_capture_ns == before[-1].capture_ns
    assert camera.take() == []
    server.resume()
    comes_back(camera)
    after = camera.take()
    assert after[0].frame_id == before[-1].frame_id + 1
    assert number_of(after[0].frame) > number_of(before[-1].frame)
    assert camera.losses >= 1


def test_what_cannot_be_decoded_in_a_stream_is_left_out(opened, server, caplog):
    server.undecodable = lambda number: number % 20 in (5, 6)
    camera, frames = opened(url=server.url, read_timeout=10.0), []
    eventually(lambda: frames.extend(camera.take()) or len(frames) >= 60, "frame 60")
    assert (camera.losses, camera.lost) == (0, None)
    assert camera.dropped >= 4
    assert [frame.frame_id for frame in frames] == list(range(len(frames)))
    assert not any(server.undecodable(number_of(frame.frame)) for frame in frames)
    told = [record.message for record in caplog.records if "cannot be decoded" in record.message]
    assert 1 <= len(told) <= 2


def test_a_frames_time_is_between_when_it_was_sent_and_when_it_is_taken(opened, server):
    camera, frames = opened(url=server.url), []
    eventually(lambda: frames.extend(camera.take()) or len(frames) >= 20, "frame 20")
    taken_ns = SystemClock().now_ns()
    for frame in frames:
        assert server.sent_ns[number_of(frame.frame)] <= frame.capture_ns <= taken_ns


def test_a_server_that_is_gone_is_named_and_found_again_when_it_is_back(opened, caplog):
    first = MjpegServer()
    camera = opened(url=first.url)
    first.close()
    eventually(lambda: camera.lost and "cannot be reached" in camera.lost, "the loss")
    assert f"127.0.0.1:{first.port}" in camera.lost
    second = MjpegServer(first.port)
    comes_back(camera)
    said = [record.message for record in caplog.records if "127.0.0.1" in record.message]
    # Which of them: whether the end of the connection or of the wait was seen first.
    reason = r"(the stream has ended, or what came is no picture|expected a frame within 0.3 s, none came)"
    assert re.search(rf"is lost: {reason}; trying to open it every 0.02 s", said[0])
    assert said[1].endswith("is back")  # of the attempts between, nothing is said
    second.close()


def test_a_server_that_is_back_with_another_size_says_so_until_it_has_the_right_one(opened):
    servers = [MjpegServer()]
    camera = opened(url=servers[0].url)
    for size, holds in (
        (PictureSize(48, 128), lambda: camera.lost and "pictures of 128x48 pixels: expected 128x24" in camera.lost),
        (SIZE, lambda: camera.lost is None),
    ):
        servers[-1].close()
        servers.append(MjpegServer(servers[0].port, size))
        eventually(holds, "it")
    assert all(frame.frame.shape[:2] == (SIZE.height, SIZE.width) for frame in camera.take())
    servers[-1].close()


def test_closing_ends_the_thread_even_while_nothing_comes(opened, server):
    camera = opened(url=server.url)
    server.pause()
    camera.close()
    assert not camera._thread.is_alive()


def test_closing_ends_a_lost_camera_that_waits_for_its_next_attempt(opened):
    server = MjpegServer()
    camera = opened(url=server.url, reconnect_after=60.0)
    server.close()
    eventually(lambda: camera.lost and "cannot be reached" in camera.lost, "the loss")
    camera.close()
    assert not camera._thread.is_alive()


def test_an_address_where_nobody_answers_is_named(opened):
    url = f"http://127.0.0.1:{free_port()}/video"
    with pytest.raises(CameraError, match=rf"camera {url} cannot be reached.*within 0.5 s; is its server running"):
        opened(url=url, open_timeout=0.5)


def answering(payload):
    """A server that answers one client with ``payload``, then keeps silent until it is closed."""
    listener = socket.create_server(("127.0.0.1", 0))

    def serve():
        connection, _ = listener.accept()
        connection.sendall(payload)
        kept.append(connection)

    kept = []
    threading.Thread(target=serve, daemon=True).start()
    return listener, kept


@pytest.mark.parametrize("payload", [b"", b"HTTP/1.0 200 OK\r\nContent-Type: text/html\r\n\r\n<html>no video</html>"])
def test_an_address_without_a_video_is_named_within_the_timeout(opened, payload):
    listener, kept = answering(payload)
    with pytest.raises(CameraError, match="cannot be reached, or sends no video"):
        opened(url=f"http://127.0.0.1:{listener.getsockname()[1]}/", open_timeout=0.5)
    for connection in kept:
        connection.close()
    listener.close()


def test_a_device_that_does_not_exist_is_named(opened):
    with pytest.raises(CameraError, match=r"camera 255 does not exist: expected one of .*, device = .*plugged in"):
        opened(device=255)


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({}, r"device = -1, url = '': expected one of the two"),
        ({"device": 0, "url": "http://127.0.0.1/"}, "expected one of the two"),
        ({"url": "video.avi"}, r'expected http://.*; a file is name = "recorded"'),
        ({"url": "file:///video.avi"}, r'a file is name = "recorded"'),
        ({"device": 0, "width": 640}, "width = 640, height = 0: expected both or neither"),
        ({"device": -2}, "device = -2: expected a value from -1 to 255"),
    ],
)
def test_contradictory_settings_are_refused(opened, settings, match):
    with pytest.raises(ConfigError, match=match):
        opened(**settings)
