"""Views look into shared memory, or are not used. Every pixel format becomes the same picture."""

from __future__ import annotations

import gc
import json
import random
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import zenoh
import zenoh.shm

from pebble import camera
from pebble.config import default_run_folder
from pebble.errors import PayloadError, PebbleError, TransportError
from pebble.extensions.media.frames import Frame, FrameInfo, FrameReader, FrameWriter, views
from pebble.extensions.media.frames.frame import PICTURE_FORMATS, picture
from tests.ext.av.media_rig import Filming
from tests.locking import needs_shared_memory
from tests.support import ROOT, WAIT_S, Child, until

LARGE = 500_000  # bytes: the allocator's margin holds no such frame


@pytest.fixture(autouse=True)
def untested(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every test begins like a new process."""
    monkeypatch.setattr(views, "self_test", views.SelfTest())


def test_what_a_view_writes_is_in_the_buffer_and_the_other_way_round() -> None:
    assert views.why_unavailable() == ""
    pool = zenoh.shm.ShmProvider.default_backend(1 << 22)
    for size in (1, 7, 4096, 65_537, 3_000_001):
        buffer = pool.alloc(size, policy=zenoh.shm.GarbageCollect())
        view = views.array(buffer, size, writable=True, owner=pool)
        assert view is not None
        view[:] = 7
        view[-1] = 9
        assert bytes(buffer) == b"\7" * (size - 1) + b"\x09"
        buffer[:] = bytes(size)
        assert not view.any()


def test_a_readers_view_cannot_be_made_writable() -> None:
    pool = zenoh.shm.ShmProvider.default_backend(1 << 20)
    buffer = pool.alloc(100)
    buffer[:] = bytes(range(100))
    view = views.array(zenoh.ZBytes(buffer).as_shm(), 100)
    assert view is not None
    assert view.tobytes() == bytes(range(100))
    with pytest.raises(ValueError, match="read-only"):
        view[0] = 1
    with pytest.raises(ValueError, match="WRITEABLE"):
        view.flags.writeable = True


def test_an_array_keeps_its_memory() -> None:
    pool = zenoh.shm.ShmProvider.default_backend(1 << 20)
    buffer = pool.alloc(500_000)
    buffer[:] = b"x" * 500_000
    view = views.array(zenoh.ZBytes(buffer).as_shm(), 500_000)
    assert view is not None
    corner = view.reshape(500, 1000)[400:, ::3]
    del view, buffer
    gc.collect()
    with pytest.raises(zenoh.ZError):
        pool.alloc(600_000, policy=zenoh.shm.GarbageCollect())
    assert corner.tobytes() == b"x" * corner.size
    del corner
    pool.garbage_collect()
    assert pool.alloc(600_000)


MISMATCHES = {
    "another version": ("KNOWN_VERSIONS", frozenset({"1.9.0"}), "1.9.0"),
    "the address is nowhere": ("_printed", lambda _: 1, "none of its words"),
    "nothing is printed": (
        "_printed",
        Mock(side_effect=views.UnexpectedLayoutError("ZShmMut does not print")),
        "does not print",
    ),
    "it is a word further": ("_only", lambda found: min(found[0]) + 8, "has moved"),
    "buffers are smaller": ("_only", lambda _: 4096, "too small"),
}


@pytest.mark.parametrize(("name", "value", "reason"), MISMATCHES.values(), ids=MISMATCHES)
def test_on_any_mismatch_it_reports_why(
    name: str, value: object, reason: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(views, name, value)
    assert reason in views.why_unavailable()
    assert reason in caplog.text
    assert views.array(object(), 100) is None


def test_without_views_frames_are_copied(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(views, "KNOWN_VERSIONS", frozenset())
    with (
        FrameWriter(tmp_path, "camera", capacity=50_000) as writer,
        FrameReader(tmp_path, "camera", views=True) as reader,
    ):
        assert until(lambda: writer.wanted)
        assert writer.slot(50_000) is None
        assert writer.write(np.full(50_000, 3, np.uint8), FrameInfo())
        frame = reader.read(5)
        assert frame is not None
        assert frame.shared
        assert frame.valid()
        frame.data[0] = 4  # a copy of our own
        assert frame.data.tobytes() == b"\4" + b"\3" * 49_999


def test_a_released_frame_is_not_to_be_used_and_what_was_taken_from_it_stays(tmp_path: Path) -> None:
    with (
        FrameWriter(tmp_path, "camera", capacity=50_000) as writer,
        FrameReader(tmp_path, "camera", views=True) as reader,
    ):
        assert until(lambda: writer.wanted)
        slot = writer.slot(30_000)
        assert slot is not None
        retained = slot.array
        retained[:] = 5
        assert slot.send(FrameInfo(format="bgr24", width=100, height=100))
        with pytest.raises(TransportError, match="been sent"):
            _ = slot.array
        with pytest.raises(TransportError, match="been sent"):
            slot.send(FrameInfo())
        frame = reader.read(5)
        assert frame is not None
        picture = frame.picture()
        assert np.shares_memory(picture, frame.data)
        frame.release()
        frame.release()
        assert not frame.valid()
        with pytest.raises(TransportError, match="released"):
            _ = frame.data
        assert picture.min() == picture.max() == 5
    assert picture.sum() == 5 * 30_000  # both ends are closed, and it is still there
    retained[:] = 6  # forbidden, and harmless
    assert picture.sum() == 6 * 30_000


def test_slots_that_are_forgotten_are_free_again(tmp_path: Path) -> None:
    with FrameWriter(tmp_path, "camera", capacity=50_000) as writer, FrameReader(tmp_path, "camera"):
        assert until(lambda: writer.wanted)
        for _ in range(50):
            slot = writer.slot(50_000)
            assert slot is not None
            slot.array[:] = 1


HOLDER = """
import sys; from pathlib import Path; from pebble.extensions.media.frames import *
with FrameReader(Path(sys.argv[1]), "camera", views=True) as reader:
    frame = reader.read(10); data = frame.data
    print(frame.valid(), set(data.tolist()), flush=True); sys.stdin.readline()
    print(frame.valid(), set(data.tolist()), flush=True)
"""


@needs_shared_memory
def test_a_frame_that_was_held_too_long_is_invalid(tmp_path: Path) -> None:
    """Its process is stopped, so that the writer takes the memory back; afterwards it looks at its frame again."""
    with FrameWriter(tmp_path, "camera", capacity=LARGE, slots=2) as writer:
        holder = Child(
            [sys.executable, "-X", "dev", "-c", HOLDER, str(tmp_path)],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert until(lambda: writer.wanted)
            assert writer.write(b"\1" * LARGE, FrameInfo())
            assert holder.stdout is not None
            assert holder.stdout.readline() == "True {1}\n"
            holder.send_signal(signal.SIGSTOP)
            with FrameReader(tmp_path, "camera") as reader:
                assert until(
                    lambda: writer.write(b"\2" * LARGE, FrameInfo()) and writer.counters["reclaimed"], step=0.02
                )
                assert until(
                    lambda: (
                        writer.write(b"\2" * LARGE, FrameInfo()) and reader.read(1) and reader.counters["shared"] > 3
                    ),
                    step=0.02,
                )
            holder.send_signal(signal.SIGCONT)
            valid, found = holder.communicate("\n", timeout=WAIT_S)[0].split(maxsplit=1)
            assert (valid, "2" in found) == ("False", True)
        finally:
            holder.kill()
            holder.wait()


# -- pictures


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


# -- three lines of anybody's Python read a robot's camera


@pytest.fixture
def env() -> Iterator[dict[str, str]]:
    with tempfile.TemporaryDirectory(prefix="pebble-") as folder:  # pytest's own may be too long for a socket
        yield {"TMPDIR": folder}


@needs_shared_memory
def test_pictures_of_a_robot_by_its_id_its_base_topic_its_run_directory_and_its_config(
    env: dict[str, str], tmp_path: Path
) -> None:
    config = tmp_path / "goob.json"
    config.write_text(json.dumps({"robot": {"id": "goob"}}))
    run_dir = default_run_folder("pebble/robots/goob", env)
    with Filming(run_dir):
        for robot in ("goob", "pebble/robots/goob", run_dir, config, str(config)):
            with camera(robot, env=env, timeout=WAIT_S) as pictures:
                picture = next(pictures)
                assert (picture.shape, picture[5, 5].tolist()) == ((240, 320, 3), [10, 20, 30])
                picture[:] = 0  # it is ours
        with camera("goob", env=env, views=True, timeout=WAIT_S) as pictures:
            assert not next(pictures).flags.writeable, "it is the camera's own memory"
            assert pictures.frame is not None
            assert pictures.frame.valid()
            assert pictures.frame.info.captured_ns > 0


def test_no_such_robot_is_one_clear_sentence(env: dict[str, str]) -> None:
    with pytest.raises(PebbleError, match=r"no robot fred runs on this machine \(no .*pebble-.*config"):
        camera("fred", env=env)
    for wrong in ("a/b", "", "go#b", "/nowhere/robot.json"):
        with pytest.raises(PebbleError):
            camera(wrong, env=env)
    with pytest.raises(PebbleError, match="width"):
        camera("fred", width=0)


def test_a_robot_without_a_picture_raises_after_the_timeout_and_closing_ends_the_iteration(env: dict[str, str]) -> None:
    default_run_folder("pebble/robots/goob", env).mkdir(parents=True)
    with pytest.raises(PebbleError, match=r"no picture for 0\.1 s"):
        next(camera("goob", env=env, timeout=0.1))
    pictures = camera("goob", env=env)
    threading.Timer(0.1, pictures.close).start()
    assert list(pictures) == []
