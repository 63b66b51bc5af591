"""Camera frames as they travel: raw pixels, zstd or JPEG; encoded once, by the bridge, and forwarded as they are.

Raw frames are an ordinary array of a message. Encoded ones are :class:`EncodedFrames`, each frame by itself, so that
what a frame looks like does not depend on which others came with it. Every receiver decodes the same bytes by the
same rules: actor and replay see the same pixels. Bytes from the network are not trusted: a frame's size is read off
its own header before anything is decompressed, and what has been damaged on the way does not fit its digest.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import numpy as np
import numpy.typing as npt
import xxhash

from common.errors import MessageError

Pixels = npt.NDArray[np.uint8]

MAX_PIXEL_BYTES = 64 << 20
"""Bytes that the frames of one message may decode to: a few hundred bytes must not fill a computer's memory."""
ZSTD_LEVEL = 1
"""Higher levels take several times as long for a few percent."""
JPEG_QUALITY = 95
JPEG_CHANNELS = 3


class FrameEncoding(StrEnum):
    """How a run's camera frames travel; the bridge chooses, once per run."""

    RAW = "raw"
    """As they are."""
    ZSTD = "zstd"
    """Zstandard, lossless: good for drawn and rendered images, of little use for a camera's noise."""
    JPEG444 = "jpeg444"
    """JPEG with all of the colour (4:4:4); everybody gets the pixels that its decoder gives."""


@dataclass(frozen=True)
class EncodedFrames:
    """Frames of one message, each encoded by itself."""

    encoding: FrameEncoding
    """``zstd`` or ``jpeg444``."""
    shape: tuple[int, int, int, int]
    """(k, H, W, C) of the pixels."""
    parts: tuple[bytes, ...]
    """k encoded frames."""
    digest: str
    """:func:`digest_of` the parts."""

    def __len__(self) -> int:
        return len(self.parts)

    @cached_property
    def pixels(self) -> Pixels:
        """(k, H, W, C), read-only.

        Raises:
            MessageError: a frame is damaged, or not of this shape.
        """
        count, *frame_shape = self.shape
        if len(self.parts) != count:
            raise MessageError(f"expected {count} encoded frames, got {len(self.parts)}")
        if math.prod(self.shape) > MAX_PIXEL_BYTES:
            raise MessageError(f"expected frames of {MAX_PIXEL_BYTES} bytes at most, got shape {list(self.shape)}")
        if digest_of(self.parts) != self.digest:
            raise MessageError(f"expected bytes with the digest {self.digest:.40}: they were damaged on the way")
        try:
            pixels = np.empty(self.shape, np.uint8)
        except ValueError as error:
            raise MessageError(f"{list(self.shape)} cannot be the shape of frames: {error}") from error
        for frame, part in zip(pixels, self.parts, strict=True):
            frame[:] = _DECODERS[self.encoding](part, (frame_shape[0], frame_shape[1], frame_shape[2]))
        pixels.flags.writeable = False
        return pixels


Frames = Pixels | EncodedFrames
"""Frames of a message, raw or encoded."""


def encode_frames(frames: Pixels, encoding: FrameEncoding) -> Frames:
    """Return frames (k, H, W, C) as they travel in the encoding.

    Raises:
        MessageError: what no receiver would decode.
    """
    if encoding is FrameEncoding.RAW:
        return frames
    if frames.nbytes > MAX_PIXEL_BYTES:
        raise MessageError(
            f"{len(frames)} frames of {frames.shape[1:]} are {frames.nbytes} bytes: expected {MAX_PIXEL_BYTES} at most"
        )
    parts = tuple(_ENCODERS[encoding](np.ascontiguousarray(frame)) for frame in frames)
    count, height, width, channels = frames.shape
    return EncodedFrames(encoding, (count, height, width, channels), parts, digest_of(parts))


def pixels_of(frames: Frames) -> Pixels:
    """Return the pixels (k, H, W, C) of frames that may be encoded."""
    return frames.pixels if isinstance(frames, EncodedFrames) else frames


def digest_of(parts: tuple[bytes, ...]) -> str:
    """Return XXH3-64 of the parts one after the other, seed 0, hexadecimal."""
    digest = xxhash.xxh3_64()
    for part in parts:
        digest.update(part)
    return digest.hexdigest()


# ------------------------------------------------------------------ zstd


def _encode_zstd(frame: Pixels) -> bytes:
    from backports import zstd

    return zstd.compress(frame.data, ZSTD_LEVEL)


def _decode_zstd(part: bytes, shape: tuple[int, int, int]) -> Pixels:
    from backports import zstd

    size = math.prod(shape)
    try:
        stated = zstd.get_frame_info(part).decompressed_size
        if stated != size:
            raise MessageError(f"expected a zstd frame of {size} bytes, got one of {stated}")
        # The window is what a decompressor allocates; no frame needs one that is larger than itself.
        window_log = max(10, (size - 1).bit_length())
        decompressor = zstd.ZstdDecompressor(options={zstd.DecompressionParameter.window_log_max: window_log})
        data = decompressor.decompress(part, max_length=size)
    except zstd.ZstdError as error:
        raise MessageError(f"expected a zstd frame: {error}") from error
    if len(data) != size or not decompressor.eof or decompressor.unused_data:
        raise MessageError(f"expected exactly one zstd frame of {size} bytes: it is cut off or something follows it")
    return np.frombuffer(data, np.uint8).reshape(shape)


# ------------------------------------------------------------------ JPEG


def _encode_jpeg(frame: Pixels) -> bytes:
    import cv2

    if frame.shape[2] != JPEG_CHANNELS:
        raise MessageError(f"jpeg444: expected frames of {JPEG_CHANNELS} channels, got {frame.shape[2]}")
    # Huffman tables of its own: a tenth less, and a third less for a frame as small as a drawn one.
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    sampling = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    _, encoded = cv2.imencode(".jpg", cv2.cvtColor(frame, cv2.COLOR_RGB2BGR), quality + sampling)
    data: bytes = encoded.tobytes()
    return data


def _decode_jpeg(part: bytes, shape: tuple[int, int, int]) -> Pixels:
    import cv2

    # OpenCV would allocate whatever size the header states, and fill in what is missing at a cut-off end.
    stated = _jpeg_shape(part)
    if stated != shape:
        raise MessageError(f"expected a JPEG of {shape}, got one of {stated}")
    if not part.endswith(b"\xff\xd9"):
        raise MessageError("expected a whole JPEG: its end is cut off")
    try:
        decoded = cv2.imdecode(np.frombuffer(part, np.uint8), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise MessageError(f"a JPEG that cannot be decoded: {error.err}") from error
    if decoded is None or decoded.shape != shape:
        raise MessageError(f"expected a JPEG of {shape}: it cannot be decoded")
    pixels: Pixels = np.asarray(decoded, np.uint8)
    return pixels


def _jpeg_shape(part: bytes) -> tuple[int, int, int]:
    """Read (height, width, channels) off the header of a baseline JPEG (ITU-T T.81, annex B) with 4:4:4 sampling.

    Baseline only: a progressive one may have any number of scans, each as much work as the whole image.
    """
    at = 2
    try:
        if part[:2] != b"\xff\xd8":
            raise MessageError("expected a JPEG: it does not begin with one's marker")
        while True:
            marker, length = struct.unpack_from(">HH", part, at)
            if marker == 0xFFC0:  # SOF0
                _, height, width, components = struct.unpack_from(">BHHB", part, at + 4)
                samplings = {part[at + 11 + 3 * component] for component in range(components)}
                if samplings != {0x11}:
                    raise MessageError("expected a JPEG with 4:4:4 sampling")
                return height, width, components
            # Tables and comments may come before; another kind of frame or the image itself may not.
            if not (marker in (0xFFC4, 0xFFDB, 0xFFDD, 0xFFFE) or 0xFFE0 <= marker <= 0xFFEF):
                raise MessageError(f"expected a baseline JPEG: got the marker {marker:04x} before its header")
            at += 2 + length
    except (struct.error, IndexError) as error:
        raise MessageError("expected a JPEG: its header is cut off") from error


_ENCODERS: dict[FrameEncoding, Callable[[Pixels], bytes]] = {
    FrameEncoding.ZSTD: _encode_zstd,
    FrameEncoding.JPEG444: _encode_jpeg,
}
_DECODERS: dict[FrameEncoding, Callable[[bytes, tuple[int, int, int]], Pixels]] = {
    FrameEncoding.ZSTD: _decode_zstd,
    FrameEncoding.JPEG444: _decode_jpeg,
}
