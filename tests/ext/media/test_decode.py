"""The decoder: silent rather than wrong, and it says when a key frame would help."""

from __future__ import annotations

import random
import struct
import zlib
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from pebble.errors import PayloadError
from pebble.extensions.media import json_video
from pebble.extensions.media.decode import MAX_PAYLOAD, VideoDecoder
from pebble.extensions.media.jpeg import decode_jpeg, jpeg_size
from pebble.extensions.media.json_video import inflate
from pebble.extensions.media.packets import Picture, PictureKind
from pebble.extensions.media.video import make_encoder
from tests.support import cases

T0 = 1_710_969_600_000


def picture(number: int, width: int = 64, height: int = 48) -> np.ndarray:
    made = np.full((height, width, 3), (90, 120, 70), np.uint8)
    cv2.circle(made, (number * 5 % width, height // 2), 9, (40, 60, 220), -1)
    return made


def stream(name: str, count: int = 12, interval: int = 6, start_ms: int = T0, first: int = 0) -> list[bytes]:
    encoder = make_encoder(name, fps=15, keyframe_interval=interval)
    return [encoder.encode(picture(first + n), start_ms + n * 66) for n in range(count)]


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
    jpeg = cv2.imencode(".jpg", picture(1))[1].tobytes()
    decoder = VideoDecoder()
    shown = decoder.feed(jpeg)
    assert shown is not None
    assert (shown.frame, shown.captured_ms, shown.keyframe, shown.encoding) == (None, None, True, "jpeg")
    assert frames(decoder, [stream("pbvd")[1]]) == [None]
    assert decoder.feed(jpeg + b"\0\0") is not None  # some cameras fill their buffers up


def test_numbers_wrap_after_32_bits_and_a_turn_asked_for_in_the_picture_is_ignored() -> None:
    jpeg = cv2.imencode(".jpg", picture(0))[1].tobytes()
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
    packet = json_video.pack(0, True, None, cv2.imencode(".jpg", picture(0))[1].tobytes())
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
    jpeg = cv2.imencode(".jpg", picture(0))[1].tobytes()
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
    jpeg = cv2.imencode(".jpg", picture(0, 161, 121), options)[1].tobytes()
    assert jpeg_size(jpeg) == (161, 121)
    assert decode_jpeg(jpeg).shape == (121, 161, 3)
    grey = cv2.imencode(".jpg", picture(0)[:, :, 0], options[:2])[1].tobytes()
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
