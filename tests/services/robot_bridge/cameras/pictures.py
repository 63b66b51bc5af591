"""Pictures that carry their number, so that a test knows which one it sees, and two sources of them."""

from __future__ import annotations

import http.server
import threading
import time

import cv2
import numpy as np

from services.robot_bridge.cameras import PictureSize

SIZE = PictureSize(height=24, width=128)
"""Sixteen blocks of 8 pixels side by side are the number in binary; the rows below them are red."""
_BITS, _BLOCK = 16, 8
_PERIOD_S = 0.01
"""The server sends no faster than this."""


def draw(number, size=SIZE) -> np.ndarray:
    """Picture ``number`` as OpenCV has it, (H, W, 3) blue first."""
    picture = np.zeros((SIZE.height, SIZE.width, 3), np.uint8)
    for bit in range(_BITS):
        picture[:16, bit * _BLOCK : (bit + 1) * _BLOCK] = 255 * (number >> bit & 1)
    picture[16:] = (0, 0, 255)
    return cv2.resize(picture, (size.width, size.height), interpolation=cv2.INTER_NEAREST)


def number_of(frame) -> int:
    """The number of the picture in a frame of SIZE."""
    blocks = frame[4:12].reshape(8, _BITS, _BLOCK, 3)[:, :, 2:6].mean(axis=(0, 2, 3))
    return sum(int(level > 127) << bit for bit, level in enumerate(blocks))


def is_red_below(frame) -> bool:
    """True if what was drawn red is red in a frame whose first channel is red."""
    red, green, blue = frame[20:].mean(axis=(0, 1))
    return red > 200 and green < 60 and blue < 60


def write_video(path, count, rate=30.0, size=SIZE):
    """Write a video of pictures 0 to ``count`` - 1; return its path."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), rate, (size.width, size.height))
    assert writer.isOpened()
    for number in range(count):
        writer.write(draw(number, size))
    writer.release()
    return path


class MjpegServer:
    """A network camera on loopback: numbered pictures over HTTP (motion JPEG), while it is not paused."""

    def __init__(self, port=0, size=SIZE) -> None:
        self._size, self._paused, self._ended = size, threading.Event(), threading.Event()
        self.sent_ns = {}
        """Number of a picture -> when it was sent, the computer's monotonic clock."""
        self._numbers = iter(range(1, 1 << _BITS))
        self.undecodable = lambda number: False
        """Which numbers are sent as what is no picture."""
        camera = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def log_message(self, *_):
                pass

            def do_GET(self):
                camera._serve(self)

        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", port), Handler)
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        return self._server.server_address[1]

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/video"

    def pause(self) -> None:
        """Keep the connections and send nothing."""
        self._paused.set()

    def resume(self) -> None:
        """Go on sending."""
        self._paused.clear()

    def close(self) -> None:
        """Be gone: nobody answers on the port any more."""
        self._ended.set()
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def _serve(self, request) -> None:
        request.send_response(200)
        request.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        request.end_headers()
        while not self._ended.wait(_PERIOD_S):
            if self._paused.is_set():
                continue
            number = next(self._numbers)
            picture = cv2.imencode(".jpg", draw(number, self._size))[1].tobytes()
            if self.undecodable(number):
                picture = b"no picture"
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(picture)}\r\n\r\n"
            self.sent_ns[number] = time.monotonic_ns()
            try:
                request.wfile.write(head.encode() + picture + b"\r\n")
            except OSError:
                return  # the camera's reader has gone
