"""The page decodes exactly what pebble.extensions.media.decode does: the same pictures, and every pixel of them."""

from __future__ import annotations

import base64
import json
import random
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, Route

from pebble.extensions.media.decode import VideoDecoder
from pebble.extensions.media.packets import Picture, PictureKind
from pebble.extensions.media.picture_header import read_header
from pebble.extensions.media.scene import Scene, noise
from pebble.extensions.media.video import make_encoder
from tests.ext.page.browser import tab
from tests.support import ROOT, cases

STATIC = ROOT / "pebble/extensions/page/static"
PAGE = Path(__file__).with_name("pixels.js")


def answer(route: Route) -> None:
    """Serve the page's modules and the test's program."""
    path = urlsplit(route.request.url).path
    program = {"/": b'<!doctype html><script type="module" src="/pixels.js"></script>', "/pixels.js": PAGE.read_bytes()}
    body = program[path] if path in program else (STATIC / path.lstrip("/")).read_bytes()
    route.fulfill(body=body, content_type="text/html" if path == "/" else "text/javascript")


def texts(parts: Sequence[bytes]) -> list[str]:
    return [base64.b64encode(part).decode() for part in parts]


EXACT = ("json", "pbvd")
MOST = 60  # levels by which decoders of H.264 turn the same picture into other colours
T0 = 1_710_969_600_000


@pytest.fixture(scope="module")
def page(browser: Browser) -> Iterator[Any]:
    with tab(browser, "http://localhost/", routes={"**/*": answer}) as one:
        assert one.until("window.ready === true")
        yield one.page


@pytest.fixture
def check(page: Any) -> Any:
    """Feed payloads to both decoders; returns what was shown, which differs by at most so many levels of a pixel."""

    def compare(payloads: Sequence[bytes], most: int = 0) -> list[Any]:
        decoder = VideoDecoder()
        expected, wants, pictures = [], [], []
        for payload in payloads:
            shown = decoder.feed(payload)
            wants.append(decoder.wants_keyframe)
            pictures.append(b"" if shown is None else cv2.cvtColor(shown.picture, cv2.COLOR_BGR2RGBA).tobytes())
            expected.append(
                shown
                and {
                    "encoding": shown.encoding,
                    "key": shown.keyframe,
                    "frame": shown.frame,
                    "capturedMs": shown.captured_ms,
                    "width": shown.picture.shape[1],
                    "height": shown.picture.shape[0],
                }
            )
        passed = [payload if read_header(payload) else b"" for payload in payloads]  # the server sends no other one
        result = page.evaluate("parts => window.compare(...parts)", [texts(passed), texts(pictures)])
        differences = [one.pop("difference") for one in result["shown"] if one]
        assert result["shown"] == expected
        assert all(0 <= difference <= most for difference in differences), differences
        assert result["wants"] == wants
        return expected

    return compare


def stream(
    name: str, count: int, *, size: tuple[int, int] = (96, 64), start_ms: int = T0, **options: Any
) -> list[bytes]:
    """A moving scene with noise, as a camera has it."""
    width, height = size
    encoder = make_encoder(name, fps=15, keyframe_interval=options.pop("interval", 5), **options)
    scene, picture = Scene(width, height), np.empty((height, width, 3), np.uint8)
    made = []
    for number in range(count):
        scene.render(number, picture)
        grain = noise(number, picture.size).reshape(picture.shape) * 24 - 12
        noisy = np.clip(picture + grain, 0, 255).astype(np.uint8)
        made.append(encoder.encode(noisy, start_ms + number * 66))
    return made


@pytest.mark.parametrize("seed", range(cases(1, 3)))
@pytest.mark.parametrize("name", EXACT)
def test_random_faults(check: Any, name: str, seed: int) -> None:
    """Loss, duplication, exchange, damage, other encodings and jumps of time, at random."""
    chance = random.Random(seed)
    sent: list[bytes] = []
    for start in range(12):
        some = stream(
            chance.choice([name, name, name, *EXACT]),
            10,
            size=chance.choice([(32, 24), (32, 32)]),
            start_ms=T0 + start * 660,
        )
        for packet in some:
            sent += [packet] * chance.choice([0, 1, 1, 1, 1, 1, 1, 1, 1, 2])
            if chance.random() < 0.05 and len(sent) > 2:
                sent[-1], sent[-2] = sent[-2], sent[-1]
            if chance.random() < 0.05 and sent:
                sent[-1] = damaged(sent[-1], chance)
    shown = check(sent)
    assert 20 < sum(one is not None for one in shown) < len(shown)


def damaged(packet: bytes, chance: random.Random) -> bytes:
    """Bits flip where a checksum finds them: bits of a bare JPEG's coefficients change the picture unnoticed."""
    changed = bytearray(packet)
    at = chance.randrange(len(packet)) if packet[4:6] not in (b"\x01\x01", b"\x01\x02") else chance.randrange(19)
    changed[at] ^= 1 << chance.randrange(8)
    return bytes(changed) if chance.random() < 0.5 else packet[: chance.randrange(len(packet))]


def vectors() -> dict[str, list[bytes]]:
    steps = json.loads((Path(ROOT) / "tests" / "vectors" / "video.json").read_text())
    return {name: [base64.b64decode(step["packet"]) for step in one] for name, one in steps.items()}


@pytest.mark.parametrize("name", list(vectors()))
def test_streams_of_the_reference_implementation(check: Any, name: str) -> None:
    check(vectors()[name])


def test_limits_of_zlib(check: Any) -> None:
    body = cv2.imencode(".jpg", np.full((32, 32, 3), 99, np.uint8))[1].tobytes()
    packed = zlib.compress(body)
    bomb = zlib.compress(bytes(64 << 20), 9)
    bodies = [packed, packed[:-1], packed + b"x", bomb, zlib.compress(b""), packed[:-4] + b"abcd"]
    shown = check([Picture(PictureKind.ZLIB_JPEG, 7, T0, one).pack() for one in bodies])
    assert [one is not None for one in shown] == [True, *[False] * 5]


def frames(shown: Sequence[Any]) -> list[int]:
    return [one["frame"] for one in shown if one]


def test_h264_after_faults(check: Any) -> None:
    """Every picture is shown in order; what cannot be decoded waits for a key frame."""
    packets = stream("h264", 20, size=(320, 240), interval=10, quality=40)
    whole, lost, twice = packets, [*packets[:4], *packets[5:12]], [*packets[:3], packets[2], *packets[3:12]]
    numbers = frames(check(whole, MOST))
    assert len(numbers) == 20
    assert frames(check(lost, MOST)) == [*numbers[:4], *numbers[10:12]]
    assert frames(check(twice, MOST)) == [*numbers[:3], *numbers[10:12]]
    smaller = stream("h264", 4, size=(320, 180), interval=4, quality=40)
    assert len(frames(check([*packets[:3], *smaller, *packets[10:12]], MOST))) == 9
    mixed = [*packets[:2], *stream("pbvd", 2, size=(320, 240), quality=60), *packets[2:4], *packets[10:12]]
    assert len(frames(check(mixed, MOST))) == 6
