"""What the tests of av_daemon share: a writer that only remembers, and configs of one device."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import cache
from typing import Any

import msgspec
import numpy as np

from pebble.extensions.media.frames import FrameInfo
from pebble.extensions.media.speech import Speech
from pebble.services.av_daemon.config import AvDaemon
from pebble.services.av_daemon.source import Source
from pebble.transports.counters import Counters


def options(*, video: dict[str, Any] | None = None, audio: dict[str, Any] | None = None, **more: Any) -> AvDaemon:
    return msgspec.convert({"video": video or {}, "audio": audio or {}, **more}, AvDaemon)


def grabbed(source: Source) -> tuple[FrameInfo, np.ndarray]:
    """The next frame of a source."""
    capture = source.grab()
    return capture.info, capture.pixels(np.empty(capture.size, np.uint8)).copy()


@cache
def _speech() -> Speech:
    return Speech(16_000)


def is_speech(chunks: Sequence[tuple[int, np.ndarray]], start: int) -> bool:
    """Is every chunk of 20 ms at 16 kHz, with its time in ns, what was said then? ``start``: sample of the first.

    On a busy machine some may be missing, but none may be elsewhere.
    """
    speech, first_ns = _speech(), chunks[0][0]
    places = [start + 320 * round((at_ns - first_ns) / 20_000_000) for at_ns, _ in chunks]
    pairs = zip(places, chunks, strict=True)
    return all(np.array_equal(speech.samples(place, 320)[:, 0], sound) for place, (_, sound) in pairs)


class Remembering:
    """A FrameWriter without memory to share; ``born`` says whether frames may be born in it."""

    def __init__(self, *, wanted: bool = True, born: bool = True) -> None:
        self.counters = Counters()
        self.problem = ""
        self.wanted = wanted
        self.frames: list[tuple[FrameInfo, np.ndarray]] = []
        self.threads: set[int] = set()
        self._born = born

    @property
    def readers(self) -> int:
        return int(self.wanted)

    def write(self, data: np.ndarray, info: FrameInfo) -> bool:
        self.threads.add(threading.get_ident())
        self.frames.append((info, data.copy()))
        return True

    def slot(self, size: int) -> RememberingSlot | None:
        return RememberingSlot(self, size) if self._born else None


class RememberingSlot:
    def __init__(self, writer: Remembering, size: int) -> None:
        self.array = np.full(size, 255, np.uint8)
        self._writer = writer

    def send(self, info: FrameInfo) -> bool:
        self._writer.counters.add("born")
        return self._writer.write(self.array, info)

    def drop(self) -> None: ...
