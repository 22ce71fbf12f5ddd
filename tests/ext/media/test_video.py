"""The decoder is silent rather than wrong; what encoders make is what it shows."""

from __future__ import annotations

import base64
import json
import random
import struct
import sys
import zlib
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from pebble.errors import ConfigError, PayloadError, PebbleError
from pebble.extensions.media import h264, json_video, pyav
from pebble.extensions.media.decode import MAX_PAYLOAD, VideoDecoder
from pebble.extensions.media.jpeg import Pixels, decode_jpeg, jpeg_size
from pebble.extensions.media.jpeg_delta import add, subtract
from pebble.extensions.media.json_video import inflate
from pebble.extensions.media.packets import Picture, PictureKind
from pebble.extensions.media.scene import Scene
from pebble.extensions.media.video import VideoEncoder, make_encoder
from tests.support import cases
from tests.vectors import vectors

T0, STEP_MS = 1_710_969_600_000, 66


def small(number: int, width: int = 64, height: int = 48) -> np.ndarray:
    made = np.full((height, width, 3), (90, 120, 70), np.uint8)
    cv2.circle(made, (number * 5 % width, height // 2), 9, (40, 60, 220), -1)
    return made


def stream(name: str, count: int = 12, interval: int = 6, start_ms: int = T0, first: int = 0) -> list[bytes]:
    encoder = make_encoder(name, fps=15, keyframe_interval=interval)
    return [encoder.encode(small(first + n), start_ms + n * STEP_MS) for n in range(count)]


def frames(decoder: VideoDecoder, packets: list[bytes]) -> list[int | None]:
    """The numbers of what was shown, None where nothing was."""
    return [shown.frame if shown else None for shown in map(decoder.feed, packets)]


Sent = Callable[[list[bytes], list[bytes]], list[bytes]]
#: The same of json and pbvd is in tests/vectors/video.json.
SHOWN: dict[str, tuple[Sent, list[int | None]]] = {
    "a lost frame, and a key frame after it": (lambda old, _: old[:3] + old[4:8], [0, 1, 2, None, None, 6, 7]),
    "joined between key frames": (lambda old, _: old[3:8], [None, None, None, 6, 7]),
    "a sender that began again": (lambda old, new: [*old[:5], new[1], *new[6:8]], [0, 1, 2, 3, 4, None, 6, 7]),
    "a new sender whose number fits, by its time": (
        lambda old, new: [*old[:3], *new[3:6]],
        [0, 1, 2, None, None, None],
    ),
}


@pytest.mark.parametrize(("sent", "shown"), SHOWN.values(), ids=SHOWN)
@pytest.mark.parametrize("later_ms", [8000, -1000])
def test_what_is_shown(sent: Sent, shown: list[int | None], later_ms: int) -> None:
    decoder = VideoDecoder()
    assert not decoder.wants_keyframe
    assert frames(decoder, sent(stream("h264"), stream("h264", start_ms=T0 + later_ms, first=3))) == shown
    assert decoder.wants_keyframe is (shown[-1] is None)


@pytest.mark.parametrize("bad", [b"", b"{", b"\xff\xd8", b"PBVD\x01\x09" + bytes(40)])
def test_anything_refused_breaks_the_chain(bad: bytes) -> None:
    packets, decoder = stream("h264"), VideoDecoder()
    assert frames(decoder, [*packets[:2], bad, *packets[2:7]]) == [0, 1, None, None, None, None, None, 6]
    assert decoder.problem


def test_raw_jpeg_is_a_key_frame_without_number_and_time() -> None:
    jpeg = cv2.imencode(".jpg", small(1))[1].tobytes()
    decoder = VideoDecoder()
    shown = decoder.feed(jpeg)
    assert shown is not None
    assert (shown.frame, shown.captured_ms, shown.keyframe, shown.encoding) == (None, None, True, "jpeg")
    assert frames(decoder, [stream("pbvd")[1]]) == [None]
    assert decoder.feed(jpeg + b"\0\0") is not None  # some cameras fill their buffers up


def test_numbers_wrap_after_32_bits_and_a_turn_asked_for_in_the_picture_is_ignored() -> None:
    jpeg = cv2.imencode(".jpg", small(0))[1].tobytes()
    flat = cv2.imencode(".jpg", np.full((48, 64, 3), 128, np.uint8))[1].tobytes()
    packets = [
        Picture(PictureKind.JPEG, (1 << 32) - 1, T0, jpeg).pack(),
        Picture(PictureKind.DELTA_JPEG, 0, T0 + 5, flat).pack(),
    ]
    assert frames(VideoDecoder(), packets) == [(1 << 32) - 1, 0]
    exif = b"Exif\0\0II*\0" + struct.pack("<IHHHII", 8, 1, 0x0112, 3, 1, 6) + bytes(4)
    turned = jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]
    assert np.array_equal(decode_jpeg(turned), decode_jpeg(jpeg))


def test_the_picture_belongs_to_the_caller() -> None:
    spoilt, untouched = VideoDecoder(), VideoDecoder()
    for packet in stream("pbvd"):
        one, other = spoilt.feed(packet), untouched.feed(packet)
        assert one is not None
        assert other is not None
        assert np.array_equal(one.picture, other.picture)
        one.picture[:] = 0


@pytest.mark.parametrize(
    ("stamp", "captured_ms"),
    [
        ("1710969600.123", 1710969600123),
        ("1710969600123", 1710969600123),
        ("null", None),
        ("0", None),
        ("1e300", None),
    ],
)
def test_stamps(stamp: str, captured_ms: int | None) -> None:
    packet = json_video.pack(0, True, None, cv2.imencode(".jpg", small(0))[1].tobytes())
    shown = VideoDecoder().feed(packet.replace(b'"timestamp":null', b'"timestamp":' + stamp.encode()))
    assert shown is not None
    assert shown.captured_ms == captured_ms


@pytest.mark.parametrize(
    ("was", "now"),
    [
        (b'"id":0', b'"id":' + b"9" * 400),
        (b'"id":0', b'"id":-1'),
        (b'"id":0', b'"id":0.5'),
        (b'"id":0', b'"id":0,"more":' + b"[" * 100_000),
        (b'"keyframe":true', b'"keyframe":1'),
        (b'"timestamp":1710969600.0', b'"timestamp":NaN'),
        (b'"data":"', b'"data":"!'),
        (b'"data":"', b'"data":null,"date":"'),
    ],
)
def test_json_that_is_none_of_ours(was: bytes, now: bytes) -> None:
    packet = stream("json")[0]
    assert was in packet
    decoder = VideoDecoder()
    assert decoder.feed(packet.replace(was, now)) is None
    assert decoder.wants_keyframe


def test_what_is_too_large_is_refused_before_it_is_decoded() -> None:
    bomb = zlib.compress(bytes(16 << 20), 1)
    decoder = VideoDecoder()
    assert frames(decoder, [Picture(PictureKind.ZLIB_JPEG, 0, T0, bomb).pack(), bytes(MAX_PAYLOAD + 1)]) == [None, None]
    with pytest.raises(PayloadError, match="more than 1000"):
        inflate(zlib.compress(bytes(1001)), 1000)
    assert inflate(zlib.compress(bytes(1000)), 1000) == bytes(1000)
    jpeg = cv2.imencode(".jpg", small(0))[1].tobytes()
    at = jpeg.index(b"\xff\xc0") + 5
    for height, width in ((4097, 16), (16, 4097), (65535, 65535), (0, 64), (48, 0)):
        with pytest.raises(PayloadError):
            jpeg_size(jpeg[:at] + struct.pack(">HH", height, width) + jpeg[at + 4 :])


@pytest.mark.parametrize(
    "options",
    [
        [cv2.IMWRITE_JPEG_PROGRESSIVE, 1],
        [cv2.IMWRITE_JPEG_RST_INTERVAL, 2],
        [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_411],
    ],
)
def test_every_jpeg_a_camera_may_send(options: list[int]) -> None:
    jpeg = cv2.imencode(".jpg", small(0, 161, 121), options)[1].tobytes()
    assert jpeg_size(jpeg) == (161, 121)
    assert decode_jpeg(jpeg).shape == (121, 161, 3)
    grey = cv2.imencode(".jpg", small(0)[:, :, 0], options[:2])[1].tobytes()
    assert decode_jpeg(grey).shape == (48, 64, 3)


def hostile(chance: random.Random, packet: bytes) -> bytes:
    """Cut off, garbage, or with other bits behind its header."""
    kind, made = chance.randrange(3), bytearray(packet)
    if kind == 0:
        return packet[: chance.choice([chance.randrange(len(packet)), len(packet) - 1])]
    if kind == 1:
        begin = chance.choice([b"", b"{", b'{"id":', b"PBVD\x01\x01\x00", b"PBVD\x01\x05\x01", b"\xff\xd8\xff"])
        return begin + chance.randbytes(chance.randint(0, 300))
    for _ in range(chance.randint(1, 8)):
        made[chance.randrange(19, len(made))] ^= 1 << chance.randrange(8)
    return bytes(made)


@pytest.mark.parametrize("name", ["json", "pbvd", "h264"])
def test_hostile_packets(name: str) -> None:
    """Among good ones: never a crash, and never a wrong picture where a checksum tells."""
    chance, packets, honest = random.Random(name), stream(name, 36), VideoDecoder()
    right = [shown.picture for shown in map(honest.feed, packets) if shown is not None]
    decoder, at = VideoDecoder(), 0
    for _ in range(cases(700, 30_000)):
        is_hostile = chance.random() < 0.4
        shown = decoder.feed(hostile(chance, packets[at]) if is_hostile else packets[at])
        assert decoder.wants_keyframe is (shown is None)
        if shown is not None and name != "pbvd":
            assert np.array_equal(shown.picture, right[at])
        at = (at + chance.choices([0 if is_hostile else 1, 1, 3], [4, 4, 1])[0]) % len(packets)
    again = [decoder.feed(packet) for packet in packets]
    assert all(np.array_equal(shown.picture, picture) for shown, picture in zip(again, right, strict=True) if shown)
    assert all(again[6:])


# -- encoders: what they make is what our decoder shows, at the size, rate and moment asked for


FORMS = ("json", "pbvd", "h264")


def picture(number: int, width: int = 320, height: int = 240) -> Pixels:
    made = np.empty((height, width, 3), np.uint8)
    Scene(width, height).render(number, made)
    return made


def send(encoder: VideoEncoder, count: int, first: int = 0, **asked: bool) -> list[bytes]:
    return [encoder.encode(picture(n), T0 + n * 66, **asked) for n in range(first, first + count)]


@pytest.mark.parametrize("name", FORMS)
def test_what_is_sent_is_shown(name: str) -> None:
    """A view that may only be read is enough for it."""
    encoder, decoder = make_encoder(name, fps=15, keyframe_interval=5, quality=40), VideoDecoder()
    for number in range(12):
        view = picture(number)
        view.flags.writeable = False
        shown = decoder.feed(encoder.encode(view, T0 + number * 66))
        assert shown is not None, decoder.problem
        assert (shown.encoding, shown.frame, shown.captured_ms) == (name, number, T0 + number * 66)
        assert shown.keyframe is (number % 5 == 0)
        assert shown.picture.flags.writeable
        assert cv2.PSNR(shown.picture, picture(number)) > 22
        assert np.array_equal(view, picture(number))
    assert not decoder.wants_keyframe
    with pytest.raises(ConfigError, match="'mpeg2': unknown; there are json, pbvd, h264"):
        make_encoder("mpeg2", fps=15)


@pytest.mark.parametrize(("name", "interval", "expected"), [("h264", 4, [0, 4, 6, 10]), ("json", None, [0, 5, 6, 11])])
def test_a_key_frame_comes_when_asked_for_and_the_interval_begins_anew(
    name: str, interval: int | None, expected: list[int]
) -> None:
    """The usual interval is a third of a second."""
    encoder = make_encoder(name, fps=15, keyframe_interval=interval)
    keys = []
    for number in range(12):
        encoder.encode(picture(number), T0 + number, keyframe=number == 6)
        keys.append(encoder.last_was_keyframe)
    assert [number for number, key in enumerate(keys) if key] == expected


@pytest.mark.parametrize("name", FORMS)
def test_another_size_is_a_key_frame_and_numbers_go_on(name: str) -> None:
    encoder, decoder = make_encoder(name, fps=15, keyframe_interval=50), VideoDecoder()
    send(encoder, 3)
    shown = decoder.feed(encoder.encode(picture(3, 160, 120), T0 + 200))
    assert shown is not None
    assert (shown.keyframe, shown.frame, shown.picture.shape) == (True, 3, (120, 160, 3))


@pytest.mark.parametrize("name", FORMS)
def test_quality_changes_while_running(name: str) -> None:
    encoder, decoder = make_encoder(name, fps=15, keyframe_interval=3, quality=60), VideoDecoder()
    fine = send(encoder, 6)
    encoder.quality = 8
    coarse = send(encoder, 6, first=6)
    assert sum(map(len, coarse)) < 0.7 * sum(map(len, fine))
    assert all(decoder.feed(packet) for packet in fine + coarse)


def test_h264_of_an_odd_size_leaves_out_the_last_row_and_column() -> None:
    shown = VideoDecoder().feed(make_encoder("h264", fps=15).encode(picture(0, 161, 121), T0))
    assert shown is not None
    assert shown.picture.shape == (120, 160, 3)
    with pytest.raises(PebbleError, match="too small"):
        make_encoder("h264", fps=15).encode(np.zeros((8, 8, 3), np.uint8), T0)


def test_h264_is_annex_b_with_parameter_sets_in_every_key_frame() -> None:
    encoder = make_encoder("h264", fps=15, keyframe_interval=4)
    for number, packet in enumerate(send(encoder, 9)):
        assert packet[:7] == bytes([*b"PBVD", 1, 5, number % 4 == 0])
        assert h264.unseal(packet[19:]).startswith(b"\0\0\0\1")
        assert (VideoDecoder().feed(packet) is not None) is (number % 4 == 0)


def test_errors_do_not_pile_up_between_key_frames() -> None:
    encoder, decoder = make_encoder("pbvd", fps=15, keyframe_interval=60), VideoDecoder()
    errors = []
    for number, packet in enumerate(send(encoder, 30)):
        shown = decoder.feed(packet)
        assert shown is not None
        errors.append(cv2.norm(shown.picture, picture(number), cv2.NORM_L2SQR))
    assert max(errors) < 1.5 * errors[0]


def test_differences_are_exact_and_clipped() -> None:
    random = np.random.default_rng(3)
    one, other = random.integers(0, 256, (2, 31, 17, 3), np.uint8)
    wide = one.astype(int)
    assert np.array_equal(subtract(one, other), np.clip(wide - other + 128, 0, 255))
    assert np.array_equal(add(one, other), np.clip(wide + other - 128, 0, 255))


def test_without_pyav_the_error_names_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    packets = send(make_encoder("h264", fps=15), 2)
    monkeypatch.setitem(sys.modules, "av", None)
    assert not pyav.installed()
    with pytest.raises(PebbleError, match=r"pip install 'pebble-robot\[media\]'"):
        make_encoder("h264", fps=15)
    decoder = VideoDecoder()
    assert [decoder.feed(packet) for packet in packets] == [None, None]
    assert "pip install" in decoder.problem
    assert not decoder.wants_keyframe  # it would not help


# -- the reference implementation


VECTORS: dict[str, list[dict[str, Any]]] = vectors("video.json")


@pytest.mark.parametrize("name", VECTORS)
def test_vector(name: str) -> None:
    decoder = VideoDecoder()
    for step in VECTORS[name]:
        shown = decoder.feed(base64.b64decode(step["packet"]))
        expected = step["shows"]
        assert (shown is None) is (expected is None) is decoder.wants_keyframe
        assert (shown and shown.frame) == (expected and expected["frame"])
        assert _cells(shown) == pytest.approx(expected and np.array(expected["cells"]), abs=2)


@pytest.mark.parametrize("keyframe_interval", [1, 4])
def test_the_reference_implementation_reads_our_json_and_pbvd(keyframe_interval: int) -> None:
    for name, unpack in (("json", _paper_json), ("pbvd", _paper_pbvd)):
        encoder = make_encoder(name, fps=15, keyframe_interval=keyframe_interval)
        decoder = VideoDecoder()
        reference = np.zeros(0)
        for number in range(10):
            packet = encoder.encode(small(number), T0 + number * STEP_MS)
            frame, keyframe, jpeg = unpack(packet)
            pixels = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).astype(int)
            reference = pixels if keyframe else np.clip(reference + pixels - 128, 0, 255)
            ours = decoder.feed(packet)
            assert ours is not None
            assert frame == number
            assert np.array_equal(ours.picture, reference)


def _paper_json(packet: bytes) -> tuple[int, bool, bytes]:
    message = json.loads(packet)
    assert set(message) == {"id", "keyframe", "data", "timestamp"}
    assert message["timestamp"] == (T0 + message["id"] * STEP_MS) / 1000
    return message["id"], message["keyframe"], zlib.decompress(base64.b64decode(message["data"], validate=True))


def _paper_pbvd(packet: bytes) -> tuple[int, bool, bytes]:
    frame = int.from_bytes(packet[7:11], "big")
    assert packet[:7] in (b"PBVD\x01\x01\x00", b"PBVD\x01\x02\x00")
    assert int.from_bytes(packet[11:19], "big") == T0 + frame * STEP_MS
    assert cv2.imdecode(np.frombuffer(packet[19:], np.uint8), cv2.IMREAD_COLOR) is not None
    return frame, packet[5] == 1, packet[19:]


def _cells(shown: Any) -> np.ndarray | None:
    if shown is None:
        return None
    height, width, _ = shown.picture.shape
    return shown.picture.reshape(height // 8, 8, width // 8, 8, 3).mean((1, 3))
