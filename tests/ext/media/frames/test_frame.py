"""Every pixel format becomes the same picture, and garbage becomes an error."""

from __future__ import annotations

import random

import cv2
import numpy as np
import pytest

from pebble.errors import PayloadError
from pebble.extensions.media.frames import Frame
from pebble.extensions.media.frames.frame import PICTURE_FORMATS, FrameInfo, picture

WIDTH, HEIGHT = 64, 48


def _scene() -> np.ndarray:
    """Smooth, because formats with less colour than pixels blur edges."""
    ramp = np.linspace(40, 200, WIDTH, dtype=np.uint8)
    scene = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    scene[..., 0], scene[..., 1], scene[..., 2] = ramp, ramp[::-1], np.linspace(60, 180, HEIGHT)[:, None]
    return scene


def _yuyv(scene: np.ndarray) -> np.ndarray:
    packed = np.empty((HEIGHT, WIDTH, 2), np.uint8)
    i420 = cv2.cvtColor(scene, cv2.COLOR_BGR2YUV_I420)
    packed[..., 0] = i420[:HEIGHT]
    chroma = i420[HEIGHT:].reshape(2, HEIGHT // 2, WIDTH // 2).repeat(2, axis=1)
    packed[:, ::2, 1], packed[:, 1::2, 1] = chroma
    return packed


def _nv12(scene: np.ndarray) -> np.ndarray:
    i420 = cv2.cvtColor(scene, cv2.COLOR_BGR2YUV_I420)
    chroma = i420[HEIGHT:].reshape(2, -1)
    return np.concatenate([i420[:HEIGHT].reshape(-1), chroma.T.reshape(-1)])


def _mjpeg(scene: np.ndarray) -> np.ndarray:
    return cv2.imencode(".jpg", scene, [cv2.IMWRITE_JPEG_QUALITY, 95])[1]


MAKERS = {"bgr24": np.asarray, "nv12": _nv12, "yuyv": _yuyv, "mjpeg": _mjpeg}


@pytest.mark.parametrize("form", PICTURE_FORMATS)
@pytest.mark.parametrize("writable", [True, False])
def test_every_format_shows_the_same(form: str, writable: bool) -> None:
    data = MAKERS[form](_scene()).reshape(-1).copy()
    data.flags.writeable = writable  # a view is not
    found = Frame(FrameInfo(format=form, width=WIDTH, height=HEIGHT), data, shared=False).picture()
    assert found.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(found.astype(int) - _scene()).mean() < 4


@pytest.mark.parametrize("form", PICTURE_FORMATS)
@pytest.mark.parametrize("width", [8, 20, 100])
def test_a_reader_may_want_another_width(form: str, width: int) -> None:
    found = picture(MAKERS[form](_scene()).reshape(-1), FrameInfo(format=form, width=WIDTH, height=HEIGHT), width)
    assert found.shape == (width * HEIGHT // WIDTH, width, 3)
    assert abs(found.mean() - _scene().mean()) < 4


def test_rows_may_be_longer_than_their_pixels() -> None:
    padded = np.zeros((HEIGHT, WIDTH * 3 + 10), np.uint8)
    padded[:, : WIDTH * 3] = _scene().reshape(HEIGHT, -1)
    info = FrameInfo(format="bgr24", width=WIDTH, height=HEIGHT, stride=WIDTH * 3 + 10)
    assert (picture(padded.reshape(-1)[:-10], info) == _scene()).all()


@pytest.mark.parametrize(
    "info",
    [
        FrameInfo(format="s16le", rate=16000, channels=1),
        FrameInfo(),
        FrameInfo(format="bgr24", width=-1, height=-1),
        FrameInfo(format="bgr24", width=1 << 40, height=1 << 40),
        FrameInfo(format="bgr24", width=64, height=48, stride=1),
        FrameInfo(format="nv12", width=63, height=48),
        FrameInfo(format="mjpeg", width=64, height=48),
    ],
)
def test_what_is_no_picture_is_an_error(info: FrameInfo) -> None:
    with pytest.raises(PayloadError):
        picture(np.zeros(1000, np.uint8), info)
    with pytest.raises(PayloadError):
        picture(np.zeros(0, np.uint8), info)


def test_garbage_is_an_error_and_never_a_crash() -> None:
    chance = random.Random(1)
    jpeg = _mjpeg(_scene()).reshape(-1)
    for _ in range(2000):
        data = jpeg[: chance.randrange(jpeg.size)].copy()
        data[chance.randrange(data.size) if data.size else 0 :] = chance.randrange(256)
        numbers = [chance.choice([-1, 0, 1, 2, 48, 64, 4096, 1 << 62]) for _ in range(3)]
        info = FrameInfo(format=chance.choice(PICTURE_FORMATS), width=numbers[0], height=numbers[1], stride=numbers[2])
        try:
            found = picture(data, info, chance.choice([None, 1, 32]))
        except PayloadError:
            continue
        assert found.ndim == 3
