"""Three lines of anybody's Python read a robot's camera."""

from __future__ import annotations

import json
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pebble import camera
from pebble.config import default_run_folder
from pebble.errors import PebbleError
from pebble.extensions.media.frames import FrameInfo, FrameWriter
from tests.locking import needs_shared_memory

WIDTH, HEIGHT = 320, 240


class Filming:
    """A camera of one colour, 50 times a second."""

    def __init__(self, folder: Path) -> None:
        self._picture = np.full((HEIGHT, WIDTH, 3), (10, 20, 30), np.uint8)
        self._writer = FrameWriter(folder, "camera", capacity=self._picture.size).open()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._ended.wait(0.02):
            info = FrameInfo(format="bgr24", width=WIDTH, height=HEIGHT, captured_ns=time.monotonic_ns())
            self._writer.write(b"no picture", FrameInfo(format="text"))
            self._writer.write(self._picture, info)

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self._writer.close()


@pytest.fixture
def env() -> Iterator[dict[str, str]]:
    with tempfile.TemporaryDirectory(prefix="pebble-") as folder:  # pytest's own may be too long for a socket
        yield {"TMPDIR": folder}


@pytest.fixture
def filming(env: dict[str, str]) -> Iterator[Filming]:
    filming = Filming(default_run_folder("pebble/robots/goob", env))
    yield filming
    filming.close()


@needs_shared_memory
def test_pictures_of_a_robot_by_its_id_its_base_topic_its_run_directory_and_its_config(
    filming: Filming, env: dict[str, str], tmp_path: Path
) -> None:
    config = tmp_path / "goob.json"
    config.write_text(json.dumps({"robot": {"id": "goob"}}))
    for robot in ("goob", "pebble/robots/goob", default_run_folder("pebble/robots/goob", env), config, str(config)):
        with camera(robot, env=env, timeout=5) as pictures:
            picture = next(pictures)
            assert (picture.shape, picture[5, 5].tolist()) == ((HEIGHT, WIDTH, 3), [10, 20, 30])
            picture[:] = 0  # it is ours
    with camera("goob", env=env, views=True, timeout=5) as pictures:
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
