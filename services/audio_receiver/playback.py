"""The thread between the network and the playing program: a jitter buffer, and writes that may block."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

from pebble.media.jitter import JitterBuffer
from pebble.media.player import Player

_IDLE_S = 0.5  # between two checks whether it has been silent for long
_END_S = 1.5


class PlaybackThread:
    """``put`` is for any thread; everything else runs on its own. ``on_end`` is called there, however it ends."""

    def __init__(
        self,
        buffer: JitterBuffer,
        make_player: Callable[[threading.Event], Player],
        limit: int,
        on_end: Callable[[], None],
    ) -> None:
        self.dropped = 0  # packets that came while too many waited
        self._stopping = threading.Event()
        self.buffer, self.player = buffer, make_player(self._stopping)
        self._packets: deque[tuple[bytes, float]] = deque()
        self._limit, self._on_end = limit, on_end
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pebble-playback", daemon=True)

    def open(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._stopping.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(_END_S)

    def put(self, payload: bytes) -> None:
        """Queue one packet that has just arrived."""
        if len(self._packets) >= self._limit:
            self.dropped += 1
            self._packets.popleft()
        self._packets.append((payload, time.monotonic()))
        self._wake.set()

    def _run(self) -> None:
        try:
            while not self._stopping.is_set():
                wait = self.buffer.wait(time.monotonic())
                self._wake.wait(_IDLE_S if wait is None else wait)
                self._wake.clear()
                self._play()
        finally:
            self.player.close()
            self._on_end()

    def _play(self) -> None:
        while self._packets:
            self.buffer.put(*self._packets.popleft())
        chunk = self.buffer.take(time.monotonic())
        if chunk is not None:
            self.player.play(chunk)
        elif self.buffer.wait(time.monotonic()) is None:
            self.player.idle()
