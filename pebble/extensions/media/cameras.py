"""A robot's camera in three lines of Python: `for picture in camera("goob"): …`."""

from __future__ import annotations

import contextlib
import logging
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np

from pebble.config import default_run_folder, load
from pebble.config.tree import Robot
from pebble.contract.identity import Identity
from pebble.errors import ConfigError, DeviceError, PayloadError, PebbleError
from pebble.extensions.media.frames import Frame, FrameReader

log = logging.getLogger(__name__)

Picture = np.ndarray[Any, np.dtype[np.uint8]]
STREAM = "camera"


def camera(
    robot: str | Path,
    *,
    width: int | None = None,
    views: bool = False,
    timeout: float | None = None,
    env: Mapping[str, str] = os.environ,
) -> Camera:
    """Iterate over the pictures of a robot on this machine: always the newest, never a queue of old ones.

    ``robot`` is its id (``"goob"``), its base topic (``"pebble/robots/goob"``), its config file, or its run directory.
    Pictures are arrays of (height, width, 3) bytes, blue first, and may be changed. With ``width`` they are scaled to
    that many pixels, which for a JPEG camera also saves most of the decoding. With ``views`` they may be views of the
    camera's memory: use them at once, then discard the result if ``Camera.frame.valid()`` is false.

    Raises DeviceError if no such robot runs here, and while waiting if no picture comes for ``timeout`` seconds.
    """
    if width is not None and width <= 0:
        raise PebbleError(f"camera: a width of {width} pixels shows nothing")
    return Camera(_run_dir(robot, env), width=width, views=views, timeout=timeout)


class Camera:
    """The pictures of one camera. Iterate over it; close it, or use it in a ``with`` statement, when you are done."""

    def __init__(self, run_dir: Path, *, width: int | None, views: bool, timeout: float | None) -> None:
        self.frame: Frame | None = None  # of the last picture: its time, its writer, and whether it is still valid
        self._width = width
        self._timeout = timeout
        self._run_dir = run_dir
        self._reader = FrameReader(run_dir, STREAM, views=views).open()

    @property
    def counters(self) -> dict[str, int]:
        """Numbers of frames that were read, skipped and lost so far: see `FrameReader`."""
        return self._reader.counters.snapshot()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Picture:
        end = None if self._timeout is None else time.monotonic() + self._timeout
        while True:
            remaining_s = None if end is None else max(0.0, end - time.monotonic())
            frame = self._reader.read(remaining_s)
            if frame is None and self._reader.closed:
                raise StopIteration
            if frame is None:
                raise DeviceError(f"no picture for {self._timeout:g} s from the camera in {self._run_dir}")
            picture = self._picture(frame)
            if picture is not None:  # else the frame cannot be decoded: the next one is waited for
                return picture

    def newest(self) -> Picture | None:
        """Return the newest picture that was not returned before, or None. Does not wait."""
        frame = self._reader.read(0.0)
        return None if frame is None else self._picture(frame)

    def _picture(self, frame: Frame) -> Picture | None:
        """Return the picture of a frame; None, with a warning, if it cannot be decoded."""
        try:
            picture = frame.picture(self._width)
        except PayloadError as error:
            log.warning("%s", error)
            return None
        self.frame = frame
        return picture

    def close(self) -> None:
        """End the iteration, from any thread."""
        self._reader.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        with contextlib.suppress(AttributeError):  # never opened
            self.close()


def _run_dir(robot: str | Path, env: Mapping[str, str]) -> Path:
    """Return the run directory of a running robot, named as in :func:`camera`. Raises DeviceError."""
    text, path = str(robot), Path(robot)
    # A text such as "goob" is an id, also where there is a folder of that name.
    if path.is_dir() and (isinstance(robot, Path) or path.is_absolute()):
        return path.absolute()
    places = [load(path, env, lenient=True).run_dir()] if text.endswith(".json") else _usual_places(text, env)
    for place in places:
        if place.is_dir():
            return place
    looked = ", ".join(map(str, places))
    raise DeviceError(
        f"no robot {text} runs on this machine (no {looked}): is it up, and does its config name a run_dir? "
        "Then give its config file instead of its name"
    )


def _usual_places(robot: str, env: Mapping[str, str]) -> list[Path]:
    """Return the usual run directories of a robot: in this environment, and outside of a login session."""
    levels = robot.split("/")
    if len(levels) not in (1, 3):
        raise ConfigError(f"camera: {robot} is neither a robot's id nor a base topic nor a config file")
    defaults = Robot(id=robot)
    identity = Identity(*levels) if len(levels) == 3 else Identity(defaults.system, defaults.type, robot)
    without_login = {key: text for key, text in env.items() if key not in ("XDG_RUNTIME_DIR", "RUNTIME_DIRECTORY")}
    return list(dict.fromkeys(default_run_folder(identity.base, variables) for variables in (env, without_login)))
