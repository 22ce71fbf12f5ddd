"""Between the network's thread and the playing program: a thread that evens out and writes."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

from pebble.media.jitter import JitterBuffer
from pebble.services.audio_receiver.player import Player

_REST_S = 0.5  # how often one looks whether it has been silent for long
_END_S = 1.5


class Speaker:
    """``put`` from any thread; everything else happens on its own. ``ended`` is called there, however it ends."""

    def __init__(
        self,
        buffer: JitterBuffer,
        make_player: Callable[[threading.Event], Player],
        limit: int,
        ended: Callable[[], None],
    ) -> None:
        self.dropped = 0  # packets that came while too many waited
        self._stopping = threading.Event()
        self.buffer, self.player = buffer, make_player(self._stopping)
        self._arrived: deque[tuple[bytes, float]] = deque()
        self._limit, self._ended = limit, ended
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pebble-speaker", daemon=True)

    def open(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._stopping.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(_END_S)

    def put(self, payload: bytes) -> None:
        """One packet, just arrived."""
        if len(self._arrived) >= self._limit:
            self.dropped += 1
            self._arrived.popleft()
        self._arrived.append((payload, time.monotonic()))
        self._wake.set()

    def _run(self) -> None:
        try:
            while not self._stopping.is_set():
                wait = self.buffer.wait(time.monotonic())
                self._wake.wait(_REST_S if wait is None else wait)
                self._wake.clear()
                self._turn()
        finally:
            self.player.close()
            self._ended()

    def _turn(self) -> None:
        while self._arrived:
            self.buffer.put(*self._arrived.popleft())
        chunk = self.buffer.take(time.monotonic())
        if chunk is not None:
            self.player.play(chunk)
        elif self.buffer.wait(time.monotonic()) is None:
            self.player.rest()
