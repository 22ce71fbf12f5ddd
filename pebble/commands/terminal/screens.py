"""Outputs for pictures and sound: a window where there is a screen, files where there is none."""

import os
import shutil
import subprocess
import time
import wave
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import typer

from pebble.client.media_receiver import MediaReceiver
from pebble.client.overlays import Overlays
from pebble.commands.terminal import show
from pebble.errors import PebbleError
from pebble.media.sound import ReceivedSound

_PICTURE_EVERY_S = 1.0
_OUTLINE, _INK, _PAPER = (80, 220, 80), (80, 255, 80), (0, 0, 0)  # BGR
_FONT = cv2.FONT_HERSHEY_SIMPLEX


class Screen(ABC):
    """Shows a receiver's newest picture on each call. ``open``: is the window still open?"""

    open = True
    can_play = True  # can it play or store sound?

    @abstractmethod
    def show(self, receiver: MediaReceiver) -> None: ...

    @abstractmethod
    def summary(self) -> str:
        """One line: what was shown, or where it was written."""

    @abstractmethod
    def close(self) -> None:
        """Close files, processes and windows."""


@contextmanager
def best(name: str, folder: Path | None) -> Iterator[Screen]:
    """A window if there is a screen and no ``folder``, else files. Raises PebbleError if neither can be created."""
    screen = None if folder is not None else _window(name)
    if screen is None:
        screen = Files(folder or Path(f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"))
    try:
        yield screen
    finally:
        screen.close()


def save_picture(picture: np.ndarray[Any, Any], file: Path) -> None:
    """Write a BGR picture in the format of the file's suffix. Raises PebbleError if that fails."""
    try:
        written = cv2.imwrite(str(file), picture)
    except cv2.error:
        raise PebbleError(f"{file}: cannot write this kind of picture, name it .png or .jpg") from None
    if not written:
        raise PebbleError(f"{file} cannot be written")


def with_overlays(picture: np.ndarray[Any, Any], overlays: Overlays) -> np.ndarray[Any, Any]:
    """A copy of a BGR picture with shapes and labels drawn over it."""
    drawn = picture.copy()
    height, width = drawn.shape[:2]
    size = np.array([width - 1, height - 1])
    thick = max(1, round(height / 240))
    for shape in overlays.shapes:
        points = np.round(np.array(shape) * size).astype(np.int32)
        cv2.polylines(drawn, [points], True, _OUTLINE, thick, cv2.LINE_AA)
    for label in overlays.labels:
        (wide, high), _ = cv2.getTextSize(label.text, _FONT, height / 600, thick)
        wanted = np.array(label.at) * size + (-wide / 2, high / 2)
        at = np.clip(np.round(wanted), (0, high), size - (wide, 0)).astype(int).tolist()
        for ink, weight in ((_PAPER, 3 * thick), (_INK, thick)):  # dark around bright: legible on every picture
            cv2.putText(drawn, label.text, at, _FONT, height / 600, ink, weight, cv2.LINE_AA)
    return drawn


class Files(Screen):
    """Writes a PNG once a second and the sound to a WAV file, with a new file for each change of format."""

    def __init__(self, folder: Path, clock: Callable[[], float] = time.monotonic) -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise PebbleError(f"{folder} cannot be made: {error.strerror}") from None
        self._folder, self._clock = folder, clock
        self._pictures = self._waves = 0
        self._due = 0.0
        self._seconds = 0.0
        self._wave: wave.Wave_write | None = None
        self._format = (0, 0)

    def show(self, receiver: MediaReceiver) -> None:
        for received in receiver.take_sounds():
            self._write(received)
        now = self._clock()
        if now < self._due:
            return
        self._due = now + _PICTURE_EVERY_S
        if receiver.newest is not None:
            self._pictures += 1
            picture = with_overlays(receiver.newest.picture, receiver.overlays.current(now))
            save_picture(picture, self._folder / f"{self._pictures:04}.png")
        typer.echo(
            f"video  {receiver.summary('video', now) or 'nothing yet'}   "
            f"audio  {receiver.summary('audio', now) or 'nothing yet'}{_stop(receiver)}"
        )

    def summary(self) -> str:
        return f"{self._folder}: {self._pictures} pictures, {self._seconds:.1f} s of sound"

    def close(self) -> None:
        if self._wave is not None:
            self._wave.close()
            self._wave = None

    def _write(self, received: ReceivedSound) -> None:
        if self._wave is None or self._format != (received.rate, received.channels):
            self._begin(received)
        if self._wave is not None:
            self._wave.writeframes(received.pcm)
            self._seconds += len(received.samples) / received.rate

    def _begin(self, received: ReceivedSound) -> None:
        self.close()
        self._waves += 1
        name = "sound.wav" if self._waves == 1 else f"sound-{self._waves}.wav"
        self._wave = wave.open(str(self._folder / name), "wb")  # noqa: SIM115  (closed by close())
        self._wave.setnchannels(received.channels)
        self._wave.setsampwidth(2)
        self._wave.setframerate(received.rate)
        self._format = (received.rate, received.channels)


class Window(Screen):
    """A window by Tk, which comes with Python; OpenCV's headless wheel has no windows."""

    def __init__(self, name: str) -> None:
        import tkinter

        self._tk = tkinter
        self._root = tkinter.Tk()  # raises TclError without a screen
        self._root.title(f"{name} - Pebble")
        self._root.protocol("WM_DELETE_WINDOW", self._leave)
        self._label = tkinter.Label(self._root)
        self._label.pack()
        self._line = tkinter.Label(self._root, anchor="w")
        self._line.pack(fill="x")
        self._loudspeaker = Loudspeaker()
        self.can_play = self._loudspeaker.installed
        self._image: Any = None  # Tk shows it only while it is referenced
        self._shown: tuple[object, Overlays] = (None, Overlays())
        self._count = 0

    def show(self, receiver: MediaReceiver) -> None:
        newest, now = receiver.newest, time.monotonic()
        overlays = receiver.overlays.current(now)
        for received in receiver.take_sounds():
            self._loudspeaker.play(received)
        if newest is not None and (newest is not self._shown[0] or overlays != self._shown[1]):
            self._count += newest is not self._shown[0]
            self._shown = newest, overlays
            ok, data = cv2.imencode(".ppm", with_overlays(newest.picture, overlays))
            if ok:
                self._image = self._tk.PhotoImage(data=data.tobytes(), format="PPM")
                self._label.configure(image=self._image)
        self._line.configure(text=(receiver.summary("video", now) or "no picture yet") + _stop(receiver))
        with suppress(self._tk.TclError):  # closed a moment ago
            self._root.update()

    def summary(self) -> str:
        return f"{self._count} pictures shown"

    def close(self) -> None:
        self._loudspeaker.close()
        with suppress(self._tk.TclError):
            self._root.destroy()

    def _leave(self) -> None:
        self.open = False


class Loudspeaker:
    """Plays through aplay; drops sound that aplay does not accept at once, so that playback does not lag."""

    def __init__(self) -> None:
        self._program = shutil.which("aplay")
        self._process: subprocess.Popen[bytes] | None = None
        self._format = (0, 0)

    @property
    def installed(self) -> bool:
        return self._program is not None

    def play(self, received: ReceivedSound) -> None:
        if self._process is None or self._format != (received.rate, received.channels):
            self._begin(received.rate, received.channels)
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):  # full, or aplay has ended
                os.write(self._process.stdin.fileno(), received.pcm)

    def close(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.communicate()

    def _begin(self, rate: int, channels: int) -> None:
        self.close()
        if self._program is None:
            return
        self._format = (rate, channels)
        command = [self._program, "-q", "-t", "raw", "-f", "S16_LE", "-c", str(channels), "-r", str(rate), "-"]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.DEVNULL)
        if self._process.stdin is not None:
            os.set_blocking(self._process.stdin.fileno(), False)


def _stop(receiver: MediaReceiver) -> str:
    """What to show beside the rates if the robot is stopped by an emergency stop."""
    line = show.stopped_line(receiver.estop, time.time())
    return line and f"   EMERGENCY STOP: {line}"


def _window(name: str) -> Screen | None:
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return None
    try:
        return Window(name)
    except Exception as error:  # noqa: BLE001  (no Tk in this Python, or no screen: write files instead)
        typer.echo(f"no window: {error}", err=True)
        return None
