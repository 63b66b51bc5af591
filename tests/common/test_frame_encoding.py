"""Encoded frames: the same pixels for everybody, and nothing that is damaged, cut off or too large."""

import struct

import cv2
import msgpack
import numpy as np
import pytest
from backports import zstd

from common import frame_encoding
from common.codec import decode, encode
from common.errors import MessageError
from common.frame_encoding import EncodedFrames, FrameEncoding, digest_of, encode_frames, pixels_of
from common.messages import Experience, TimeStep
from services.robot_bridge.tasks import load_task
from tests.helpers import make_experience, make_spec, make_time_step

RAW, ZSTD, JPEG = FrameEncoding.RAW, FrameEncoding.ZSTD, FrameEncoding.JPEG444
SHAPE = (6, 8, 3)
encoded = pytest.mark.parametrize("encoding", [ZSTD, JPEG])


def drawing(count=2, height=90, width=160):
    """Coloured edges on a slope of brightness: what 4:2:0 would spoil."""
    slope = np.linspace(0, 120, width, dtype=np.uint8)
    frames = np.repeat(np.repeat(slope[None, None, :, None], height, 1), 3, 3).repeat(count, 0)
    for number, frame in enumerate(frames):
        cv2.rectangle(frame, (10 + 5 * number, 20), (60, 70), (250, 10, 10), -1)
        cv2.circle(frame, (120, 40), 15, (10, 60, 250), -1)
    return frames


def of(encoding, parts, shape=SHAPE):
    """Encoded frames with the digest that belongs to them."""
    return EncodedFrames(encoding, (len(parts), *shape), tuple(parts), digest_of(tuple(parts)))


def jpeg(pixels, *options):
    return cv2.imencode(".jpg", pixels, list(options))[1].tobytes()


FRAME = np.arange(np.prod(SHAPE), dtype=np.uint8).reshape(SHAPE) // 8
FULL_COLOUR = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
GOOD = {ZSTD: zstd.compress(FRAME.tobytes()), JPEG: jpeg(FRAME, *FULL_COLOUR)}


def test_raw_frames_are_what_they_were():
    frames = drawing()
    assert encode_frames(frames, RAW) is frames
    assert pixels_of(frames) is frames


def test_zstd_loses_nothing_and_shrinks_a_drawing():
    frames = drawing()
    sent = encode_frames(frames, ZSTD)
    np.testing.assert_array_equal(pixels_of(sent), frames)
    assert sum(map(len, sent.parts)) < frames.nbytes / 20


def test_jpeg_keeps_the_colours_in_their_order_and_the_edges_sharp():
    frames = drawing()
    got = pixels_of(encode_frames(frames, JPEG)).astype(float)
    square_error = ((got - frames) ** 2).mean()
    assert 10 * np.log10(255**2 / square_error) > 38  # dB; subsampled or with red and blue exchanged: below 30
    assert np.abs(got[0, 45, 30] - (250, 10, 10)).max() <= 3


@encoded
def test_a_frame_looks_the_same_whichever_others_come_with_it(encoding):
    frames = drawing(3)
    together = pixels_of(encode_frames(frames, encoding))
    for alone, frame in zip(frames, together, strict=True):
        np.testing.assert_array_equal(pixels_of(encode_frames(alone[None], encoding))[0], frame)


@encoded
def test_frames_need_not_be_contiguous_and_may_be_none_at_all(encoding):
    frames = drawing()[:, ::-1, ::2]
    copied = encode_frames(frames.copy(), encoding)
    assert encode_frames(frames, encoding).parts == copied.parts
    assert pixels_of(encode_frames(frames[:0], encoding)).shape == (0, 90, 80, 3)


@encoded
def test_decoded_pixels_are_read_only(encoding):
    with pytest.raises(ValueError, match="read-only"):
        pixels_of(encode_frames(drawing(), encoding))[:] = 0


def test_one_channel_is_zstds_business():
    frames = drawing()[..., :1]
    np.testing.assert_array_equal(pixels_of(encode_frames(frames, ZSTD)), frames)
    with pytest.raises(MessageError, match="expected frames of 3 channels, got 1"):
        encode_frames(frames, JPEG)


# ------------------------------------------------------------------ what is refused


@encoded
def test_every_damaged_byte_and_every_cut_is_noticed(encoding):
    sent = encode_frames(FRAME[None], encoding)
    (part,) = sent.parts
    for at in range(len(part)):
        changed = part[:at] + bytes([part[at] ^ 0x10]) + part[at + 1 :]
        for wrong in (changed, part[:at]):
            with pytest.raises(MessageError, match="damaged on the way"):
                _ = EncodedFrames(encoding, sent.shape, (wrong,), sent.digest).pixels


@encoded
def test_a_sender_whose_frames_are_cut_off_is_refused_wherever_they_are(encoding):
    for end in range(len(GOOD[encoding])):
        with pytest.raises(MessageError, match=r"zstd|JPEG"):
            _ = of(encoding, [GOOD[encoding][:end]]).pixels


@encoded
def test_a_senders_nonsense_is_refused_or_has_the_right_size(encoding):
    rng = np.random.default_rng(0)
    good = np.frombuffer(GOOD[encoding], np.uint8)
    refused = 0
    for _ in range(500):
        wrong = good.copy()
        wrong[rng.integers(0, len(good), 3)] = rng.integers(0, 256, 3)
        try:
            assert of(encoding, [wrong.tobytes()]).pixels.shape == (1, *SHAPE)
        except MessageError:
            refused += 1
    assert refused > 100


@encoded
@pytest.mark.parametrize("shape", [(8, 6, 3), (6, 9, 3), (5, 8, 3)])
def test_a_frame_of_another_size_is_refused(encoding, shape):
    with pytest.raises(MessageError, match=r"expected a (JPEG|zstd frame) of .*, got one of"):
        _ = of(encoding, [GOOD[encoding]], shape if encoding is JPEG else (6, 9, 3)).pixels


def test_something_after_a_zstd_frame_is_refused():
    for behind in (b"\0", GOOD[ZSTD]):
        with pytest.raises(MessageError, match="something follows it"):
            _ = of(ZSTD, [GOOD[ZSTD] + behind]).pixels


def test_a_zstd_frame_that_does_not_state_its_size_is_refused():
    compressor = zstd.ZstdCompressor()
    silent = compressor.compress(FRAME.tobytes()) + compressor.flush()
    assert zstd.get_frame_info(silent).decompressed_size is None
    with pytest.raises(MessageError, match="got one of None"):
        _ = of(ZSTD, [silent]).pixels


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ((cv2.IMWRITE_JPEG_PROGRESSIVE, 1, *FULL_COLOUR), "expected a baseline JPEG: got the marker ffc2"),
        ((cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420), "expected a JPEG with 4:4:4"),
    ],
)
def test_another_kind_of_jpeg_is_refused(options, expected):
    with pytest.raises(MessageError, match=expected):
        _ = of(JPEG, [jpeg(FRAME, *options)]).pixels


def test_another_format_is_no_jpeg():
    with pytest.raises(MessageError, match="does not begin with one's marker"):
        _ = of(JPEG, [cv2.imencode(".png", FRAME)[1].tobytes()]).pixels


def test_a_bomb_is_refused_by_its_header_before_anything_is_decompressed(monkeypatch):
    def must_not_run(*_, **__):
        raise AssertionError("decompressed")

    zeros = zstd.compress(bytes(1 << 26))
    assert len(zeros) < 10_000
    at = GOOD[JPEG].index(b"\xff\xc0")
    huge = GOOD[JPEG][: at + 5] + struct.pack(">HH", 65_500, 65_500) + GOOD[JPEG][at + 9 :]
    monkeypatch.setattr(zstd, "ZstdDecompressor", must_not_run)
    monkeypatch.setattr(cv2, "imdecode", must_not_run)
    with pytest.raises(MessageError, match="expected a zstd frame of 144 bytes, got one of 67108864"):
        _ = of(ZSTD, [zeros]).pixels
    with pytest.raises(MessageError, match=r"expected a JPEG of \(6, 8, 3\), got one of \(65500, 65500, 3\)"):
        _ = of(JPEG, [huge]).pixels


@pytest.mark.parametrize(("window_log", "refusal"), [(10, "it is cut off"), (27, "too much memory")])
def test_no_window_larger_than_the_contents_is_allocated(window_log, refusal):
    pixels = np.arange(384, dtype=np.uint8).reshape(16, 8, 3)
    # RFC 8878, 3.1.1: descriptor (two bytes of size), window descriptor, size - 256, header of a last, raw block.
    block = (384 << 3 | 1).to_bytes(3, "little") + pixels.tobytes()
    part = b"\x28\xb5\x2f\xfd" + bytes([0x40, (window_log - 10) << 3]) + (384 - 256).to_bytes(2, "little") + block
    # What is whole is decompressed without a window.
    np.testing.assert_array_equal(of(ZSTD, [part], (16, 8, 3)).pixels[0], pixels)
    with pytest.raises(MessageError, match=refusal):
        _ = of(ZSTD, [part[:-1]], (16, 8, 3)).pixels


@encoded
def test_many_small_parts_that_would_fill_the_memory_are_refused(encoding, monkeypatch):
    monkeypatch.setattr(frame_encoding, "MAX_PIXEL_BYTES", 10 * FRAME.nbytes)
    assert of(encoding, [GOOD[encoding]] * 10).pixels.shape == (10, *SHAPE)
    with pytest.raises(MessageError, match="expected frames of 1440 bytes at most"):
        _ = of(encoding, [GOOD[encoding]] * 11).pixels
    with pytest.raises(MessageError, match="expected 1440 at most"):
        encode_frames(np.zeros((11, *SHAPE), np.uint8), encoding)


# ------------------------------------------------------------------ in messages


def encoded_step(encoding, seq=1):
    step = make_time_step(seq)
    return make_time_step(seq, frames=encode_frames(step.frames, encoding))


@encoded
def test_a_time_step_brings_its_pixels_and_sends_its_bytes_on_unchanged(encoding):
    sent = encoded_step(encoding)
    got = decode(encode(sent), TimeStep, make_spec(frame_encoding=encoding).dimensions)
    np.testing.assert_array_equal(got.pixels, sent.frames.pixels)
    assert got.pixels.shape == (1, 6, 8, 3)
    assert got.frames == sent.frames
    experience = make_experience(1, time_step=got)
    forwarded = decode(encode(experience), Experience, make_spec(frame_encoding=encoding).dimensions)
    assert forwarded.time_step.frames.parts == sent.frames.parts
    np.testing.assert_array_equal(forwarded.time_step.pixels, got.pixels)


@pytest.mark.parametrize("announced", [RAW, ZSTD, JPEG])
def test_frames_of_another_encoding_than_announced_are_refused(announced):
    dimensions = make_spec(frame_encoding=announced).dimensions
    for encoding in {RAW, ZSTD, JPEG} - {announced}:
        with pytest.raises(MessageError, match=f"the run's encoding '{announced}', got '{encoding}'"):
            decode(encode(encoded_step(encoding)), TimeStep, dimensions)


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        (["raw", [1, 6, 8, 3], [b""], ""], "expected the run's encoding 'raw', got 'raw'"),
        (["gif", [1, 6, 8, 3], [b""], ""], "expected one of .*, got 'gif'"),
        ([[], [1, 6, 8, 3], [b""], ""], "expected one of"),
        (["zstd", [1, 6, 8], [b""], ""], r"expected shape \(1, 6, 8, 3\)"),
        (["zstd", [1, 6, 8, 4], [GOOD[ZSTD]], ""], r"expected shape \(1, 6, 8, 3\)"),
        (["zstd", [1, 6, 8, 3], [], digest_of(())], "expected 1 encoded frames, got 0"),
        (["zstd", [1, 6, 8, 3], [GOOD[ZSTD]] * 2, digest_of((GOOD[ZSTD],) * 2)], "expected 1 encoded frames, got 2"),
        (["zstd", [1, 6, 8, 3], GOOD[ZSTD], ""], "expected a list of encoded frames"),
        (["zstd", [1, 6, 8, 3], ["text"], ""], "expected a list of encoded frames"),
        (["zstd", [1, 6, 8, 3], [GOOD[ZSTD]], 7], "expected str, got int"),
        (["zstd", [1, 6, 8, 3], [GOOD[ZSTD]], "0" * 16], "expected bytes with the digest 0{16}: they were damaged"),
        (["zstd", [1, 6, 8, 3], [GOOD[JPEG]], digest_of((GOOD[JPEG],))], "expected a zstd frame"),
    ],
)
def test_wrong_encoded_frames_are_refused_with_what_was_expected(wrong, expected):
    fields = msgpack.unpackb(encode(make_time_step()))
    fields["frames"] = wrong
    with pytest.raises(MessageError, match=f"^TimeStep.frames: {expected}"):
        decode(
            msgpack.packb(fields), TimeStep, None if wrong[0] == "raw" else make_spec(frame_encoding=ZSTD).dimensions
        )


@pytest.mark.parametrize("shape", [[0, 2**62, 2**62, 3], [0, 2**40, 2**40, 2**40], [1, 2**62, 2, 3]])
def test_a_shape_without_a_task_that_claims_to_be_huge_does_no_harm(shape):
    fields = msgpack.unpackb(
        encode(make_time_step(frame_ids=np.arange(shape[0]), frame_capture_ns=np.arange(shape[0])))
    )
    parts = [GOOD[ZSTD]] * shape[0]
    fields["frames"] = ["zstd", shape, parts, digest_of(tuple(parts))]
    with pytest.raises(MessageError, match=r"TimeStep\.frames"):
        decode(msgpack.packb(fields), TimeStep)


def test_an_experience_costs_little_beside_one_with_the_whole_stack():
    task = load_task("visual_dot_reacher", pacing="lockstep", rng=np.random.default_rng(0))
    task.advance_to(0)
    task.begin_episode()

    def size_of(count, encoding):
        frames = np.concatenate([task.read().frames for _ in range(count)])
        ids = np.arange(count)
        step = make_time_step(1, frame_ids=ids, frame_capture_ns=ids, frames=encode_frames(frames, encoding))
        return len(encode(make_experience(1, time_step=step)))

    stack = size_of(task.spec.frame_stack, RAW)
    assert size_of(1, RAW) <= 0.37 * stack
    assert size_of(1, ZSTD) <= 0.06 * stack
    assert size_of(1, JPEG) <= 0.12 * stack
