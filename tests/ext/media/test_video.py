"""Encoders: what they make is what our decoder shows, at the size, rate and moment asked for."""

from __future__ import annotations

import base64
import json
import sys
import zlib
from typing import Any

import cv2
import numpy as np
import pytest

from pebble.errors import ConfigError, PebbleError
from pebble.extensions.media import h264, pyav
from pebble.extensions.media.decode import VideoDecoder
from pebble.extensions.media.jpeg import Pixels
from pebble.extensions.media.jpeg_delta import add, subtract
from pebble.extensions.media.scene import Scene
from pebble.extensions.media.video import VideoEncoder, make_encoder
from tests.vectors import make_video

T0 = 1_710_969_600_000
FORMS = ("json", "pbvd", "h264")


def picture(number: int, width: int = 320, height: int = 240) -> Pixels:
    made = np.empty((height, width, 3), np.uint8)
    Scene(width, height).render(number, made)
    return made


def send(encoder: VideoEncoder, count: int, first: int = 0, **asked: bool) -> list[bytes]:
    return [encoder.encode(picture(n), T0 + n * 66, **asked) for n in range(first, first + count)]


def _squared_error(one: Pixels, other: Pixels) -> float:
    return cv2.norm(one, other, cv2.NORM_L2SQR) / one.size


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


@pytest.mark.parametrize("name", FORMS)
def test_a_clock_before_1970_is_no_reason_not_to_send(name: str) -> None:
    decoder = VideoDecoder()
    shown = decoder.feed(make_encoder(name, fps=15).encode(picture(0), -1))
    assert shown is not None, decoder.problem
    assert shown.captured_ms is None


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


def test_h264_sharpens_what_rests_within_two_seconds_and_sends_little_of_it() -> None:
    encoder, decoder = make_encoder("h264", fps=15, keyframe_interval=60), VideoDecoder()
    packets = [*send(encoder, 5), *(encoder.encode(picture(5), T0 + n * 66) for n in range(5, 40))]
    shown = [decoder.feed(packet) for packet in packets]
    blurred, sharp = (cv2.PSNR(one.picture, picture(5)) for one in (shown[6], shown[34]) if one is not None)
    assert sharp > blurred + 6
    assert sum(map(len, packets[30:])) < len(packets[0])


def test_errors_do_not_pile_up_between_key_frames() -> None:
    encoder, decoder = make_encoder("pbvd", fps=15, keyframe_interval=60), VideoDecoder()
    errors = []
    for number, packet in enumerate(send(encoder, 30)):
        shown = decoder.feed(packet)
        assert shown is not None
        errors.append(_squared_error(shown.picture, picture(number)))
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


VECTORS: dict[str, list[dict[str, Any]]] = json.loads(make_video.FILE.read_text())


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
            packet = encoder.encode(make_video.camera(number), make_video.FIRST_MS + number * make_video.STEP_MS)
            frame, keyframe, jpeg = unpack(packet)
            pixels = make_video.pixels(jpeg)
            reference = pixels if keyframe else np.clip(reference + pixels - 128, 0, 255)
            ours = decoder.feed(packet)
            assert ours is not None
            assert frame == number
            assert np.array_equal(ours.picture, reference)


def _paper_json(packet: bytes) -> tuple[int, bool, bytes]:
    message = json.loads(packet)
    assert set(message) == {"id", "keyframe", "data", "timestamp"}
    assert message["timestamp"] == (make_video.FIRST_MS + message["id"] * make_video.STEP_MS) / 1000
    return message["id"], message["keyframe"], zlib.decompress(base64.b64decode(message["data"], validate=True))


def _paper_pbvd(packet: bytes) -> tuple[int, bool, bytes]:
    frame = int.from_bytes(packet[7:11], "big")
    assert packet[:7] in (b"PBVD\x01\x01\x00", b"PBVD\x01\x02\x00")
    assert int.from_bytes(packet[11:19], "big") == make_video.FIRST_MS + frame * make_video.STEP_MS
    assert cv2.imdecode(np.frombuffer(packet[19:], np.uint8), cv2.IMREAD_COLOR) is not None
    return frame, packet[5] == 1, packet[19:]


def _cells(shown: Any) -> np.ndarray | None:
    if shown is None:
        return None
    height, width, _ = shown.picture.shape
    return shown.picture.reshape(height // 8, 8, width // 8, 8, 3).mean((1, 3))
