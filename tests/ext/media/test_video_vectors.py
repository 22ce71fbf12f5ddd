"""What the reference implementation sends, we show; what it cannot have meant, we do not."""

from __future__ import annotations

import base64
import json
import zlib
from typing import Any

import cv2
import numpy as np
import pytest

from pebble.extensions.media.decode import VideoDecoder
from pebble.extensions.media.video import make_encoder
from tests.vectors import make_video

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
